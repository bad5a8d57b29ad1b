"""Bounding volume hierarchies with eight children to a node, built in NumPy.

Three stages: the bounds of the primitives (rounded outwards to float32), a binary tree over them (level by level, all
open nodes at once), and that tree collapsed to eight children a node and laid out for `bvh.py` to traverse.

The primitives stay sorted by centroid along each axis, so a split is an axis and a count whatever the rule, and
centroids that coincide are no special case. The surface area heuristic is evaluated at every position of every node
(Wald and Havran 2006, "On building fast kd-trees for ray tracing, and on doing that in O(N log N)"). The collapse
minimises the expected cost by dynamic programming (Ylitie, Karras, Laine 2017, "Efficient incoherent ray traversal on
GPUs through compressed wide BVHs", section 3).
"""
from dataclasses import dataclass

import numpy as np

THICKNESS = np.float32(1e-6)     # of the scene, added to every extent: flat and linear boxes have areas to compare too
GROUP = 1 << 14                  # primitives whose nodes are split together: their arrays stay in the cache
CANDIDATES = 11                  # log2 of the least number of places for a split that a larger node is tried at


@dataclass(frozen=True)
class Tree:
    """N nodes of 8 slots, L leaves, P primitives. Node 0 is the root and always an inner node.

    bounds:     (N, 2, 3, 8) float32; [node, lo/hi, axis, slot]. An empty slot holds NaN, so no ray hits it.
    child:      (N, 8) int32; > 0 a node, < 0 the leaf `~child`, 0 an empty slot. Rays of direction octant o (bit a set
                where d[a] < 0) should visit slot k ^ o for k = 0, 1, ... 7.
    leaf_first: (L,) int32 into `order`.
    leaf_count: (L,) int32, 1 to `leaf_size`.
    order:      (P,) int32, a permutation of the primitives; ascending within each leaf.
    depth:      levels of nodes, 1 if there is only the root: a path down the tree has at most `depth` nodes and a leaf.
    sah_cost:   nodes and leaves that a random line through the root's box is expected to meet: their areas' sum over
                the root's area.
    """

    bounds: np.ndarray
    child: np.ndarray
    leaf_first: np.ndarray
    leaf_count: np.ndarray
    order: np.ndarray
    depth: int
    sah_cost: float


def build(lo, hi, rule="sah", leaf_size=8, width=8):
    """Build a `Tree` over P >= 1 boxes. Deterministic.

    Args:
        lo, hi:    (P, 3) finite, lo <= hi.
        rule:      "sah" least expected cost, "equal" equal counts, "middle" the middle of the centroids' bounds.
        leaf_size: most primitives in a leaf.
        width:     most children of a node, 2 to 8.
    """
    if rule not in RULES:
        raise ValueError(f"BVH rule {rule!r} is not known; use one of {', '.join(RULES)}")
    if not 2 <= width <= 8 or leaf_size < 1:
        raise ValueError(f"a BVH has width 2 to 8 and leaf_size 1 or more, not {width} and {leaf_size}")
    box, unit = primitive_bounds(lo, hi)
    return widen(box, *binary_tree(unit, RULES[rule], leaf_size), width)


# ---- 1: bounds ------------------------------------------------------------------------------------------------------
def primitive_bounds(lo, hi):
    """Check the boxes, round them outwards to float32, and map the scene into the unit cube for the heuristic.

    Returns:
        box:  (2, 3, P) float32 that encloses [lo, hi].
        unit: (2, 3, P) float32 from 0 to 1, one scale for all axes: areas neither overflow nor vanish.
    """
    lo, hi = np.asarray(lo), np.asarray(hi)
    if lo.ndim != 2 or lo.shape[1] != 3 or lo.shape != hi.shape or len(lo) == 0:
        raise ValueError(f"a BVH needs lo and hi of shape (P, 3) with P >= 1, not {lo.shape} and {hi.shape}")
    box, unit = np.empty((2, 2, 3, len(lo)), np.float32)
    for rounded, exact, beyond in ((box[0], lo.T, np.greater), (box[1], hi.T, np.less)):
        with np.errstate(over="ignore", invalid="ignore"):
            rounded[:] = exact
        if exact.dtype != np.float32:
            outwards = np.nextafter(rounded, np.float32(-np.inf if beyond is np.greater else np.inf))
            np.copyto(rounded, outwards, where=beyond(rounded, exact))
    bad = ~((lo <= hi).all(1) & np.isfinite(box).all((0, 1)))
    if bad.any():
        raise ValueError(f"{bad.sum()} bounds are not finite float32s or have lo > hi; first is number {bad.argmax()}")
    origin = box[0].min(1).astype(np.float64)
    extent = (box[1].max(1) - origin).max() or 1.0
    for side in (0, 1):
        for axis in range(3):
            unit[side, axis] = (box[side, axis] - origin[axis]) / extent
    return box, unit


# ---- 2: binary tree -------------------------------------------------------------------------------------------------
def binary_tree(unit, choose, leaf_size):
    """Split every node of more than `leaf_size` primitives, level by level.

    Returns, for B nodes of which parents come first:
        left:   (B,) int64, the first of a node's two children, which are neighbours; 0 at a leaf.
        start:  (B,) int64, how many primitives come before the node's, depth first.
        count:  (B,) int64, its primitives.
        levels: slices of B, from the root down.
        leaf_of: (P,) int64, the leaf that holds each primitive.
    """
    p = unit.shape[2]
    rows = np.zeros((p, 8), np.float32)                            # of 32 bytes, which NumPy gathers faster than 24
    rows[:, :3], rows[:, 3:6] = unit[0].T, unit[1].T + THICKNESS
    rows = rows.view(np.int32)
    centre = unit[0] + unit[1]
    order = sorted_by(centre.view(np.int32), np.arange(p))         # (3, n): of the open nodes, by node, then centroid
    left, start, count = np.zeros((3, 2 * p), np.int64)
    side, leaf_of = np.zeros(p, bool), np.zeros(p, np.int64)
    count[0], levels = p, [slice(0, 1)]
    nodes = np.arange(p > leaf_size)                               # the open ones of this level
    while len(nodes):
        ends = np.cumsum(count[nodes])
        nl = np.empty(len(nodes), np.int64)
        for a, b in groups(count[nodes]):
            part = order[:, ends[a] - count[nodes[a]] : ends[b - 1]]
            nl[a:b] = split(part, rows, centre, count[nodes[a:b]], side, choose, leaf_size)
        level = slice(levels[-1].stop, levels[-1].stop + 2 * len(nodes))
        levels.append(level)
        left[nodes] = np.arange(level.start, level.stop, 2)
        count[level] = np.stack([nl, count[nodes] - nl], 1).ravel()
        start[level] = np.stack([start[nodes], start[nodes] + nl], 1).ravel()
        is_open = count[level] > leaf_size
        kept = np.repeat(is_open, count[level])
        closed = np.flatnonzero(~kept)
        leaf_of[order[0, closed]] = np.repeat(np.arange(level.start, level.stop), count[level])[closed]
        order = np.take(order, np.flatnonzero(kept), axis=1) if len(closed) else order
        nodes = np.flatnonzero(is_open) + level.start
    b = levels[-1].stop
    return left[:b], start[:b], count[:b], levels, leaf_of


def sorted_by(key, values):
    """`values` (P,) >= 0 by ascending int32 `key` (..., P), stable: one fast sort of 64-bit integers."""
    return np.sort(key.astype(np.int64) << 32 | values) & 0xFFFFFFFF


def groups(count):
    """Pairs (a, b): nodes a to b - 1 have some GROUP primitives together, or more in a node that is alone."""
    large = np.flatnonzero(count > GROUP)
    ends = np.cumsum(count)
    full = np.searchsorted(ends, np.arange(GROUP, ends[-1], GROUP))
    cuts = np.unique(np.concatenate([[0, len(count)], large, large + 1, full]))
    return zip(cuts[:-1], cuts[1:], strict=True)


def split(order, rows, centre, count, side, choose, leaf_size):
    """Split M neighbouring nodes: `order` (3, n) becomes, in place, the order of their 2 M children.

    Args:
        rows:   (P, 8) int32, the bits of lo (3), of hi (3) and padding.
        centre: (3, P) float32.
        count:  (M,) primitives of each node.
        side:   (P,) bool, scratch.
    Returns: (M,) how many go to the left child.
    """
    first = np.cumsum(count) - count
    segment = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(segment)) - first[segment]               # rank within the node
    axis, nl = choose(order, rows, centre, first, count, segment, place, leaf_size)
    right = place >= nl[segment]
    side[order[axis[segment], np.arange(len(segment))]] = right
    to_left, to_right = np.flatnonzero(~right), np.flatnonzero(right)
    for row in order:                                              # a stable partition, of all nodes at once
        goes = side[row]
        row[to_left], row[to_right] = row[np.flatnonzero(~goes)], row[np.flatnonzero(goes)]
    return nl


def least_cost(order, rows, centre, first, count, segment, place, leaf_size):
    """The axis (M,) and the count on the left (M,) of the least surface area heuristic.

    A side costs its area times (its primitives + the places in the leaves they will fill at least). The running bounds
    of all nodes are found in one pass: a 64-bit integer holds a float >= 0, whose bits order as its values do, below
    the number of the node, which takes over the maximum where a node begins. A node of more than GROUP primitives
    comes alone; every so many places of it will do.
    """
    step = 1 if count[0] <= GROUP else count[0] >> CANDIDATES
    begin = np.arange(0, len(place), step)
    number = segment[begin] << 32
    nl = np.minimum(place[begin] + step, count[segment[begin]])
    nr = count[segment[begin]] - nl
    weight_l, weight_r = ((n + -(-n // leaf_size) * leaf_size).astype(np.float32) for n in (nl, nr))
    key = np.empty(len(begin), np.int64)                           # cost above, and below it how uneven, and which way
    cost = key.view(np.float32)[1::2]
    uneven = np.abs(nl - nr) << 1 | (nl > nr)
    best, axis = np.full(len(count), np.iinfo(np.int64).max), np.zeros(len(count), np.int64)
    for a in range(3):
        bound = np.take(rows, order[a], axis=0).T
        lo, hi = bound[:3], bound[3:6]
        if step > 1:
            lo, hi = np.minimum.reduceat(lo, begin, axis=1), np.maximum.reduceat(hi, begin, axis=1)
        lo, hi = lo.astype(np.int64, order="C"), hi.astype(np.int64, order="C")
        area_l = half_area(*(running(np.maximum, hi + number) - running(np.minimum, lo - number)))
        lo, hi = (lo + number)[:, ::-1], (hi - number)[:, ::-1]    # from the right, so the numbers ascend the other way
        area_r = half_area(*(running(np.maximum, hi) - running(np.minimum, lo)))[::-1]
        key.view(np.int32)[::2] = uneven
        cost[:-1] = area_l[:-1] * weight_l[:-1] + area_r[1:] * weight_r[:-1]
        cost[nr == 0] = np.inf
        key &= ~(7 << 32)                                          # of costs equal but for rounding, the most even
        found = np.minimum.reduceat(key, first)
        axis[found < best] = a
        best = np.minimum(best, found)
    uneven = (best & 0xFFFFFFFF) >> 1
    return axis, (count + np.where(best & 1, uneven, -uneven)) >> 1


def running(ufunc, key):
    """Running maximum or minimum of 64-bit keys (3, n); of the result, the float32 in the low half (little-endian)."""
    return ufunc.accumulate(key, axis=1).view(np.float32)[:, ::2]


def half_area(x, y, z):
    """Half the surface area of a box of these extents."""
    return x * (y + z) + y * z


def equal_counts(order, rows, centre, first, count, segment, place, leaf_size):
    """The axis of the largest extent of the centroids, and half of the count."""
    return widest(order, centre, first, count)[0], count // 2


def middle(order, rows, centre, first, count, segment, place, leaf_size):
    """The same axis, and the count below the middle of that extent; half of the count if that would be none or all."""
    axis, at = widest(order, centre, first, count)
    below = centre[axis[segment], order[axis[segment], np.arange(len(segment))]] < at[segment]
    nl = np.add.reduceat(below, first, dtype=np.int64)
    return axis, np.where((nl > 0) & (nl < count), nl, count // 2)


def widest(order, centre, first, count):
    """The axis of the largest extent of each node's centroids (M,) and the middle of it (M,)."""
    axes = np.arange(3)[:, None]
    lo, hi = centre[axes, order[:, first]], centre[axes, order[:, first + count - 1]]
    axis = (hi - lo).argmax(0)
    return axis, ((lo + hi) / 2)[axis, np.arange(len(count))]


RULES = {"sah": least_cost, "equal": equal_counts, "middle": middle}


# ---- 3: eight children to a node ------------------------------------------------------------------------------------
def widen(box, left, start, count, levels, leaf_of, width):
    """Collapse the binary tree to `width` children a node and lay it out, depth first. Returns a `Tree`."""
    order = sorted_by(start[leaf_of], np.arange(len(leaf_of)))
    leaves = sorted_by(start, np.arange(len(left)))
    leaves = leaves[left[leaves] == 0]
    bounds = np.empty((2, 3, len(left)), np.float32)
    for ufunc, out, b in zip((np.minimum, np.maximum), bounds, box, strict=True):
        for axis in range(3):
            out[axis, leaves] = ufunc.reduceat(b[axis][order], start[leaves])
    for level in levels[::-1]:
        k = np.flatnonzero(left[level]) + level.start
        bounds[0][:, k] = np.minimum(bounds[0][:, left[k]], bounds[0][:, left[k] + 1])
        bounds[1][:, k] = np.maximum(bounds[1][:, left[k]], bounds[1][:, left[k] + 1])
    extent = bounds[1].astype(np.float64) - bounds[0]
    scale = extent[:, 0].max() or 1
    area = half_area(*(extent / scale + THICKNESS))

    parent = collapse(left, levels, area, width)                   # -1: vanishes in the node above
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
    return Tree(slots, child, start[leaves].astype(np.int32), count[leaves].astype(np.int32), order.astype(np.int32),
                depth, float(cost))


def collapse(left, levels, area, width):
    """Choose the binary nodes that become wide nodes, for the least sum of their areas (Ylitie et al. 2017, 3.1).

    Returns: (B,) int64, the wide node (by its binary number) whose child a node is; -1 for a node that vanishes in the
    wide node above, and for the root.
    """
    cost = np.zeros((width + 1, len(left)))                        # [i]: of the wide nodes below, as i children at most
    share = np.zeros((width + 1, len(left)), np.int8)              # of them, how many go to the left; [1]: as a node
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
    budget = np.zeros(len(left), np.int64)                         # children that a node may become
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
        parent: (C,) node of each child, of n; offset: (3, C) from the middle of the parent to that of the child.
    Returns: (C,) int64, different within each parent.
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
