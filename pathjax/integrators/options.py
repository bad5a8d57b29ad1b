"""Options of the path tracer: one record, built and checked at the start of the public functions.

The record is a static argument of `jax.jit`, so each choice compiles a kernel of its own, and the defaults compile
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
# The number of branches doubles with each split.
MOST_SPLITS = 8
# Sample counts or seeds: one for all, or one per pixel or replicate.
Counts = int | np.integer | Integer[Array | np.ndarray, "..."]


@dataclass(frozen=True)
class Options:
    """Options of one path tracer.

    Raises:
        InputError: a choice is unknown or out of range.
    """

    # Chosen by users; documented in `pathjax.render`.
    strategy: str = "mis"  # one of STRATEGIES
    fresnel: str = "exact"  # one of `bsdfs.FRESNEL`
    split_depth: int = 0  # at most MOST_SPLITS
    sampler: str = "lattice"  # one of SAMPLERS
    controlled: bool = False  # a `transport.Control` decides roulette
    # How films are sampled; users choose only the filter.
    shared: bool = False  # samples count in all pixels under the filter, so pixels are the whole film, in order
    # Set by other parts of the package.
    derivative: bool = False  # also follow paths of no throughput: their derivative may not be 0; the value is the same
    by_vertex: bool = False  # `Path.L` is the Gain of the last vertex
    watch_moving: bool = False  # record in `Path.moving` which bsdfs that move paths were met

    def __post_init__(self):
        named = {"strategy": STRATEGIES, "fresnel": bsdfs.FRESNEL, "sampler": SAMPLERS}
        for name, known in named.items():
            if getattr(self, name) not in known:
                raise InputError(f"{name} {getattr(self, name)!r} is unknown; use one of {', '.join(known)}")
        if not isinstance(self.split_depth, int) or not 0 <= self.split_depth <= MOST_SPLITS:
            raise InputError(f"split_depth = {self.split_depth!r}; it must be an integer in [0, {MOST_SPLITS}]")

    def check_counts(self, spp: Counts, seed: Counts) -> None:
        """Refuse, with an InputError, sample counts and seeds out of range; see `check_counts`."""
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
        """Refuse, with an InputError, options that derivatives do not support."""
        if self.split_depth or self.sampler != "lattice":
            raise InputError(
                f"derivatives are not made with split_depth={self.split_depth} and sampler={self.sampler!r}; "
                "differentiate with split_depth=0 and sampler='lattice', whose image has the same expectation"
            )
        if self.controlled:
            raise InputError("derivatives are not made with a control; without one the image has the same expectation")

    def applied(self, scene: Scene) -> Scene:
        """Return the scene with the chosen Fresnel model in its dielectrics."""
        return replace(scene, materials=bsdfs.with_fresnel(scene.materials, self.fresnel))


DEFAULTS = Options()


def strategies(scene: Scene) -> tuple[str, ...]:
    """Return the strategies that find all light of a scene."""
    return tuple(each for each in STRATEGIES if each != "bsdf" or not emitters.met_by_no_ray(scene.emitters))


def check_counts(spp: Counts, seed: Counts, name: str = "spp") -> None:
    """Refuse, with an InputError, a sample count below 1 or a seed below 0; arrays, also traced ones, are not checked.

    name: name of the sample count in the message.
    """
    for its_name, value, least in ((name, spp, 1), ("seed", seed, 0)):
        if isinstance(value, jax.Array) or np.ndim(value):
            continue
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or not least <= value < 2**31:
            raise InputError(f"{its_name} = {value!r}; it must be an integer in [{least}, 2^31)")
