"""How many tests rays cost in a hierarchy: a walk down it in the order of the renderer, in NumPy, for many rays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TINY = 1e-18
# Relative error of entry and exit: a few roundings, of subtraction, reciprocal and product.
SLACK = 5 * np.finfo(float).eps


class Walk(NamedTuple):
    """What R rays found, and what they tested on the way."""

    t: np.ndarray  # (R,) distance to the closest triangle, inf where missed
    triangle: np.ndarray  # (R,) its row, -1 where missed
    nodes: np.ndarray  # (R,) nodes opened; the renderer tests the up to eight boxes of a node at once
    boxes: np.ndarray  # (R,) boxes tested: the children of those nodes
    leaves: np.ndarray  # (R,) leaves visited; the renderer tests the triangles of a leaf at once
    triangles: np.ndarray  # (R,) triangles tested


def walk(tree, vertices, origins, directions) -> Walk:
    """Find what each ray hits first, as `shapes.accel.traverse` does it.

    Children are visited in octant order, those whose boxes the ray meets before its closest hit so far; they are not
    looked at again when a closer hit is found in between.

    Args:
        tree: `shapes.accel.build.Tree` over the triangles.
        vertices: (P, 3, 3) vertex, axis.
        origins, directions: (R, 3), directions unit.
    The arithmetic is float64: boxes that a ray grazes may be counted otherwise than by a renderer in float32.
    """
    vertices, o, d = (np.asarray(x, float) for x in (vertices, origins, directions))
    rays = len(o)
    # A component of zero becomes one that moves the ray less than rounding does.
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
        for k in range(7, -1, -1):  # the nearest comes to lie on top
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
    """Distances to the triangles (..., 3, 3) along the rays o, d (..., 3): inf: missed (Möller and Trumbore 1997)."""
    edge1, edge2 = vertices[..., 1, :] - vertices[..., 0, :], vertices[..., 2, :] - vertices[..., 0, :]
    s = o - vertices[..., 0, :]
    h, q = np.cross(d, edge2), np.cross(s, edge1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sum(edge1 * h, -1)
        b1, b2, t = (scale * np.sum(a * b, -1) for a, b in ((s, h), (d, q), (edge2, q)))
        return np.where((b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (t > 0), t, np.inf)


def _meets(bounds, o, inverse, t):
    """(R, 8) whether rays meet the boxes (R, 2, 3, 8) before t (R,); never an empty slot, whose bounds are NaN."""
    a, b = (np.moveaxis(bounds, 1, 0) - o[:, :, None]) * inverse[:, :, None]
    near, far = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.maximum(near, 0) <= np.minimum(far, t[:, None]) * (1 + SLACK)
