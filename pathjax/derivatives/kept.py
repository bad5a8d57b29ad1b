"""Which entries of the list of `differentiated` are kept: those of the requested parameters, not of whole arrays.

The texels of all textures of a scene stand in one array, and the requested texture may be a small part of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax.derivatives import differentiated
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Each look-up compares its index with the ends of all runs.
MOST_RUNS = 4


@dataclass(frozen=True)
class Kept:
    """Runs of kept entries, ascending; static."""

    paths: differentiated.Paths  # of the arrays in the list
    runs: tuple[range, ...]
    all: bool  # whether the runs cover the list
    fields: differentiated.Fields = None  # as returned by `differentiated.places_of_textures`

    @property
    def count(self) -> int:
        """Number of kept entries, plus one last entry that collects all others, if there are others."""
        return sum(map(len, self.runs)) + (not self.all)

    def place(self, entry: Int[Array, ""] | int) -> Int[Array, ""]:
        """Return the index among the kept entries of an entry of the list."""
        if self.all:
            return jnp.asarray(entry)
        found, first = jnp.int32(self.count - 1), 0
        for run in self.runs:
            inside = (entry >= run.start) & (entry < run.stop)
            found = jnp.where(inside, entry - run.start + first, found)
            first += len(run)
        return found

    def of(self, scene: Scene, parameter: Parameter) -> range:
        """Return the indices of a requested parameter's entries among those kept."""
        return self.places(entries(scene, self.paths, parameter))

    def places(self, entries: range) -> range:
        """Return the indices among those kept of consecutive entries of the list."""
        first = 0
        for run in self.runs:
            if entries.start in run:
                begin = entries.start - run.start + first
                return range(begin, begin + len(entries))
            first += len(run)
        raise ValueError(f"{entries} are not kept")


def kept(scene: Scene, parameters: Iterable[Parameter]) -> Kept:
    """Return the entries to keep for derivatives in some parameters."""
    parameters = list(parameters)
    paths = tuple(dict.fromkeys(parameter.path for parameter in parameters))
    _, count = differentiated.firsts(scene, paths)
    runs = few(sorted((entries(scene, paths, each) for each in parameters), key=lambda run: run.start))
    return Kept(paths, runs, sum(map(len, runs)) == count, differentiated.places_of_textures(parameters))


def entries(scene: Scene, paths: differentiated.Paths, parameter: Parameter) -> range:
    """Return the indices of a parameter's entries in the list."""
    first, _ = differentiated.firsts(scene, paths)
    shape, width = named.get(scene, parameter.path).shape, 3 if differentiated.of_colors(scene, parameter.path) else 1
    begin = sum(place * math.prod(shape[axis + 1 :]) for axis, place in enumerate(parameter.index))
    count = (parameter.rows or 1) * math.prod(shape[len(parameter.index) :])
    begin = first[parameter.path] + begin // width
    return range(begin, begin + count // width)


def of_parameter(
    parameter: Parameter, array: tuple[int, ...], found: Float[Array, "entries ..."]
) -> Float[Array, "..."]:
    """Return derivatives of a parameter's shape from those in its entries. array: shape of the array that holds it."""
    if not parameter.is_texture:
        return found.reshape(parameter.shape)
    return replace(parameter, index=(0,)).transposed(found.reshape(parameter.rows, *array[1:]))


def of_entries(scene: Scene, parameter: Parameter, change: Float[Array, "..."]) -> Float[Array, "entries 3"]:
    """Return the changes of a parameter's entries from that of the parameter; scalars change all channels alike."""
    if parameter.is_texture:
        mine = jnp.zeros((parameter.rows, *named.get(scene, parameter.path).shape[1:]), change.dtype)
        change = replace(parameter, index=(0,)).put(mine, change)
    rows = change.reshape(-1, 3 if differentiated.of_colors(scene, parameter.path) else 1)
    return jnp.broadcast_to(rows, (len(rows), 3))


def few(runs: Sequence[range]) -> tuple[range, ...]:
    """Join sorted runs that touch and, if there are many, those with the smallest gaps between them."""
    gaps = sorted(later.start - run.stop for run, later in zip(runs[:-1], runs[1:], strict=True))
    least = max(gaps[-MOST_RUNS + 1 :][0], 1) if len(gaps) >= MOST_RUNS else 1
    joined = [runs[0]]
    for run in runs[1:]:
        if run.start - joined[-1].stop < least:
            joined[-1] = range(joined[-1].start, max(joined[-1].stop, run.stop))
        else:
            joined.append(run)
    return tuple(joined)
