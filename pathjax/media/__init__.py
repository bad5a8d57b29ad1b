"""Participating media between surfaces, their phase functions, and where each of them begins and ends.

Each shape may state the medium inside, on the side that its normals point away from, and the medium outside. A path
keeps track of its medium, and changes it where it leaves such a shape, to either side. Distances are drawn by the
extinction in one of three colours, chosen in proportion to what the path still carries of them. Weights are those of
the mixture, so none exceeds the inverse of its colour's probability (the balance heuristic of Veach 1997, as in Wilkie
et al. 2014, "Hero wavelength spectral sampling"). Distances and densities are detached: weights carry derivatives.

Where media only absorb, no distance is drawn and no scattering is compiled. The albedo may vary in space, and so may
the extinction of heterogeneous media, each by a grid: see `grids`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax.compile import register_dataclass
from pathjax.core.math import at, dot, safe_divide
from pathjax.core.types import BSDFSample, Ray
from pathjax.core.warp import chosen
from pathjax.kinds import Instance, Parameter, Parameters, Row, Table, ordered
from pathjax.kinds import register as register_kind
from pathjax.media import grids
from pathjax.media.blendphase import BlendPhase
from pathjax.media.grids import Grids
from pathjax.media.gridvolume import GridVolume
from pathjax.media.hg import HG
from pathjax.media.homogeneous import VOLUMES, Heterogeneous, Homogeneous
from pathjax.media.isotropic import Isotropic
from pathjax.media.phase import Phase
from pathjax.media.rayleigh import Rayleigh
from pathjax.media.tabphase import TabPhase
from pathjax.textures import Pairs

__all__ = [
    "HG",
    "KINDS",
    "PHASES",
    "VOLUMES",
    "BlendPhase",
    "GridVolume",
    "Grids",
    "Heterogeneous",
    "Homogeneous",
    "Isotropic",
    "Media",
    "Nudges",
    "Phase",
    "Rayleigh",
    "TabPhase",
    "register",
]

# Kinds by their names in scene files.
KINDS = {"homogeneous": Homogeneous, "heterogeneous": Heterogeneous}
PHASES: dict[str, type[Phase]] = {
    "isotropic": Isotropic,
    "hg": HG,
    "rayleigh": Rayleigh,
    "tabphase": TabPhase,
    "blendphase": BlendPhase,
}
# Instead of a row: no medium; and, for shapes that state none, the medium that the path is already in.
NONE, SAME = -1, -2
# Least probability of each colour: one that the path carries nothing of may have a derivative.
LEAST = 1 / 30


def register(name: str):
    """Return a decorator that registers a subclass of `Phase` as a kind, which scene files call `name`."""
    return register_kind(PHASES, Phase, name, "media")


class Nudges(NamedTuple):
    """For derivatives: what is added to values of grids; None: nothing."""

    extinction: Float[Array, ""] | None = None  # to the one where a flight ends at a particle
    albedo: Float[Array, ""] | None = None  # to the one there
    depth: Float[Array, ""] | None = None  # to the depth of the flight
    shadow: Float[Array, ""] | None = None  # to the depth of a shadow ray: see `integrators.shadow`


@register_dataclass
@dataclass(frozen=True)
class Media:
    table: Table  # of all media, of both kinds; without albedo if nothing scatters
    phases: tuple[Table, ...]  # one per kind of phase function present; that of blends comes last
    phase: Int[Array, "R 2"]  # per medium: kind and row of its phase function
    sides: Int[Array, "S 2"]  # per shape: rows of the media inside and outside, or NONE, or SAME twice
    camera: Int[Array, ""]  # row of the medium in which paths begin, or NONE
    # Factors of the extinctions and albedos of the table; None: none varies in space.
    extinctions: Grids | None = None
    albedos: Grids | None = None
    nudges: Nudges | None = None

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
    """Build the media of a scene; None where there are none.

    Args:
        sides: of each shape, the media inside and outside.
        camera: the medium of the sensor.
        path: location of the media in the scene.
        parameters: receives the parameters of media and phase functions.
    """
    present = list(dict.fromkeys(each for each in (*(m for pair in sides for m in pair), camera) if each is not None))
    if not present:
        return None
    number = {each: row for row, each in enumerate(present)} | {None: NONE}
    scatters = any(np.any(_numbers(each.values["albedo"])) for each in present)
    rows = present if scatters else [_absorbing(each, parameters) for each in present]
    table = Homogeneous.build([_constant(each) for each in rows], dtype, (*path, "table"), parameters, None)
    extinctions, albedos = (
        _grids(rows, key, dtype, (*path, place), parameters)
        for key, place in (("sigma_t", "extinctions"), ("albedo", "albedos"))
    )
    phases, code = [], {}
    if scatters:
        asked = [each.values["phase"] for each in present]
        asked += [held for each in asked for held in each.values.get("held", ())]
        for kind, instances in sorted(ordered(dict.fromkeys(asked), PHASES).items(), key=lambda item: _blends(item[0])):
            code |= {each: (len(phases), row) for row, each in enumerate(instances)}
            phases.append(kind.build(instances, dtype, (*path, "phases", len(phases)), parameters, None))
            if _blends(kind):
                codes = [[code[held] for held in each.values["held"]] for each in instances]
                phases[-1] = phases[-1].with_column("codes", np.asarray(codes, np.int32))
    phase = [code.get(each.values["phase"], (NONE, NONE)) for each in present]
    rows = [(SAME, SAME) if pair == (None, None) else tuple(number[each] for each in pair) for pair in sides]
    sides = np.asarray(rows, np.int32).reshape(-1, 2)
    phase, camera = np.asarray(phase, np.int32), np.int32(number[camera])
    return Media(table, tuple(phases), phase, sides, camera, extinctions, albedos)


def _numbers(value: object) -> object:
    return value.data if isinstance(value, GridVolume) else value


def _constant(medium: Instance) -> Instance:
    """Return the medium with ones in place of grids; these are factors of the grids."""
    values = {key: np.ones(3) if isinstance(value, GridVolume) else value for key, value in medium.values.items()}
    return Instance(medium.kind, medium.name, values)


def _grids(rows: list[Instance], key: str, dtype, path: tuple, parameters: Parameters) -> Grids | None:
    """Build the grids that replace a parameter of media, at `path` in the scene, and enter it; None: no grids."""
    values = {each: each.values[key] for each in rows if isinstance(each.values[key], GridVolume)}
    if not values:
        return None
    made = grids.build([values.get(each) for each in rows], dtype)
    named: dict[int, str] = {}
    for row, each in enumerate(rows):
        if each not in values:
            continue
        name, grid, number = f"{each.name}.{key}", values[each], int(made.of[row])
        parameters.known.pop(name, None)
        if not grid.listed:
            parameters.refused[name] = f"{name} is a volume that repeats or has one value, which is no parameter"
        elif number in named:
            parameters.refused[name] = f"{name} is the same grid as {named[number]}; set that, and both change"
        else:
            where = (*path, "values"), (int(made.first[number]),), grid.data.shape
            rows_of_it = grid.data[..., 0].size
            parameters.known[name] = Parameter(*where, each.kind.declared[key].bounds, key, rows=rows_of_it)
            named[number] = name
    return made


def _absorbing(medium: Instance, parameters: Parameters) -> Instance:
    """Return the medium without albedo, since all albedos are 0."""
    parameters.refused[f"{medium.name}.albedo"] = (
        f"{medium.name}.albedo is 0, as that of all media of the scene is, so no scattering is compiled; "
        "load the scene with one above 0 to set it"
    )
    return Instance(medium.kind, medium.name, {**medium.values, "albedo": None})


def names(media: Media) -> list[str]:
    """Return the names in scene files of the kinds present, for `info`."""
    known = {kind: name for name, kind in (KINDS | PHASES).items()}
    present = [media.table.kind, *(table.kind for table in media.phases)]
    more = [] if media.extinctions is None and media.albedos is None else ["grids"]
    more += [] if media.scatters else ["absorption alone"]
    return [known[kind] for kind in present] + more


# ---- at a vertex ----------------------------------------------------------------------------------------------------


def beyond(
    media: Media,
    medium: Int[Array, ""],
    shape: Int[Array, ""],
    n: Float[Array, "3"],
    d: Float[Array, "3"],
) -> Int[Array, ""]:
    """Return the medium of a ray that leaves a shape with normal n in the direction d. shape: -1: none."""
    side = at(media.sides, jnp.maximum(shape, 0), jnp.where(dot(n, d) > 0, 1, 0))
    return jnp.where((shape < 0) | (side == SAME), medium, side)


def distance(
    media: Media, medium: Int[Array, ""], ray: Ray, throughput: Float[Array, "3"], u: Float[Array, "2"]
) -> Float[Array, ""]:
    """Sample the distance along a ray to the next particle, detached; inf: there is none. u: uniform in (0, 1)."""
    sigma, chances = extinction(media, medium), _chances(throughput)
    red, green = u[0] < chances[0], u[0] < chances[0] + chances[1]
    of_colour = lax.stop_gradient(jnp.where(red, sigma[0], jnp.where(green, sigma[1], sigma[2])))
    attenuates = of_colour > 0
    # The distance; with a grid, the integral of its values to be reached.
    wanted = jnp.where(attenuates, -jnp.log1p(-u[1]) / jnp.where(attenuates, of_colour, 1), jnp.inf)
    if media.extinctions is None:
        return wanted
    values, ray = lax.stop_gradient((media.extinctions, ray))
    channel = jnp.where(red, 0, jnp.where(green, 1, 2))
    return _in_grid(values, medium, lambda grid: grids.reach(values, grid, ray, channel, wanted), lambda: wanted)


def flight_weight(
    media: Media,
    medium: Int[Array, ""],
    ray: Ray,
    throughput: Float[Array, "3"],
    distance: Float[Array, ""],
    scatters: Bool[Array, ""] | None,
) -> Float[Array, "3"]:
    """Return the factor of the throughput for a flight along a ray, to a surface or to where the path is scattered.

    scatters: whether the flight ends in the medium, at a distance drawn by `distance`; None: nothing scatters.
    """
    nudges = media.nudges or Nudges()
    passed = transmittance(media, medium, ray, distance, nudges.depth)
    if scatters is None:
        return passed

    def at_end(number, values, nudge):
        if values is None:
            return number
        p = ray.o + jnp.where(scatters, distance, 0) * ray.d
        one = jnp.ones_like(p)

        def of_grid(grid):
            value = grids.look_up(values, grid, p)
            return one * (value if nudge is None else value + nudge)

        return number * _in_grid(values, medium, of_grid, lambda: one)

    sigma = at_end(extinction(media, medium), media.extinctions, nudges.extinction)
    # For each colour, the density of flights that end here, or the probability of longer ones.
    density = jnp.where(scatters, sigma, 1) * passed
    drawn = lax.stop_gradient(dot(_chances(throughput), density))
    albedo = at_end(Row(media.table, jnp.maximum(medium, 0)).albedo, media.albedos, nudges.albedo)
    return jnp.where(scatters, albedo, 1) * safe_divide(density, drawn)


def transmittance(
    media: Media,
    medium: Int[Array, ""],
    ray: Ray,
    distance: Float[Array, ""],
    nudge: Float[Array, ""] | None = None,
) -> Float[Array, "3"]:
    """Return the share of light that is transmitted; over an infinite distance it is 0 or 1, without derivative.

    nudge: added to the depth in a grid.
    """
    sigma = extinction(media, medium)

    def through():
        ends = distance < jnp.inf
        return jnp.where(ends, jnp.exp(-sigma * jnp.where(ends, distance, 0)), jnp.where(sigma > 0, 0, 1))

    values = media.extinctions
    if values is None:
        return through()

    def in_grid(grid):
        depth = grids.depth(values, grid, ray, distance)
        return jnp.exp(-sigma * (depth if nudge is None else depth + nudge))

    return _in_grid(values, medium, in_grid, through)


def nudged_shadow(media: Media, medium: Int[Array, ""]) -> Float[Array, "3"]:
    """Return the factor of transmitted light due to the nudge of its depth in the grid of a medium."""
    return jnp.exp(-extinction(media, medium) * media.nudges.shadow)


def extinction(media: Media, medium: Int[Array, ""]) -> Float[Array, "3"]:
    """Return the extinction per unit of length, or the factor of its grid; 0 without medium."""
    p = Row(media.table, jnp.maximum(medium, 0))
    return jnp.where(medium >= 0, p.sigma_t * p.scale, 0)


def on_the_way(
    media: Media, medium: Int[Array, ""], ray: Ray, distance: Float[Array, ""], u: Float[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Sample a point of a ray uniformly up to a distance in its medium's grid; return that length too (0: no grid)."""
    values = media.extinctions
    grid = _grid(values, medium)
    p, length = grids.on_the_way(values, jnp.maximum(grid, 0), ray, distance, u)
    return p, jnp.where(grid >= 0, length, 0)


def entries(values: Grids, medium: Int[Array, ""], p: Float[Array, "3"]) -> Pairs:
    """Return the indices and weights of the values that a medium's grid interpolates at a point; 0 without a grid."""
    grid = _grid(values, medium)
    found = grids.entries(values, jnp.maximum(grid, 0), p)
    return tuple((place, jnp.where(grid >= 0, share, 0)) for place, share in found)


def _grid(values, medium):
    return jnp.where(medium >= 0, at(values.of, jnp.maximum(medium, 0)), NONE)


def _in_grid(values, medium, of_grid, otherwise):
    """Return of_grid(grid) for the grid of a medium, or otherwise() where it has none."""
    grid = _grid(values, medium)
    return lax.cond(grid >= 0, lambda: of_grid(jnp.maximum(grid, 0)), otherwise)


def _chances(throughput):
    """Return the probability (3,) of each colour to be the one by which a distance is drawn."""
    carried = lax.stop_gradient(throughput)
    total = carried[0] + carried[1] + carried[2]
    share = jnp.where(total > 0, carried / jnp.where(total > 0, total, 1), 1 / 3)
    return LEAST + (1 - 3 * LEAST) * share


def evaluate(media: Media, medium: Int[Array, ""], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return the value of the phase function, like that of a bsdf, and its density."""
    code = at(media.phase, jnp.maximum(medium, 0))
    f = _of_phase(media, code, lambda kind, p: kind.evaluate(p, wo)) if not _mixes(media) else _mixture(media, code, wo)
    return jnp.broadcast_to(f, wo.shape), lax.stop_gradient(f)


def sample(media: Media, medium: Int[Array, ""], u: Float[Array, "2"]) -> BSDFSample:
    """Sample `wo` from the phase function, as from a bsdf; from a blend, by one of its two, chosen by weight."""
    code = blend = at(media.phase, jnp.maximum(medium, 0))
    if _mixes(media):
        one, other, weight = _held(media, blend)
        takes_one, u = chosen(u, lax.stop_gradient(1 - weight))
        code = jnp.where(takes_one, one, other)

    def draw(kind, p):
        wo = kind.sample(p, u)
        return wo, kind.evaluate(p, wo)

    wo, f = _of_phase(media, code, draw)
    if _mixes(media):
        f = _mixture(media, blend, wo)
    pdf = lax.stop_gradient(f)
    weight = jnp.broadcast_to(safe_divide(f, pdf), wo.shape)
    return BSDFSample(wo, weight, pdf, jnp.bool_(False), jnp.ones_like(pdf))


def _of_phase(media, code, of):
    """Return of(kind, row) for a phase function that is no blend."""
    tables = media.phases[:-1] if _mixes(media) else media.phases
    branches = [lambda table=table: of(table.kind, Row(table, code[1])) for table in tables]
    return branches[0]() if len(branches) == 1 else lax.switch(code[0], branches)


def _blends(kind: type[Phase]) -> bool:
    return issubclass(kind, BlendPhase)


def _mixes(media) -> bool:
    return _blends(media.phases[-1].kind)


def _held(media, code):
    """Return the phase functions in a blend, and the weight of the second; for others, themselves twice, and 0."""
    is_blend = code[0] == len(media.phases) - 1
    p = Row(media.phases[-1], jnp.where(is_blend, code[1], 0))
    one, other = (jnp.where(is_blend, held, code) for held in p.codes)
    return one, other, jnp.where(is_blend, p.weight, 0)


def _mixture(media, code, wo):
    one, other, weight = _held(media, code)
    first, second = (_of_phase(media, each, lambda kind, p: kind.evaluate(p, wo)) for each in (one, other))
    return (1 - weight) * first + weight * second
