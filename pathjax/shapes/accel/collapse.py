"""Collapse of a binary tree to eight children per node, and its layout for `traverse`.

The collapse minimises the expected cost by dynamic programming (Ylitie, Karras, Laine 2017, "Efficient incoherent ray
traversal on GPUs through compressed wide BVHs", section 3).
"""

from __future__ import annotations

import numpy as np

from pathjax.shapes.accel.binary import THICKNESS, half_area, sorted_by
from pathjax.system.cores import over_cores


def widen(box, left, start, count, levels, leaf_of, width):
    """Collapse the binary tree to `width` children per node, lay it out depth first, and return the `Tree` fields."""
    order = sorted_by(np.arange(len(leaf_of)), start[leaf_of])
    leaves = sorted_by(np.arange(len(left)), start)
    leaves = leaves[left[leaves] == 0]
    bounds = np.empty((2, 3, len(left)), np.float32)

    def bound(side, axis):
        ufunc = (np.minimum, np.maximum)[side]
        bounds[side, axis, leaves] = ufunc.reduceat(box[side, axis, order], start[leaves])

    with over_cores(len(order)) as run:
        list(run(bound, *np.indices((2, 3)).reshape(2, -1)))
    for level in levels[::-1]:
        k = np.flatnonzero(left[level]) + level.start
        bounds[0][:, k] = np.minimum(bounds[0][:, left[k]], bounds[0][:, left[k] + 1])
        bounds[1][:, k] = np.maximum(bounds[1][:, left[k]], bounds[1][:, left[k] + 1])
    extent = bounds[1].astype(np.float64) - bounds[0]
    scale = extent[:, 0].max() or 1
    area = half_area(*(extent / scale + THICKNESS))

    parent = collapse(left, levels, area, width)                   # -1: merged into the node above
    is_node = (left > 0) & (parent >= 0)
    is_node[0] = True
    wide = np.flatnonzero(is_node)
    wide = wide[np.lexsort((-count[wide], start[wide]))]
    code = np.zeros(len(left), np.int64)                           # as in Tree.child
    code[leaves] = ~np.arange(len(leaves))
    row = np.zeros(len(left), np.int64)
    row[wide] = np.arange(len(wide))
    kids = np.flatnonzero(parent >= 0) if left[0] else np.zeros(1, np.int64)
    code[left > 0] = row[left > 0]
    up = row[parent[kids]] if left[0] else kids
    middle = bounds.mean(0, dtype=np.float64) / scale
    slot = place_children(up, middle[:, kids] - middle[:, wide[up]], len(wide))
    child = np.zeros((len(wide), 8), np.int32)
    child[up, slot] = code[kids]
    slots = np.full((len(wide), 2, 3, 8), np.nan, np.float32)
    slots[up, :, :, slot] = bounds[:, :, kids].transpose(2, 0, 1)
    depth, below = 1, child[0][child[0] > 0]
    while len(below):
        depth, below = depth + 1, child[below][child[below] > 0]
    cost = (area[wide].sum() + area[leaves].sum()) / area[0]
    return (slots, child, start[leaves].astype(np.int32), count[leaves].astype(np.int32), order.astype(np.int32),
            depth, float(cost))


def collapse(left, levels, area, width):
    """Choose the binary nodes that become wide nodes, for the least sum of their areas (Ylitie et al. 2017, 3.1).

    Returns: (B,) int64, the wide parent (by its binary index) of each node; -1 for the root and for nodes that are
    merged into the wide node above.
    """
    cost = np.zeros((width + 1, len(left)))                        # [i]: area of the wide nodes in up to i children
    share = np.zeros((width + 1, len(left)), np.int8)              # how many of the i lie on the left; [1]: as a node
    for level in levels[::-1]:
        k = np.flatnonzero(left[level]) + level.start
        x, y = cost[:, left[k]], cost[:, left[k] + 1]
        for i in range(2, width + 1):
            least, ways = x[1] + y[i - 1], np.ones(len(k), np.int8)
            for j in range(2, i):
                other = x[j] + y[i - j]
                ways = np.where(other < least, np.int8(j), ways)
                least = np.minimum(least, other)
            cost[i, k], share[i, k] = least, ways
        cost[1, k], share[1, k] = area[k] + least, ways
        for i in range(2, width + 1):                              # fewer children may be cheaper
            worse = cost[i, k] >= cost[i - 1, k]
            cost[i, k] = np.where(worse, cost[i - 1, k], cost[i, k])
            share[i, k] = np.where(worse, 0, share[i, k])
    parent, owner = np.full((2, len(left)), -1)
    budget = np.zeros(len(left), np.int64)                         # maximum number of children a node is split into
    budget[0] = 1
    for level in levels[:-1]:
        k = np.arange(level.start, level.stop)
        i = budget[k]
        for j in range(width, 1, -1):
            i = np.where((i == j) & (share[j, k] == 0), j - 1, i)
        whole = i == 1
        parent[k[whole]] = owner[k[whole]]
        inner = left[k] > 0
        k, i, whole = k[inner], i[inner], whole[inner]
        budget[left[k]] = share[i, k]
        budget[left[k] + 1] = np.where(whole, width, i) - share[i, k]
        owner[left[k]] = owner[left[k] + 1] = np.where(whole, k, owner[k])
    k = np.arange(levels[-1].start, levels[-1].stop)
    parent[k] = owner[k]
    return parent


def place_children(parent, offset, n):
    """Choose slots: rays of direction octant s should visit slot s first (Ylitie et al. 2017, section 3.2; greedy).

    Args:
        parent: (C,) parent of each child, one of n nodes.
        offset: (3, C) from the middle of the parent to that of the child.
    Returns: (C,) int64, distinct within each parent.
    """
    by = np.argsort(parent, kind="stable")
    up = parent[by]
    which = np.arange(len(up)) - np.searchsorted(up, up)
    sign = 1 - 2 * (np.arange(8) >> np.arange(3)[:, None] & 1)     # (axis, slot)
    cost = np.full((n, 8, 8), np.inf, np.float32)                  # [node, child, slot]
    cost[up, which] = offset[:, by].T @ sign
    slot = np.empty((n, 8), np.int64)
    node = np.arange(n)
    for _ in range(8):
        c, s = np.divmod(cost.reshape(n, 64).argmin(1), 8)
        real = cost[node, c, s] < np.inf
        slot[node[real], c[real]] = s[real]
        cost[node, c] = np.inf
        cost[node, :, s] = np.inf
    result = np.empty(len(parent), np.int64)
    result[by] = slot[up, which]
    return result
