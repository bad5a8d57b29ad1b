"""What lies between surfaces: participating media, their phase functions, and where each of them begins and ends.

Each shape may say what is inside of it, where its normals point away from, and what is outside. A path knows the medium
that it is in, and changes it where it leaves such a shape, to whatever side. Distances are drawn by the extinction in
one of three colours, chosen by chance in proportion to what the path still carries of them; weights are those of the
mixture, so no colour's weight grows beyond the inverse of its chance (the balance heuristic of Veach 1997, as in Wilkie
et al. 2014, "Hero wavelength spectral sampling"). Distances and densities are detached: weights carry the derivatives.

Of media that only absorb nothing is drawn, and no scattering is compiled.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax.compile import register_dataclass
from pathjax.core.math import at, dot, safe_divide
from pathjax.core.types import BSDFSample
from pathjax.kinds import Instance, Parameters, Row, Table, ordered
from pathjax.kinds import register as register_kind
from pathjax.media.hg import HG
from pathjax.media.homogeneous import VOLUMES, Homogeneous
from pathjax.media.isotropic import Isotropic
from pathjax.media.phase import Phase

__all__ = ["HG", "KINDS", "PHASES", "VOLUMES", "Homogeneous", "Isotropic", "Media", "Phase", "register"]

# By the name that scene files give them.
KINDS = {"homogeneous": Homogeneous}
PHASES: dict[str, type[Phase]] = {"isotropic": Isotropic, "hg": HG}
# In the place of a row: no medium; and of shapes that say nothing, which leave paths in the medium that they are in.
NONE, SAME = -1, -2
# Least probability of each colour: what the path carries nothing of may have a derivative.
LEAST = 1 / 30


def register(name: str):
    """A decorator that makes a subclass of `Phase` a phase function, which scene files name by `name`."""
    return register_kind(PHASES, Phase, name, "media")


@register_dataclass
@dataclass(frozen=True)
class Media:
    table: Table  # of what is homogeneous; without albedo where nothing scatters
    phases: tuple[Table, ...]  # one for each kind of phase function present
    phase: Int[Array, "R 2"]  # of each medium: kind and row of its phase function
    sides: Int[Array, "S 2"]  # of each shape: rows of the media inside and outside, or NONE, or SAME twice
    camera: Int[Array, ""]  # row of the medium in which paths begin, or NONE

    @property
    def scatters(self) -> bool:
        return self.table.column("albedo") is not None


def build(
    sides: list[tuple[Instance | None, Instance | None]],
    camera: Instance | None,
    dtype,
    path: tuple,
    parameters: Parameters,
) -> Media | None:
    """The media of a scene; None where there are none.

    Args:
        sides: of each shape, the media inside and outside; camera: that of the sensor.
        path: where they will be in the scene; parameters: to enter those of media and phase functions.
    """
    present = list(dict.fromkeys(each for each in (*(m for pair in sides for m in pair), camera) if each is not None))
    if not present:
        return None
    number = {each: row for row, each in enumerate(present)} | {None: NONE}
    scatters = any(np.any(each.values["albedo"]) for each in present)
    rows = present if scatters else [_absorbing(each, parameters) for each in present]
    table = Homogeneous.build(rows, dtype, (*path, "table"), parameters, None)
    phases, code = [], {}
    if scatters:
        for kind, instances in ordered(dict.fromkeys(each.values["phase"] for each in present), PHASES).items():
            code |= {each: (len(phases), row) for row, each in enumerate(instances)}
            phases.append(kind.build(instances, dtype, (*path, "phases", len(phases)), parameters, None))
    phase = [code.get(each.values["phase"], (NONE, NONE)) for each in present]
    rows = [(SAME, SAME) if pair == (None, None) else tuple(number[each] for each in pair) for pair in sides]
    sides = np.asarray(rows, np.int32).reshape(-1, 2)
    return Media(table, tuple(phases), np.asarray(phase, np.int32), sides, np.int32(number[camera]))


def _absorbing(medium: Instance, parameters: Parameters) -> Instance:
    """The same without albedo, as all of them are 0."""
    parameters.refused[f"{medium.name}.albedo"] = (
        f"{medium.name}.albedo is 0, as that of all media of the scene is, so no scattering is compiled; "
        "load the scene with one above 0 to set it"
    )
    return Instance(medium.kind, medium.name, {**medium.values, "albedo": None})


def names(media: Media) -> list[str]:
    """What scene files call the kinds that are present, as `info` tells them."""
    known = {kind: name for name, kind in (KINDS | PHASES).items()}
    present = [media.table.kind, *(table.kind for table in media.phases)]
    return [known[kind] for kind in present] + ([] if media.scatters else ["absorption alone"])


# ---- at a vertex ----------------------------------------------------------------------------------------------------


def beyond(
    media: Media,
    medium: Int[Array, ""],
    shape: Int[Array, ""],
    n: Float[Array, "3"],
    d: Float[Array, "3"],
) -> Int[Array, ""]:
    """The medium in which a ray goes on that leaves a shape, of the normal n, in the direction d; shape -1: none."""
    side = at(media.sides, jnp.maximum(shape, 0), jnp.where(dot(n, d) > 0, 1, 0))
    return jnp.where((shape < 0) | (side == SAME), medium, side)


def distance(
    media: Media, medium: Int[Array, ""], throughput: Float[Array, "3"], u: Float[Array, "2"]
) -> Float[Array, ""]:
    """Draw how far light goes until it meets a particle, detached; inf where there is none.

    u: uniform in (0, 1).
    """
    sigma, chances = extinction(media, medium), _chances(throughput)
    red, green = u[0] < chances[0], u[0] < chances[0] + chances[1]
    of_colour = lax.stop_gradient(jnp.where(red, sigma[0], jnp.where(green, sigma[1], sigma[2])))
    some = of_colour > 0
    return jnp.where(some, -jnp.log1p(-u[1]) / jnp.where(some, of_colour, 1), jnp.inf)


def flight_weight(
    media: Media,
    medium: Int[Array, ""],
    throughput: Float[Array, "3"],
    distance: Float[Array, ""],
    scatters: Bool[Array, ""] | None,
) -> Float[Array, "3"]:
    """What a path carries of its throughput over a distance, to a surface, or to where it is scattered.

    scatters: whether it ends in the medium, at a distance that `distance` drew; None: nothing scatters.
    """
    passed = transmittance(media, medium, distance)
    if scatters is None:
        return passed
    # Of each colour, the density with which it would have had the light end here, or go on further than this.
    density = jnp.where(scatters, extinction(media, medium), 1) * passed
    drawn = lax.stop_gradient(dot(_chances(throughput), density))
    albedo = Row(media.table, jnp.maximum(medium, 0)).albedo
    return jnp.where(scatters, albedo, 1) * safe_divide(density, drawn)


def transmittance(media: Media, medium: Int[Array, ""], distance: Float[Array, ""]) -> Float[Array, "3"]:
    """Share of the light that comes through; of an endless way, which has no derivative, all or nothing."""
    sigma, ends = extinction(media, medium), distance < jnp.inf
    return jnp.where(ends, jnp.exp(-sigma * jnp.where(ends, distance, 0)), jnp.where(sigma > 0, 0, 1))


def extinction(media: Media, medium: Int[Array, ""]) -> Float[Array, "3"]:
    """1 over the unit of length; 0 without medium."""
    p = Row(media.table, jnp.maximum(medium, 0))
    return jnp.where(medium >= 0, p.sigma_t * p.scale, 0)


def _chances(throughput):
    """Of each colour to be the one that a distance is drawn for."""
    carried = lax.stop_gradient(throughput)
    total = carried[0] + carried[1] + carried[2]
    share = jnp.where(total > 0, carried / jnp.where(total > 0, total, 1), 1 / 3)
    return LEAST + (1 - 3 * LEAST) * share


def evaluate(
    media: Media, medium: Int[Array, ""], wo: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """The phase function, as a bsdf is evaluated, and its density."""
    f = _of_phase(media, medium, lambda kind, p: kind.evaluate(p, wo))
    return jnp.broadcast_to(f, wo.shape), lax.stop_gradient(f)


def sample(media: Media, medium: Int[Array, ""], u: Float[Array, "2"]) -> BSDFSample:
    """Draw `wo` from the phase function, as if it were a bsdf."""

    def draw(kind, p):
        wo = kind.sample(p, u)
        return wo, kind.evaluate(p, wo)

    wo, f = _of_phase(media, medium, draw)
    pdf = lax.stop_gradient(f)
    weight = jnp.broadcast_to(safe_divide(f, pdf), wo.shape)
    return BSDFSample(wo, weight, pdf, jnp.bool_(False), jnp.ones_like(pdf))


def _of_phase(media, medium, of):
    code = at(media.phase, jnp.maximum(medium, 0))
    branches = [lambda table=table: of(table.kind, Row(table, code[1])) for table in media.phases]
    return branches[0]() if len(branches) == 1 else lax.switch(code[0], branches)
