"""Triangulation of polygons and strips."""

from __future__ import annotations

import mapbox_earcut
import numpy as np


def triangles(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, int]:
    """Cut polygons into triangles that cover them once, in the order and with the winding of the polygons.

    A polygon is projected along the axis nearest to its normal (Newell's, the sum of its edges' cross products), even
    if it is not planar. The fan around its first corner is used if it covers the projection once; otherwise ears are
    cut (mapbox_earcut), which keeps corners on straight edges, so that neighbours that share them fit. If neither
    covers a polygon, because it crosses itself, the one with the smaller error in area is used.

    Args:
        vertices: (V, 3) float64.
        corners: (C,) vertex indices of the polygons, one polygon after the other.
        sizes: (F,) number of corners of each polygon, at least 3.
    Returns:
        (T, 3) vertex indices of the triangles, and the number of polygons that cross themselves.
    """
    if (sizes == 3).all():
        return corners.reshape(-1, 3), 0
    first = np.cumsum(sizes) - sizes
    owner, number = enumerated(sizes - 2)
    faces = corners[first[owner, None] + np.stack([np.zeros_like(number), number + 1, number + 2], axis=1)]

    # The cross products of a fan sum to Newell's normal; if all have the same sign, the fan covers the polygon once.
    large = np.flatnonzero(sizes[owner] > 3)
    fans, fan_owner = faces[large], owner[large]
    doubled = _area_vectors(vertices, fans)
    normals = np.stack([np.bincount(fan_owner, column, len(sizes)) for column in doubled])
    axis = np.abs(normals).argmax(axis=0)
    area = normals[axis, np.arange(len(sizes))]  # twice the signed area of the projections
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
        flat = vertices[own][:, [x, y] if area[polygon] > 0 else [y, x]]  # from the side where it is counterclockwise
        flat = np.ascontiguousarray(flat - flat[0])
        cuts.append(own[mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3)])
    cut, cut_owner = np.concatenate(cuts), np.repeat(unfit, [len(each) for each in cuts])
    seen = _area_vectors(vertices, cut)[axis[cut_owner], np.arange(len(cut))]
    covered = np.bincount(cut_owner, np.abs(seen), len(sizes))[unfit]
    off, fan_off = np.abs(covered - np.abs(area[unfit])), np.abs(fan_covered - np.abs(area))[unfit]
    # Differences below the precision of float32, in which rays are traced, are due to rounding.
    crossing = (off > np.finfo(np.float32).eps * covered) | (covered == 0)
    eared = np.isin(np.arange(len(sizes)), unfit[~crossing | (off < fan_off)])
    kept, new = ~eared[owner], eared[cut_owner]
    order = np.argsort(np.concatenate([owner[kept], cut_owner[new]]), kind="stable")
    return np.concatenate([faces[kept], cut[new]])[order], int(crossing.sum())


def strips(corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return (T, 3) triangles of strips, every second one reversed; those with a repeated corner are dropped."""
    owner, number = enumerated(np.maximum(sizes - 2, 0))
    place = (np.cumsum(sizes) - sizes)[owner] + number
    odd = number % 2
    faces = corners[np.stack([place, place + 1 + odd, place + 2 - odd], axis=1)]
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def enumerated(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the group of each member and its index within the group, for groups of these sizes."""
    group = np.repeat(np.arange(len(sizes)), sizes)
    return group, np.arange(len(group)) - (np.cumsum(sizes) - sizes)[group]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cross products of columns, (3, N) each; faster than NumPy's."""
    return np.stack([a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)])


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (3, T) normals of length twice the area."""
    a, b, c = (np.take(vertices.T, corner, axis=1) for corner in faces.T)
    return cross(b - a, c - a)
