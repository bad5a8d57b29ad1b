"""Form factors of polygons: exact from points, Gauss-Legendre over the points, rays for visibility.

The share of the light of a point x with normal n that goes straight to a polygon is (Lambert 1760)

    sum over its edges of  angle * n . axis / 2 pi,

with the angle and axis of the rotation from one end of the edge to the other as seen from x, for the part of the
polygon above the horizon of x. Shares of all polygons around x sum to 1 exactly, so a closed scene loses no light,
whatever the quadrature.
"""

from __future__ import annotations

import math
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.compile import compute_once, native_map
from pathjax.core import sampler
from pathjax.core.math import dot, larger, safe_divide, safe_sqrt, spawn_ray
from pathjax.core.types import Surface
from pathjax.errors import InputError
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry
from pathjax.transport.patches import Patches, point

# Quadrature points along each side of a patch: _FEW, or _MANY for pairs closer than _NEAR times the sum of their radii,
# where a cubic does not fit the share. The difference between the two directions estimates the remaining error.
_FEW, _MANY, _NEAR = 2, 6, 3
# A patch that misses less of its light than this misses none: corners are rounded, to float32 in most scenes.
_MISSED = 1e-5
# Pairs at a time: their data stay in the second-level cache.
_BLOCK = 1 << 15
# With more primitives than this, they are not tested one by one: any pair may be hidden.
MOST_BLOCKERS = 64


def are_exact(scene: Scene) -> bool:
    """Return whether all shapes are polygons, or one sphere, so that the form factors have a closed form."""
    return _one_sphere(scene) or all(table.polygons for table in scene.geometry.tables)


def _one_sphere(scene) -> bool:
    tables = scene.geometry.tables
    return len(tables) == 1 and tables[0].even_chords and tables[0].count == 1


def form_factors(scene: Scene, patches: Patches, rays: int, seed: int) -> tuple[np.ndarray, np.ndarray, bool | None]:
    """Return the form factors times the areas of their rows.

    Args:
        rays: rays per pair of patches that something may hide from each other.
    Returns:
        A_i F_ij (U, U), symmetric; its errors (U, U), from half the difference of the two directions and from
        visibility; whether the scene is closed, None if some patches may be hidden.
    Raises:
        InputError: curved shapes, except the inside of one sphere.
    """
    if not are_exact(scene):
        raise InputError('spheres and disks, but for the inside of one sphere alone, need method="rays"')
    if _one_sphere(scene):
        return _in_sphere(scene.geometry.tables[0], patches)
    planes = _planes(scene)
    corners, normals = _polygons(patches, *planes)
    area = np.asarray(patches.area, float)
    primitive = np.asarray(patches.primitive)[np.asarray(patches.cell)]
    one_way = area[:, None] * _shares(corners, normals, primitive)
    exchange, error = (one_way + one_way.T) / 2, np.abs(one_way - one_way.T) / 2
    # Coordinates are float32 in most scenes: points of a plane are off it by a few rounding errors.
    slack = 16 * np.finfo(patches.area.dtype).eps * np.abs(corners).max()
    pairs = np.argwhere(np.triu(_maybe_hidden(*planes, corners, normals, slack) & (exchange > 0)))
    closed = np.abs(one_way.sum(1) / area - 1).max() < _MISSED
    if len(pairs):
        closed = None
        i, j = pairs.T
        seen, seen_error = _visible(scene, patches, pairs, rays, seed)
        for a, b in ((i, j), (j, i)):
            error[a, b] = np.hypot(error[a, b] * seen, exchange[a, b] * seen_error)
        exchange[i, j] = exchange[j, i] = exchange[i, j] * seen
    return exchange, error, closed


def _in_sphere(table, patches):
    """Form factors inside a sphere: chords meet both ends at the same angle, so equal areas get equal shares."""
    inwards = np.asarray(patches.back) != table.turned_inwards
    area = np.where(inwards, np.asarray(patches.area, float), 0)
    exchange = np.outer(area, area) / table.areas()
    return exchange, np.zeros_like(exchange), bool(inwards.all())


# ---- patches as polygons --------------------------------------------------------------------------------------------


def _planes(scene):
    """Return corner and two edges of each primitive (Q, 3, 3), whether it is a triangle (Q,), unit normal (Q, 3)."""
    bases, triangular, normals = [], [], []
    for table in scene.geometry.tables:
        edges, n = table.edges_and_normals()
        bases.append(edges)
        normals.append(n / np.linalg.norm(n, axis=-1, keepdims=True))
        triangular.append(np.full(len(n), table.triangular))
    return tuple(np.concatenate(x) for x in (bases, triangular, normals))


def _steps(triangular):
    """Return the corners (4, N, 2) of a cell along its two edges; triangles repeat the last one."""
    square, triangle = ([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 0], [1, 0], [0, 1], [0, 1]])
    return np.where(triangular[:, None], np.array(triangle)[:, None], np.array(square)[:, None])


def _at(bases, xy):
    """Return the points (4, 3, N) at the coordinates (4, N, 2) of bases (N, 3, 3)."""
    return np.swapaxes(bases[:, 0] + xy[..., :1] * bases[:, 1] + xy[..., 1:] * bases[:, 2], 1, 2)


def _polygons(patches, bases, triangular, normals):
    """Return the corners (4, 3, U), in order, and unit normals (3, U) of the patches."""
    cell = np.asarray(patches.cell)
    primitive = np.asarray(patches.primitive)[cell]
    grid, place = np.asarray(patches.grid)[primitive], np.asarray(patches.place)[cell]
    triangular = triangular[primitive]
    corner = np.where(triangular[:, None], np.stack([place[:, 0], place[:, 1] // 2], -1), place)
    turned = triangular & (place[:, 1] % 2 == 1)
    steps = _steps(triangular)
    steps = np.where(turned[:, None], 1 - steps, steps)
    side = np.where(np.asarray(patches.back), -1, 1)
    return _at(bases[primitive], (corner + steps) / grid), (normals[primitive] * side[:, None]).T


def _points(corners, order):
    """Return quadrature nodes (order^2, 3, U) and weights (order^2, U), of sum 1, on parallelograms and triangles."""
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = (x + 1) / 2, w / 2
    s, t = (a.ravel()[:, None, None] for a in np.meshgrid(x, x))
    weights = np.outer(w, w).ravel()[:, None]
    a, b, last = corners[1] - corners[0], corners[3] - corners[0], corners[2] - corners[3]
    triangle = (last == 0).all(0)
    # The square is folded onto a triangle; the density of the fold goes into the weights.
    t_folded = np.where(triangle, t * (1 - s), t)
    weights = np.where(triangle, weights * 2 * (1 - s[:, 0]), weights)
    return corners[0] + s * a + t_folded * b, weights


def _shares(corners, normals, primitive):
    """Return the shares (U, U) of each patch's light that reach each patch of other primitives, without occlusion."""
    count = len(primitive)
    shares = np.empty((count, count))
    nodes, weights = _points(corners, _FEW)
    rows = max(_BLOCK // count, 1)
    for first in range(0, count, rows):
        i = slice(first, first + rows)
        total = 0
        for x, w in zip(nodes[:, :, i], weights[:, i], strict=True):
            total += w[:, None] * _share(x[..., None], normals[:, i, None], corners[:, :, None], normals[:, None])
        shares[i] = np.where(primitive[i, None] != primitive, total, 0)
    pairs = np.argwhere(_near(corners) & ((shares > 0) | (shares.T > 0)))
    for i, j in (part.T for part in np.split(pairs, range(_BLOCK, len(pairs), _BLOCK))):
        nodes, weights = _points(corners[:, :, i], _MANY)
        shares[i, j] = sum(
            w * _share(x, normals[:, i], corners[:, :, j], normals[:, j]) for x, w in zip(nodes, weights, strict=True)
        )
    return shares


def _near(corners):
    """Return (U, U) bool: whether two patches are close relative to their size."""
    center = corners.mean(0)
    radius = np.linalg.norm(corners - center, axis=1).max(0)
    squared = sum((x[:, None] - x) ** 2 for x in center)
    return squared < (_NEAR * (radius[:, None] + radius)) ** 2


def _share(x, n, corners, facing):
    """Return the share of the light of points that goes to polygons, by Lambert's formula; arguments broadcast.

    Args:
        x, n: (3, ...) points and their normals.
        corners: (4, 3, ...) of the polygons; facing: (3, ...) their normals.
    """
    r = [[corner[axis] - x[axis] for axis in range(3)] for corner in corners]
    heights = [_dot(n, a) for a in r]
    front = _dot(facing, r[0]) < 0
    lowest, highest = (reduce(op, heights) for op in (np.minimum, np.maximum))
    total = np.zeros(lowest.shape)
    clear = np.nonzero(front & (lowest >= 0) & (highest > 0))
    cut = np.nonzero(front & (lowest < 0) & (highest > 0))
    for place, edges in ((clear, _edges), (cut, _edges_above)):
        if len(place[0]):
            picked = [[np.broadcast_to(a, total.shape)[place] for a in corner] for corner in r]
            normal = [np.broadcast_to(a, total.shape)[place] for a in n]
            total[place] = sum(_turn(normal, a, b) for a, b in edges(picked, normal))
    return np.abs(total) / (2 * math.pi)


def _edges(r, n):
    return [(r[k], r[(k + 1) % 4]) for k in range(4)]


def _edges_above(r, n):
    """Return the edges of the part above the horizon: the polygon's edges, clipped, and the closing one on it."""
    edges, leave, enter = [], [0, 0, 0], [0, 0, 0]
    for a, b in _edges(r, n):
        ha, hb = _dot(n, a), _dot(n, b)
        t = np.where(ha != hb, ha / np.where(ha != hb, ha - hb, 1), 0)
        crossing = [p + t * (q - p) for p, q in zip(a, b, strict=True)]
        up, down = (ha <= 0) & (hb > 0), (ha > 0) & (hb <= 0)
        edges.append(
            (
                [np.where(up, c, np.where(ha > 0, p, 0)) for c, p in zip(crossing, a, strict=True)],
                [np.where(down, c, np.where(hb > 0, q, 0)) for c, q in zip(crossing, b, strict=True)],
            )
        )
        enter = [e + np.where(up, c, 0) for e, c in zip(enter, crossing, strict=True)]
        leave = [e + np.where(down, c, 0) for e, c in zip(leave, crossing, strict=True)]
    return [*edges, (leave, enter)]


def _turn(n, a, b):
    """Return the angle from a to b times the component of its axis along n; 0 if a or b is 0."""
    axis = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    length = np.sqrt(_dot(axis, axis))
    return np.arctan2(length, _dot(a, b)) * _dot(n, axis) / np.where(length > 0, length, 1)


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# ---- visibility -----------------------------------------------------------------------------------------------------


def _maybe_hidden(bases, triangular, planes, corners, normals, slack):
    """Return (U, U) bool: false if, for every primitive, a plane shows that it cannot come between two patches.

    Args:
        bases, triangular, planes: from `_planes`.
        corners, normals: from `_polygons`.
    """
    count = corners.shape[2]
    if len(bases) > MOST_BLOCKERS:
        return np.ones((count, count), bool)
    low, high = corners.min(0), corners.max(0)
    maybe = np.zeros((count, count), bool)
    for points, plane in zip(np.moveaxis(_at(bases, _steps(triangular)), 2, 0), planes, strict=True):
        # The primitive is behind one of the two, or both are on one side of its plane or of its box along an axis.
        behind = (np.tensordot(points, normals, 1) - _dot(normals, corners[0]) <= slack).all(0)
        clear = behind[:, None] | behind
        heights = np.tensordot(plane, corners, (0, 1)) - plane @ points[0]
        sides = [(heights >= -slack).all(0), (heights <= slack).all(0)]
        sides += [low[axis] > points[:, axis].max() for axis in range(3)]
        sides += [high[axis] < points[:, axis].min() for axis in range(3)]
        for side in sides:
            clear |= side[:, None] & side
        maybe |= ~clear
    return maybe


def _visible(scene, patches, pairs, rays, seed):
    """Return the unoccluded share (K,) of the light between the patches of each pair (K, 2), and its standard error.

    Even a unanimous result is not certain: if v m of m rays are seen, the error is that of a share (v m + 1) / (m + 2).
    """
    i, j = np.asarray(pairs, np.int32).T
    sums = _visibility(scene.geometry, patches, i, j, np.int32(rays), np.uint32(seed))
    seen, total, squares = (np.asarray(x, float) for x in sums)
    share = np.divide(seen, total, out=np.zeros_like(seen), where=total > 0)
    effective = np.divide(total**2, squares, out=np.ones_like(seen), where=squares > 0)
    likely = (share * effective + 1) / (effective + 2)
    return share, np.sqrt(likely * (1 - likely) / effective)


@jax.jit
def _visibility(shapes, patches, i, j, rays, seed):
    return native_map(_pair_visibility, (i, j), shapes, patches, rays, seed)


def _pair_visibility(work, shapes, patches, rays, seed):
    """Sum, over rays between two patches, the unoccluded light, the light without occlusion, and the latter squared."""
    i, j = work
    stream = sampler.combine(sampler.pixel_stream(seed, i), j)

    def add(number, sums):
        numbers = compute_once(sampler.lattice_point(stream, number, 0).astype(patches.area.dtype))
        u, v = numbers[:2], numbers[2:]
        primitive, p, n, margin = point(patches, shapes, i, u)
        target, q, n_target, _ = point(patches, shapes, j, v)
        squared = dot(q - p, q - p)
        distance = safe_sqrt(squared)
        d = (q - p) * safe_divide(1, distance)
        carried = larger(dot(n, d), 0) * larger(-dot(n_target, d), 0) * safe_divide(1, squared)
        # A shadow ray of negative length is not traced.
        ray = spawn_ray(Surface(p, n, margin, n, u), d, primitive)._replace(t_max=jnp.where(carried > 0, distance, -1))
        ray, carried = compute_once((ray, carried))
        seen = jnp.where(geometry.occluded(shapes, ray, target), 0, carried)
        return sums[0] + seen, sums[1] + carried, sums[2] + carried * carried

    zero = jnp.zeros((), patches.area.dtype)
    return lax.fori_loop(0, rays, add, (zero, zero, zero))
