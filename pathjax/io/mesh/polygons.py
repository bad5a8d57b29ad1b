"""Polygons and strips cut into triangles."""

from __future__ import annotations

import mapbox_earcut
import numpy as np


def triangles(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, int]:
    """Cut polygons into triangles that cover them once, in the order and with the winding of the polygons.

    A polygon is looked at along the axis nearest to its normal (Newell's, the sum of its edges' cross products); one
    that is not planar is cut as its projection is. The fan around its first corner is taken where it covers the
    polygon; otherwise ears are cut (mapbox_earcut), which keeps corners on straight edges, so that neighbours that
    share them fit. Where neither covers a polygon, because it crosses itself, the one that misses its area by less is
    taken.

    Args:
        vertices: (V, 3) float64.
        corners: (C,) vertices of the polygons, one polygon after the other.
        sizes: (F,) corners of each polygon, at least 3.
    Returns:
        (T, 3) vertices of the triangles, and the number of polygons that cross themselves.
    """
    if (sizes == 3).all():
        return corners.reshape(-1, 3), 0
    first = np.cumsum(sizes) - sizes
    owner, number = enumerated(sizes - 2)
    faces = corners[first[owner, None] + np.stack([np.zeros_like(number), number + 1, number + 2], axis=1)]

    # The cross products of a fan add up to Newell's normal; all of one sign, they cover the polygon once.
    large = np.flatnonzero(sizes[owner] > 3)
    fans, fan_owner = faces[large], owner[large]
    doubled = _area_vectors(vertices, fans)
    normals = np.stack([np.bincount(fan_owner, column, len(sizes)) for column in doubled])
    axis = np.abs(normals).argmax(axis=0)
    area = normals[axis, np.arange(len(sizes))]  # twice, of the projections
    seen = doubled[axis[fan_owner], np.arange(len(fans))] * np.sign(area)[fan_owner]
    repeated = (fans == np.roll(fans, 1, axis=1)).any(axis=1)
    surface = np.bincount(fan_owner, doubled.any(axis=0), len(sizes)) > 0
    fan_covered = np.bincount(fan_owner, np.abs(seen), len(sizes))
    unfit = np.unique(fan_owner[(seen <= 0) & ~repeated & surface[fan_owner]])
    if not unfit.size:
        return faces, 0

    cuts = []
    for polygon in unfit:
        own = corners[first[polygon] : first[polygon] + sizes[polygon]]
        x, y = (axis[polygon] + 1) % 3, (axis[polygon] + 2) % 3
        flat = vertices[own][:, [x, y] if area[polygon] > 0 else [y, x]]  # seen from where it runs counterclockwise
        flat = np.ascontiguousarray(flat - flat[0])
        cuts.append(own[mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3)])
    cut, cut_owner = np.concatenate(cuts), np.repeat(unfit, [len(each) for each in cuts])
    seen = _area_vectors(vertices, cut)[axis[cut_owner], np.arange(len(cut))]
    covered = np.bincount(cut_owner, np.abs(seen), len(sizes))[unfit]
    off, fan_off = np.abs(covered - np.abs(area[unfit])), np.abs(fan_covered - np.abs(area))[unfit]
    # Rounding explains a difference no larger than what float32, in which all is traced, does not tell.
    crossing = (off > np.finfo(np.float32).eps * covered) | (covered == 0)
    eared = np.isin(np.arange(len(sizes)), unfit[~crossing | (off < fan_off)])
    kept, new = ~eared[owner], eared[cut_owner]
    order = np.argsort(np.concatenate([owner[kept], cut_owner[new]]), kind="stable")
    return np.concatenate([faces[kept], cut[new]])[order], int(crossing.sum())


def strips(corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(T, 3) triangles of strips, whose every second one is wound the other way; repeated corners only turn a strip."""
    owner, number = enumerated(np.maximum(sizes - 2, 0))
    place = (np.cumsum(sizes) - sizes)[owner] + number
    odd = number % 2
    faces = corners[np.stack([place, place + 1 + odd, place + 2 - odd], axis=1)]
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def enumerated(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For groups of so many members: of each member its group, and its place within the group."""
    group = np.repeat(np.arange(len(sizes)), sizes)
    return group, np.arange(len(group)) - (np.cumsum(sizes) - sizes)[group]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of columns, (3, N) each; NumPy's own are slower."""
    return np.stack([a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)])


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(3, T) twice the area along the normal."""
    a, b, c = (np.take(vertices.T, corner, axis=1) for corner in faces.T)
    return cross(b - a, c - a)
