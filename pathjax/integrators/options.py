"""What a path tracer may be asked to do: one record, made and checked where the public functions begin.

It is what `jax.jit` gets as a static argument, so each choice compiles a kernel of its own, and the defaults compile
nothing of the other choices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Array, Integer

from pathjax import bsdfs, emitters
from pathjax.compile import is_traced
from pathjax.core import sampler
from pathjax.errors import InputError
from pathjax.scene.scene import Scene

STRATEGIES = ("mis", "light", "bsdf")
SAMPLERS = tuple(sampler.POINTS)
# Branches double with each.
MOST_SPLITS = 8
# Numbers of samples, or seeds: one for all, or one for each pixel or replicate.
Counts = int | np.integer | Integer[Array | np.ndarray, "..."]


@dataclass(frozen=True)
class Options:
    """Choices of one path tracer.

    Raises:
        InputError: a choice that is unknown or out of range.
    """

    # What users choose; `pathjax.render` says what it means.
    strategy: str = "mis"  # of STRATEGIES
    fresnel: str = "exact"  # of `bsdfs.FRESNEL`
    split_depth: int = 0  # at most MOST_SPLITS
    sampler: str = "lattice"  # of SAMPLERS
    controlled: bool = False  # a `transport.Control` decides on roulette
    # How films are sampled, of which users choose nothing but the filter.
    shared: bool = False  # samples count in all pixels under the filter, so pixels are all of the film, in order
    # What other parts of the package ask for.
    derivative: bool = False  # follow also what carries nothing, since its derivative may; the value is the same
    by_vertex: bool = False  # `Path.L` is the Gain of the last vertex
    watch_moving: bool = False  # tell which bsdfs it met that move paths

    def __post_init__(self):
        named = {"strategy": STRATEGIES, "fresnel": bsdfs.FRESNEL, "sampler": SAMPLERS}
        for name, known in named.items():
            if getattr(self, name) not in known:
                raise InputError(f"{name} {getattr(self, name)!r} is unknown; use one of {', '.join(known)}")
        if not isinstance(self.split_depth, int) or not 0 <= self.split_depth <= MOST_SPLITS:
            raise InputError(f"split_depth = {self.split_depth!r}; it must be an integer in [0, {MOST_SPLITS}]")

    def check_counts(self, spp: Counts, seed: Counts) -> None:
        """Refuse, with an InputError, numbers of samples and seeds out of range; see `check_counts`."""
        check_counts(spp, seed)
        if self.sampler == "subpixel" and not is_traced(spp):
            if np.any(np.asarray(spp) % sampler.SUBPIXELS):
                raise InputError(f"spp = {spp}; sampler='subpixel' takes samples by fours, so make it a multiple of 4")

    def check_strategy(self, scene: Scene) -> None:
        """Refuse, with an InputError, a strategy that misses some of the scene's light."""
        if self.strategy not in strategies(scene):
            missed = ", ".join(emitters.met_by_no_ray(scene.emitters))
            raise InputError(
                f"strategy {self.strategy!r} misses all light of the {missed} emitters, which no ray meets; "
                f"use one of {', '.join(strategies(scene))}"
            )

    def check_differentiable(self) -> None:
        """Refuse, with an InputError, what derivatives are not made with."""
        if self.split_depth or self.sampler != "lattice":
            raise InputError(
                f"derivatives are not made with split_depth={self.split_depth} and sampler={self.sampler!r}; "
                "differentiate with split_depth=0 and sampler='lattice', whose image has the same expectation"
            )
        if self.controlled:
            raise InputError("derivatives are not made with a control; without one the image has the same expectation")

    def applied(self, scene: Scene) -> Scene:
        """The scene whose dielectrics reflect as chosen."""
        return replace(scene, materials=bsdfs.with_fresnel(scene.materials, self.fresnel))


DEFAULTS = Options()


def strategies(scene: Scene) -> tuple[str, ...]:
    """The strategies that find all light of a scene."""
    return tuple(each for each in STRATEGIES if each != "bsdf" or not emitters.met_by_no_ray(scene.emitters))


def check_counts(spp: Counts, seed: Counts, name: str = "spp") -> None:
    """Refuse, with an InputError, a number of samples below 1 and a seed below 0; arrays, traced ones too, pass.

    name: what the samples are called.
    """
    for its_name, value, least in ((name, spp, 1), ("seed", seed, 0)):
        if isinstance(value, jax.Array) or np.ndim(value):
            continue
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or not least <= value < 2**31:
            raise InputError(f"{its_name} = {value!r}; it must be an integer in [{least}, 2^31)")
