"""Surfaces that lie in one another, found when a scene is built, so that rays leave all of them and see the right one.

The primitive that a ray starts on is excluded by number, and a lone rectangle, disk or sphere needs no more. Where
another one lies in the same place, the origin as it was rounded may be on the far side of that one. There, and only
there, so that sheets may be as thin as elsewhere, origins are moved along the normal by a margin that covers the
rounding of both.

Some pairs have an order, and are parted by a gap that rounding cannot close, which costs nothing afterwards: there is
air between a body and what it touches, and a lamp that lies in a wall shines from it. So a cube and glass shrink by the
gap, and a sheet that shines comes forward. Meshes that are not flat stay as they are, and are not compared with each
other.
"""

from __future__ import annotations

from functools import cache, reduce
from typing import NamedTuple

import numpy as np

from pathjax.system.cores import SMALL, over_cores

# In machine epsilons of the coordinates along the normal, for each of the two primitives: an upper bound on what its
# point, its plane and a distance from that lose by rounding (see `planar.leaf_numbers`).
MARGIN = 4
# In machine epsilons of the scene's size, since rays come from anywhere in it.
_GAP = 8
# Of a large mesh all faces are compared with so many planes; for more of them, sorting the faces takes less.
MOST_PLANES = 64
BLOCK = 1 << 13  # of them at a time: their numbers stay in the cache


class Faces(NamedTuple):
    """The flat faces of a shape."""

    corners: np.ndarray  # (F, K, 3) float64; of a disk or a flat mesh those of a rectangle around it
    normal: np.ndarray | None  # (F, 3) unit; None: they are fixed, share corners with others and would gape if moved
    depth: np.ndarray | None  # (F,) of the body that the face closes; inf: it is a sheet
    glass: bool
    lamp: bool


def contacts(shapes: list[Faces], dtype) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """What is to be done about faces of different shapes that lie in one plane, up to rounding, and overlap.

    Returns:
        By shape the moves (F, 3) that part its faces from what they touch, (3,) zeros if they are fixed; and its
        margins (F,), 0 for lone faces.
    """
    moves = [np.zeros(3 if each.normal is None else each.normal.shape) for each in shapes]
    margins = [np.zeros(len(each.corners)) for each in shapes]
    size = max((end for each in shapes for end in (each.corners.max(), -each.corners.min())), default=0)
    movable = [i for i, each in enumerate(shapes) if each.normal is not None]
    fixed = [i for i, each in enumerate(shapes) if each.normal is None]
    eps = np.finfo(dtype).eps
    # Points are projected onto planes, which in one through the origin leaves what a rounding is of a rounding.
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
    """Whether a face makes way for another one that lies in it."""
    body, other_body = np.isfinite(face.depth), np.isfinite(other.depth)
    if face.glass:
        return True
    if body:  # two bodies side by side, but not one in the other
        return not other_body or face.normal @ other.normal < 0
    return face.lamp and not (other.lamp or other.glass or other_body)


def unit_normal(vertices):
    """(..., 3, 3) -> (..., 3) of triangles."""
    n = np.cross(vertices[..., 1, :] - vertices[..., 0, :], vertices[..., 2, :] - vertices[..., 0, :])
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def margins_of_alike(keys: np.ndarray, reach: np.ndarray, dtype) -> np.ndarray:
    """Margins (P,) of round primitives: 0 for those that coincide with no other one of their kind.

    Args:
        keys: (P, K), the same numbers for primitives in the same place; reach: (P,) largest size of their coordinates.
    """
    margins = np.zeros(len(keys))
    pairs = close_pairs(keys, precision(dtype) * reach.max(initial=0))
    margins[pairs] = 2 * MARGIN * np.finfo(dtype).eps * reach[pairs]
    return margins


def close_pairs(points: np.ndarray, distance: float) -> np.ndarray:
    """(M, 2) pairs of the points (N, K) that lie so close to each other.

    Points are sorted along a direction that is drawn, to which no regular arrangement is perpendicular: so the few
    neighbours there are all that may be close. (SciPy's tree takes a quarter of a second to import.)
    """
    direction = np.random.default_rng(0).normal(size=points.shape[1])
    along = points @ (direction / np.linalg.norm(direction))
    order = np.argsort(along)
    pairs = [np.empty((0, 2), int)]
    for shift in range(1, len(points)):
        both = np.stack([order[:-shift], order[shift:]], 1)
        # Thrice, since places along the direction are rounded.
        both = both[np.diff(along[both])[:, 0] <= 3 * distance]
        if not len(both):
            break
        first, second = points[both].swapaxes(0, 1)
        pairs.append(both[np.linalg.norm(first - second, axis=1) <= distance])
    return np.concatenate(pairs)


def precision(dtype):
    """Relative difference up to which coordinates may round to the same number, after transforms have rounded them."""
    return np.finfo(dtype).eps / 2 + 8 * np.finfo(np.float64).eps


def _coplanar(shapes: list[Faces], movable, others, least, dtype):
    """For each movable face and each of the others that it touches: i, row, j, rows (N,), margins (N,) that clear both.

    Args:
        movable, others: numbers i and j of shapes; least: margin to begin with.
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
            # What may overlap along an axis is a range. It is short where the face is thin, but for tiles of a floor.
            for axis in np.argsort(top - bottom):
                order, ends = by_lower_end(axis)
                start, stop = np.searchsorted(ends, (bottom[axis] - longest[axis], np.nextafter(top[axis], np.inf)))
                if stop - start < len(ends) / 10:
                    break
            near = order[start:stop]
            near = near[(lo[near] <= top).all(1) & (hi[near] >= bottom).all(1) & (owner[near] != i)]
            # The size of coordinates along the normal, to which rounding is relative.
            reach = (np.abs(mine).max(0) + np.abs(corners[near]).max(1)) @ np.abs(normal)
            within = np.abs((corners[near] - mine[0]) @ normal).max(1, initial=0) <= precision(dtype) * reach
            near, margin = near[within], least + MARGIN * np.finfo(dtype).eps * reach[within]
            for j in np.unique(owner[near]):
                touches = owner[near] == j
                partners = rows[near[touches]], margin[touches]
                # The faces of a body differ from each other, and those of a mesh that stays in place are alike here.
                groups = zip(*partners, strict=True) if shapes[j].normal is not None else [partners]
                yield from ((i, row, j, *map(np.atleast_1d, group)) for group in groups)


def _near_any(corners, bottoms, tops, points, normals, tolerance):
    """Return the rows of the faces (F, K, 3) that may lie in the plane of a box that reaches the faces' own.

    Few triangles of a large mesh are near what it stands on.

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
    """Rows of the corners (F, 3) that lie in any of the planes, up to what rounding may be."""

    def within(begin):
        x, y, z = np.ascontiguousarray(corners[begin : begin + BLOCK].T)
        farthest = [np.abs(column).max() for column in (x, y, z)]
        found = np.zeros(len(x), bool)
        for point, n in zip(points, normals, strict=True):
            # Twice: these sums are rounded, and have other orders than those that decide.
            reach = 2 * tolerance * ((np.abs(point) + farthest) @ np.abs(n))
            found |= np.abs(n[0] * x + n[1] * y + n[2] * z - point @ n) <= reach
        return begin + np.flatnonzero(found)

    with over_cores(len(corners)) as run:
        return np.concatenate(list(run(within, range(0, len(corners), BLOCK))))


def _ends(corners):
    """(F, K, 3) -> lower and upper ends (F, 3)."""
    return [reduce(end, np.moveaxis(corners, 1, 0)) for end in (np.minimum, np.maximum)]
