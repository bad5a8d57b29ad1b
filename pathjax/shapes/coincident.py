"""Coincident surfaces, detected when a scene is built, so that rays leave all of them and see the right one.

The primitive that a ray starts on is excluded by index, which suffices for a lone rectangle, disk or sphere. If another
primitive lies in the same place, the rounded origin may be on the far side of it. Only there, so that sheets elsewhere
may be thin, origins are moved along the normal by a margin that covers the rounding of both.

Some pairs have an order and are separated by a gap that rounding cannot close, at no cost while rendering: there is air
between a body and whatever it touches, and a lamp that lies in a wall shines from it. So a cube and glass shrink by the
gap, and an emitting sheet moves forward. Meshes that are not flat stay as they are, and are not compared with each
other.
"""

from __future__ import annotations

from functools import cache, reduce
from typing import NamedTuple

import numpy as np

from pathjax.system.cores import SMALL, over_cores

# In machine epsilons of the coordinates along the normal, for each of the two primitives: an upper bound on the
# rounding errors of its point, its plane and a distance from the plane (see `planar.leaf_numbers`).
MARGIN = 4
# In machine epsilons of the scene's size, since rays come from anywhere in it.
_GAP = 8
# All faces of a large mesh are compared with up to this number of planes; for more planes, sorting the faces is faster.
MOST_PLANES = 64
BLOCK = 1 << 13  # faces compared at a time: their coordinates stay in the cache


class Faces(NamedTuple):
    """The flat faces of a shape."""

    corners: np.ndarray  # (F, K, 3) float64; for a disk or a flat mesh, of a rectangle around it
    normal: np.ndarray | None  # (F, 3) unit; None: fixed faces, which share corners and would leave gaps if moved
    depth: np.ndarray | None  # (F,) depth of the body that the face bounds; inf: it is a sheet
    glass: bool
    lamp: bool


def contacts(shapes: list[Faces], dtype) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Resolve contacts of faces of different shapes that lie in one plane, up to rounding, and overlap.

    Returns:
        For each shape, the moves (F, 3) that separate its faces from those they touch, (3,) zeros if they are fixed;
        and its margins (F,), 0 for lone faces.
    """
    moves = [np.zeros(3 if each.normal is None else each.normal.shape) for each in shapes]
    margins = [np.zeros(len(each.corners)) for each in shapes]
    size = max((end for each in shapes for end in (each.corners.max(), -each.corners.min())), default=0)
    movable = [i for i, each in enumerate(shapes) if each.normal is not None]
    fixed = [i for i, each in enumerate(shapes) if each.normal is None]
    eps = np.finfo(dtype).eps
    # Points are projected onto planes. In a plane through the origin this leaves an error of second order in eps.
    least = MARGIN * (eps * eps) * size
    for others in (movable, fixed):
        for i, row, j, partners, margin in _coplanar(shapes, movable, others, least, dtype):
            mine, other = _face(shapes[i], row), _face(shapes[j], partners[0])
            gap = min(_GAP * eps * size, mine.depth / 4)
            if _yields(mine, other):
                moves[i][row] = mine.normal * (gap if np.isinf(mine.depth) and not mine.glass else -gap)
            elif not _yields(other, mine):
                margins[i][row] = max(margins[i][row], margin.max())
                margins[j][partners] = np.maximum(margins[j][partners], margin)
            elif others is fixed:
                moves[i][row] = other.normal * gap
    return moves, margins


class _Face(NamedTuple):
    normal: np.ndarray  # (3,)
    depth: float
    glass: bool
    lamp: bool


def _face(faces: Faces, row) -> _Face:
    if faces.normal is None:
        return _Face(unit_normal(faces.corners[row]), np.inf, faces.glass, faces.lamp)
    return _Face(faces.normal[row], faces.depth[row], faces.glass, faces.lamp)


def _yields(face: _Face, other: _Face) -> bool:
    """Return whether a face is moved away from another one that it coincides with."""
    body, other_body = np.isfinite(face.depth), np.isfinite(other.depth)
    if face.glass:
        return True
    if body:  # two bodies move apart if they are side by side, not if one is inside the other
        return not other_body or face.normal @ other.normal < 0
    return face.lamp and not (other.lamp or other.glass or other_body)


def unit_normal(vertices):
    """Return the unit normals (..., 3) of triangles (..., 3, 3)."""
    n = np.cross(vertices[..., 1, :] - vertices[..., 0, :], vertices[..., 2, :] - vertices[..., 0, :])
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def margins_of_alike(keys: np.ndarray, reach: np.ndarray, dtype) -> np.ndarray:
    """Return margins (P,) of round primitives: 0 for those that coincide with no other one of their kind.

    Args:
        keys: (P, K), equal for primitives in the same place; reach: (P,) largest magnitude of their coordinates.
    """
    margins = np.zeros(len(keys))
    pairs = close_pairs(keys, precision(dtype) * reach.max(initial=0))
    margins[pairs] = 2 * MARGIN * np.finfo(dtype).eps * reach[pairs]
    return margins


def close_pairs(points: np.ndarray, distance: float) -> np.ndarray:
    """Return the pairs (M, 2) of points (N, K) that lie within a distance of each other.

    Points are sorted along a random direction, to which no regular arrangement is perpendicular, so only the few
    neighbours in that order can be close. (SciPy's tree takes a quarter of a second to import.)
    """
    direction = np.random.default_rng(0).normal(size=points.shape[1])
    along = points @ (direction / np.linalg.norm(direction))
    order = np.argsort(along)
    pairs = [np.empty((0, 2), int)]
    for shift in range(1, len(points)):
        both = np.stack([order[:-shift], order[shift:]], 1)
        # 3 times the distance, since positions along the direction are rounded.
        both = both[np.diff(along[both])[:, 0] <= 3 * distance]
        if not len(both):
            break
        first, second = points[both].swapaxes(0, 1)
        pairs.append(both[np.linalg.norm(first - second, axis=1) <= distance])
    return np.concatenate(pairs)


def precision(dtype):
    """Return the relative difference up to which coordinates, rounded by transforms, may round to the same value."""
    return np.finfo(dtype).eps / 2 + 8 * np.finfo(np.float64).eps


def _coplanar(shapes: list[Faces], movable, others, least, dtype):
    """Yield each movable face with each other that it touches: i, row, j, rows (N,), margins (N,) that clear both.

    Args:
        movable, others: indices i and j of shapes; least: constant part of a margin.
    """
    if not movable or not others:
        return
    low, high = map(np.concatenate, zip(*(_ends(shapes[i].corners) for i in movable), strict=True))
    slack = precision(dtype) * np.maximum(np.abs(low), np.abs(high))
    bottoms, tops = low - slack, high + slack
    points = np.concatenate([shapes[i].corners[:, 0] for i in movable])
    normals = np.concatenate([shapes[i].normal for i in movable])
    near_by = [_near_any(shapes[j].corners, bottoms, tops, points, normals, precision(dtype)) for j in others]
    owner, rows = np.repeat(others, [len(each) for each in near_by]), np.concatenate(near_by)
    if not len(rows):
        return
    corners = np.concatenate([shapes[j].corners[each] for j, each in zip(others, near_by, strict=True)])
    lo, hi = _ends(corners)
    longest = (hi - lo).max(0)

    @cache
    def by_lower_end(axis):
        order = np.argsort(lo[:, axis])
        return order, lo[order, axis]

    for i in movable:
        for row, (mine, normal) in enumerate(zip(shapes[i].corners, shapes[i].normal, strict=True)):
            slack = precision(dtype) * np.abs(mine).max(0)
            bottom, top = mine.min(0) - slack, mine.max(0) + slack
            # Candidates that overlap along an axis are a range, short where the face is thin, except for floor tiles.
            for axis in np.argsort(top - bottom):
                order, ends = by_lower_end(axis)
                start, stop = np.searchsorted(ends, (bottom[axis] - longest[axis], np.nextafter(top[axis], np.inf)))
                if stop - start < len(ends) / 10:
                    break
            near = order[start:stop]
            near = near[(lo[near] <= top).all(1) & (hi[near] >= bottom).all(1) & (owner[near] != i)]
            # Magnitude of the coordinates along the normal, to which rounding is relative.
            reach = (np.abs(mine).max(0) + np.abs(corners[near]).max(1)) @ np.abs(normal)
            within = np.abs((corners[near] - mine[0]) @ normal).max(1, initial=0) <= precision(dtype) * reach
            near, margin = near[within], least + MARGIN * np.finfo(dtype).eps * reach[within]
            for j in np.unique(owner[near]):
                touches = owner[near] == j
                partners = rows[near[touches]], margin[touches]
                # The faces of a body are handled one by one; those of a fixed mesh are treated alike, as one group.
                groups = zip(*partners, strict=True) if shapes[j].normal is not None else [partners]
                yield from ((i, row, j, *map(np.atleast_1d, group)) for group in groups)


def _near_any(corners, bottoms, tops, points, normals, tolerance):
    """Return the rows of the faces (F, K, 3) that may lie in the plane of a box that overlaps the faces' bounds.

    Few triangles of a large mesh are near the plane on which it stands.

    Args:
        bottoms, tops: (M, 3) the boxes; points, normals: (M, 3) a point of each plane, and its unit normal.
        tolerance: relative, of `precision`.
    """
    columns = np.moveaxis(corners, 2, 0)
    low, high = (np.array([end(c) for c in columns]) for end in (np.min, np.max))
    reached = (bottoms <= high).all(1) & (tops >= low).all(1)
    if not reached.any():
        return np.zeros(0, np.int64)
    bottom, top = bottoms[reached].min(0), tops[reached].max(0)
    rows = np.arange(len(corners))
    if len(rows) >= SMALL and np.count_nonzero(reached) <= MOST_PLANES:
        rows = _in_any_plane(corners[:, 0], points[reached], normals[reached], tolerance)
    for axis in np.argsort(top - bottom):
        ends = np.moveaxis(columns[axis] if len(rows) == len(corners) else columns[axis, rows], 1, 0)
        reaches = (reduce(np.logical_or, flags) for flags in (ends <= top[axis], ends >= bottom[axis]))
        rows = rows[np.logical_and(*reaches)]
    return rows


def _in_any_plane(corners, points, normals, tolerance):
    """Return the rows of the corners (F, 3) that lie in any of the planes, up to rounding."""

    def within(begin):
        x, y, z = np.ascontiguousarray(corners[begin : begin + BLOCK].T)
        farthest = [np.abs(column).max() for column in (x, y, z)]
        found = np.zeros(len(x), bool)
        for point, n in zip(points, normals, strict=True):
            # Twice: these sums are rounded, and in another order than the sums of the final test.
            reach = 2 * tolerance * ((np.abs(point) + farthest) @ np.abs(n))
            found |= np.abs(n[0] * x + n[1] * y + n[2] * z - point @ n) <= reach
        return begin + np.flatnonzero(found)

    with over_cores(len(corners)) as run:
        return np.concatenate(list(run(within, range(0, len(corners), BLOCK))))


def _ends(corners):
    """Return the lower and upper ends (F, 3) of faces (F, K, 3)."""
    return [reduce(end, np.moveaxis(corners, 1, 0)) for end in (np.minimum, np.maximum)]
