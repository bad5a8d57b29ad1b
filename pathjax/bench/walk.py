"""Number of tests per ray in a hierarchy, counted by a NumPy traversal of many rays in the renderer's order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TINY = 1e-18
# Relative error of entry and exit distances: a few roundings, of subtraction, reciprocal and product.
SLACK = 5 * np.finfo(float).eps


class Walk(NamedTuple):
    """Hits of R rays, and the number of tests on the way."""

    t: np.ndarray  # (R,) distance to the closest triangle, inf for a miss
    triangle: np.ndarray  # (R,) its row, -1 for a miss
    nodes: np.ndarray  # (R,) nodes opened; the renderer tests the up to eight boxes of a node at once
    boxes: np.ndarray  # (R,) boxes tested: the children of those nodes
    leaves: np.ndarray  # (R,) leaves visited; the renderer tests the triangles of a leaf at once
    triangles: np.ndarray  # (R,) triangles tested


def walk(tree, vertices, origins, directions) -> Walk:
    """Find the closest hit of each ray, as `shapes.accel.traverse` does.

    Children whose boxes the ray meets before its closest hit so far are visited in octant order. They are not tested
    again if a closer hit is found in between.

    Args:
        tree: `shapes.accel.build.Tree` over the triangles.
        vertices: (P, 3, 3) vertex, axis.
        origins, directions: (R, 3), directions unit.
    The arithmetic is float64, so counts of grazed boxes may differ from those of the renderer in float32.
    """
    vertices, o, d = (np.asarray(x, float) for x in (vertices, origins, directions))
    rays = len(o)
    # Replace a zero component by one that moves the ray by less than rounding does.
    inverse = 1 / np.where(np.abs(d) < TINY, np.copysign(TINY, d), d)
    octant = (d < 0) @ np.array([1, 2, 4])
    t, triangle = np.full(rays, np.inf), np.full(rays, -1)
    nodes, boxes, leaves, triangles = np.zeros((4, rays), int)
    filled = (tree.child != 0).sum(1)
    # A path down the tree leaves at most 7 siblings behind at each level.
    stack, size = np.zeros((rays, 7 * tree.depth + 1), np.int32), np.ones(rays, int)

    active = np.arange(rays)
    while len(active):
        size[active] -= 1
        code = stack[active, size[active]]

        ray, node = active[code >= 0], code[code >= 0]
        nodes[ray] += 1
        boxes[ray] += filled[node]
        met = _meets(tree.bounds[node], o[ray], inverse[ray], t[ray])
        for k in range(7, -1, -1):  # so that the nearest is on top
            slot = k ^ octant[ray]
            push = np.flatnonzero(met[np.arange(len(ray)), slot])
            stack[ray[push], size[ray[push]]] = tree.child[node[push], slot[push]]
            size[ray[push]] += 1

        ray, leaf = active[code < 0], ~code[code < 0]
        count = tree.leaf_count[leaf]
        leaves[ray] += 1
        triangles[ray] += count
        for lane in range(count.max(initial=0)):
            filled_lane = lane < count
            r, row = ray[filled_lane], tree.order[tree.leaf_first[leaf[filled_lane]] + lane]
            found = distances(vertices[row], o[r], d[r])
            closer = (found < t[r]) | ((found == t[r]) & (row < triangle[r]))
            t[r[closer]], triangle[r[closer]] = found[closer], row[closer]
        active = active[size[active] > 0]
    return Walk(t, triangle, nodes, boxes, leaves, triangles)


def distances(vertices, o, d):
    """Return distances to triangles (..., 3, 3) along rays o, d (..., 3), inf for a miss (Möller and Trumbore 1997)."""
    edge1, edge2 = vertices[..., 1, :] - vertices[..., 0, :], vertices[..., 2, :] - vertices[..., 0, :]
    s = o - vertices[..., 0, :]
    h, q = np.cross(d, edge2), np.cross(s, edge1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sum(edge1 * h, -1)
        b1, b2, t = (scale * np.sum(a * b, -1) for a, b in ((s, h), (d, q), (edge2, q)))
        return np.where((b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (t > 0), t, np.inf)


def _meets(bounds, o, inverse, t):
    """Return (R, 8) bool: whether rays meet boxes (R, 2, 3, 8) before t (R,); False for empty slots, of NaN bounds."""
    a, b = (np.moveaxis(bounds, 1, 0) - o[:, :, None]) * inverse[:, :, None]
    near, far = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.maximum(near, 0) <= np.minimum(far, t[:, None]) * (1 + SLACK)
