"""Grids of volumes in kernels: their values at a point, and their integral along a ray.

Between the planes through the centres of cells the interpolation is a polynomial of degree 3 along a ray, which Gauss's
quadrature with two points integrates exactly. Where values are not interpolated, but each fills its cell, the planes
are the faces of cells. So the optical depth of a segment is computed without noise, as in a homogeneous medium, and so
is the distance at which it reaches a given value ("regular tracking": Novak et al. 2018, "Monte Carlo Methods for
Volumetric Light Transport Simulation", section 4.1). The cost is one step per plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax.compile import register_dataclass
from pathjax.core.math import at, larger, smaller
from pathjax.core.types import Ray
from pathjax.media.gridvolume import GridVolume
from pathjax.textures import Pairs

# Bisections of a part of a ray between two planes; more make no difference in float32.
_HALVINGS = 24


@register_dataclass
@dataclass(frozen=True)
class Grids:
    """The G grids of one parameter of R media, with T cells in all."""

    of: Int[Array, " R"]  # grid of each medium; below 0: none

    values: Float[Array, "T C"]  # all grids one after another, x running fastest
    first: Int[Array, " G"]  # first cell of each
    size: Int[Array, "G 3"]  # cells along x, y, z
    to_grid: Float[Array, "G 3 4"]  # from world space to cell coordinates, in which planes lie at integers
    box: Float[Array, "G 2 3"]
    nearest: Bool[Array, " G"] | None = None  # whether values are not interpolated; None: all are


class _Line(NamedTuple):
    """A ray in a grid: the cell coordinates at t are o + t d."""

    o: Float[Array, "3"]
    d: Float[Array, "3"]
    last: Float[Array, "3"]  # coordinates of the last planes
    varies: Bool[Array, "3"]  # along which axes values vary between planes


class _March(NamedTuple):
    t: Float[Array, ""]
    depth: Float[Array, " C"]  # from where the ray enters up to t
    plane: Float[Array, "3"]  # the next one along each axis
    goes_on: Bool[Array, ""]


def build(of: list[GridVolume | None], dtype) -> Grids:
    """Build the grids. of: grid of each medium."""
    present = list(dict.fromkeys(each for each in of if each is not None))
    number = {each: row for row, each in enumerate(present)} | {None: -1}
    channels = max(grid.data.shape[3] for grid in present)
    cells = [np.broadcast_to(grid.data, (*grid.data.shape[:3], channels)).reshape(-1, channels) for grid in present]
    first = np.cumsum([0, *map(len, cells[:-1])])
    size = [grid.data.shape[2::-1] for grid in present]
    nearest = np.array([grid.nearest for grid in present])
    to_grid = np.stack([x.to_grid for x in present])
    to_grid[nearest, :, 3] += 0.5
    numbers = np.concatenate(cells), to_grid, np.stack([x.box for x in present])
    values, to_grid, box = (np.asarray(x, dtype) for x in numbers)
    rows, first, size = (np.asarray(x, np.int32) for x in ([number[each] for each in of], first, size))
    return Grids(rows, values, first, size, to_grid, box, nearest if nearest.any() else None)


def look_up(grids: Grids, grid: Int[Array, ""], p: Float[Array, "3"]) -> Float[Array, " C"]:
    """Return the value of a grid at a point in world space."""
    to_grid = at(grids.to_grid, grid)
    x = to_grid[:, :3] @ p + to_grid[:, 3]
    return _interpolated(_corners(grids, grid, x), _shares(grids, grid, x))


def entries(grids: Grids, grid: Int[Array, ""], p: Float[Array, "3"]) -> Pairs:
    """Return the indices and weights of the values that a grid interpolates at a point."""
    to_grid = at(grids.to_grid, grid)
    x = to_grid[:, :3] @ p + to_grid[:, 3]
    share = _shares(grids, grid, x)
    found = []
    for number, place in enumerate(_places(grids, grid, _lowest(grids, grid, x))):
        a, b, c = (share[axis] if number >> axis & 1 else 1 - share[axis] for axis in range(3))
        found.append((place, a * b * c))
    return tuple(found)


def on_the_way(
    grids: Grids, grid: Int[Array, ""], ray: Ray, distance: Float[Array, ""], u: Float[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Sample a point uniformly on the part of a ray, up to a distance, in the box of a grid; and return its length."""
    start, end = _ends(grids, grid, ray)
    end = smaller(distance, end)
    start, length = jnp.where(start < end, start, 0), jnp.where(start < end, end - start, 0)
    return ray.o + (start + u * length) * ray.d, length


def depth(grids: Grids, grid: Int[Array, ""], ray: Ray, distance: Float[Array, ""]) -> Float[Array, " C"]:
    """Return the integral of a grid along a ray up to a distance, which may be inf."""
    return _follow(grids, grid, ray, distance, None).depth


def reach(
    grids: Grids, grid: Int[Array, ""], ray: Ray, channel: Int[Array, ""], wanted: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the distance at which the integral of one channel reaches a wanted value; inf where it never does."""
    line, (_, end) = _line(grids, grid, ray), _ends(grids, grid, ray)
    found = _follow(grids, grid, ray, jnp.full_like(ray.t_max, jnp.inf), (channel, wanted))
    t, rest = found.t, wanted - _channel(found.depth, channel)
    length = smaller(_next(line, found), end) - t
    corners, low = _between(grids, grid, line, t, length)

    def halve(_, bounds):
        middle = (bounds[0] + bounds[1]) / 2
        short = _channel(_integral(line, corners, low, t, middle * length), channel) < rest
        return jnp.where(short, middle, bounds[0]), jnp.where(short, bounds[1], middle)

    zero = jnp.zeros_like(t)
    _, share = lax.fori_loop(0, _HALVINGS, halve, (zero, zero + 1))
    return jnp.where(t < end, t + share * length, jnp.inf)


def _follow(grids, grid, ray, distance, target) -> _March:
    """March from plane to plane, to the end, or to the part in which the integral of a channel reaches `target`.

    target: channel and value; None: to the end.
    """
    line, (start, end) = _line(grids, grid, ray), _ends(grids, grid, ray)
    end = smaller(distance, end)

    def step(march):
        t1 = smaller(_next(line, march), end)
        length = t1 - march.t
        depth = march.depth + _integral(line, *_between(grids, grid, line, march.t, length), march.t, length)
        reached = False if target is None else _channel(depth, target[0]) >= target[1]
        # Advance all axes whose next plane is here, or by rounding no further.
        plane = jnp.where(_at_planes(line, march.plane) <= t1, march.plane + jnp.sign(line.d), march.plane)
        on = _March(t1, depth, plane, t1 < end)
        if target is None:
            return on
        stays = march._replace(goes_on=jnp.bool_(False))
        return _March(*(jnp.where(reached, a, b) for a, b in zip(stays, on, strict=True)))

    x = line.o + start * line.d
    plane = jnp.where(line.d > 0, larger(jnp.floor(x) + 1, 0), smaller(jnp.ceil(x) - 1, line.last))
    nothing = jnp.zeros_like(grids.values[0])
    # A ray that misses the box takes no step.
    begun = _March(jnp.where(start < end, start, end), nothing, plane, start < end)
    return lax.while_loop(lambda march: march.goes_on, step, begun)


def _line(grids, grid, ray) -> _Line:
    to_grid = at(grids.to_grid, grid)
    last, varies = _planes(grids, grid, ray.o.dtype)
    return _Line(to_grid[:, :3] @ ray.o + to_grid[:, 3], to_grid[:, :3] @ ray.d, last, varies)


def _planes(grids, grid, dtype):
    """Return `last` and `varies` of a line."""
    last = (at(grids.size, grid) - 1).astype(dtype)
    if grids.nearest is None:
        return last, last > 0
    nearest = at(grids.nearest, grid)
    return jnp.where(nearest, last + 1, last), (last > 0) & ~nearest


def _ends(grids, grid, ray):
    """Return where a ray enters and leaves the box of a grid; for a miss the end is not beyond the start."""
    box = at(grids.box, grid)
    moves = ray.d != 0
    inverse = 1 / jnp.where(moves, ray.d, 1)
    a, b = (box[0] - ray.o) * inverse, (box[1] - ray.o) * inverse
    inside = (ray.o >= box[0]) & (ray.o <= box[1])
    low = jnp.where(moves, smaller(a, b), jnp.where(inside, -jnp.inf, jnp.inf))
    high = jnp.where(moves, larger(a, b), jnp.where(inside, jnp.inf, -jnp.inf))
    start = larger(larger(larger(low[0], low[1]), low[2]), 0)
    return start, smaller(smaller(high[0], high[1]), high[2])


def _at_planes(line, plane):
    """Return the distances of planes, one per axis; inf where there is none."""
    exists = (line.d != 0) & (plane >= 0) & (plane <= line.last)
    return jnp.where(exists, (plane - line.o) / jnp.where(line.d != 0, line.d, 1), jnp.inf)


def _next(line, march):
    t = _at_planes(line, march.plane)
    # Rounding may put a plane behind the position of the ray.
    return larger(smaller(smaller(t[0], t[1]), t[2]), march.t)


def _between(grids, grid, line, t, length):
    """Return the values at the corners around a part of a line between planes, and coordinates of the lowest corner."""
    low = _lowest(grids, grid, line.o + (t + length / 2) * line.d)
    return _corners_at(grids, grid, low), low.astype(line.o.dtype)


def _integral(line, corners, low, t, length):
    """Integrate along a part of a line between two planes, by Gauss's quadrature with two points."""
    middle, off = t + length / 2, length / (2 * np.sqrt(3.0).astype(length.dtype))

    def value(x):
        return _interpolated(corners, _clipped(line.o + x * line.d - low, line.varies))

    return (value(middle - off) + value(middle + off)) * (length / 2)


def _clipped(share, varies):
    """Clip to the outermost centres, beyond which values are constant; 0 along axes that do not vary."""
    return jnp.where(varies, jnp.clip(share, 0, 1), 0)


def _lowest(grids, grid, x):
    """Return the lowest corner (3,) of the cube of eight centres around cell coordinates."""
    size = at(grids.size, grid)
    most = jnp.maximum(size - 2, 0)
    if grids.nearest is not None:
        most = jnp.where(at(grids.nearest, grid), size - 1, most)
    return jnp.clip(jnp.floor(x).astype(jnp.int32), 0, most)


def _corners(grids, grid, x):
    return _corners_at(grids, grid, _lowest(grids, grid, x))


def _shares(grids, grid, x):
    low = _lowest(grids, grid, x).astype(x.dtype)
    return _clipped(x - low, _planes(grids, grid, x.dtype)[1])


def _corners_at(grids, grid, low):
    """Return the values (C,) at eight centres."""
    return [at(grids.values, place) for place in _places(grids, grid, low)]


def _places(grids, grid, low):
    """Return the indices of eight centres among all values; x is the lowest bit of a centre's number."""
    size, first = at(grids.size, grid), at(grids.first, grid)
    high = jnp.minimum(low + 1, size - 1)
    found = []
    for number in range(8):
        x, y, z = (high[axis] if number >> axis & 1 else low[axis] for axis in range(3))
        found.append(first + (z * size[1] + y) * size[0] + x)
    return found


def _interpolated(corners, share):
    for axis in range(3):
        pairs = zip(corners[::2], corners[1::2], strict=True)
        corners = [a + (b - a) * share[axis] for a, b in pairs]
    return corners[0]


def _channel(depth, channel):
    """Return the depth () of a channel; grids have one channel for all colours, or three."""
    if depth.shape[0] == 1:
        return depth[0]
    return jnp.where(channel == 0, depth[0], jnp.where(channel == 1, depth[1], depth[2]))
