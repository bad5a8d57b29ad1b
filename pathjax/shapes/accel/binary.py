"""A binary tree over boxes, built level by level: all open nodes of a level at once, in parallel over the cores.

The primitives stay sorted by centroid along each axis, so every rule describes a split by an axis and a count, and
coinciding centroids need no special case. The surface area heuristic is evaluated between any two primitives of a
small node (Wald and Havran 2006, "On building fast kd-trees for ray tracing, and on doing that in O(N log N)"); in a
larger node at PLACES places of equal counts, then at as many around the best of these. Nodes of similar count are
batched side by side in memory, one place of every node per row, so that the running bounds of all nodes take a few
operations on whole rows, which NumPy vectorises.

The result does not depend on the number of cores: parallel tasks are separate nodes, or exact maxima of parts.
"""

from __future__ import annotations

from functools import partial, reduce

import numpy as np

from pathjax.system.cores import over_cores

THICKNESS = np.float32(1e-6)  # share of the scene's size, added to every extent: flat and linear boxes get areas too
PLACES = 64  # with twice or half as many, rays visit the same number of nodes within 1 %
BATCH = 1 << 16  # primitives whose nodes are split together: their arrays stay in the cache
SPREAD = 1.15  # ratio of counts in a batch, whose nodes are all padded to the largest
FEW = 1 << 12  # primitives: fewer do not get a batch of their own
LONG_ROW = 1 << 15  # bytes above which a NumPy operation takes longer than its overhead


def binary_tree(unit, rule, leaf_size):
    """Split every node of more than `leaf_size` primitives.

    Args:
        unit: (2, 3, P) float32 from 0 to 1, lower and upper corners of boxes.
        rule: a key of `RULES`.
    Returns, for B nodes, parents before children:
        left:   (B,) int64, the first of a node's two children, which are adjacent; 0 at a leaf.
        start:  (B,) int64, number of primitives before those of the node, depth first.
        count:  (B,) int64, number of primitives in the node.
        levels: slices of B, from the root down.
        leaf_of: (P,) int64, the leaf that holds each primitive.
    """
    p = unit.shape[2]
    rows = np.zeros((p, 8), np.float32)  # NumPy gathers rows of 32 bytes faster than rows of 24
    rows[:, :3], rows[:, 3:6] = -unit[0].T, unit[1].T + THICKNESS
    centre = unit[0] + unit[1]
    left, start, count = np.zeros((3, 2 * p), np.int64)
    side, leaf_of = np.zeros(p, bool), np.zeros(p, np.int64)
    count[0], levels = p, [slice(0, 1)]
    nodes = np.arange(p > leaf_size)  # open nodes of this level
    with over_cores(p) as run:
        order = np.empty((3, p), np.int64)  # (3, n) primitives of the open nodes, by node, then centroid
        list(run(partial(sorted_by, np.arange(p)), centre.view(np.int32), order))
        while len(nodes):
            size = count[nodes]
            first = np.cumsum(size) - size
            axis, nl = RULES[rule](order, rows, centre, first, size, leaf_size, run)
            partition(order, first, size, axis, nl, side, run)
            level = slice(levels[-1].stop, levels[-1].stop + 2 * len(nodes))
            levels.append(level)
            left[nodes] = np.arange(level.start, level.stop, 2)
            count[level] = np.stack([nl, size - nl], 1).ravel()
            start[level] = np.stack([start[nodes], start[nodes] + nl], 1).ravel()
            is_open = count[level] > leaf_size
            kept = np.repeat(is_open, count[level])
            closed = np.flatnonzero(~kept)
            leaf_of[order[0, closed]] = np.repeat(np.arange(level.start, level.stop), count[level])[closed]
            order = np.take(order, np.flatnonzero(kept), axis=1) if len(closed) else order
            nodes = np.flatnonzero(is_open) + level.start
    b = levels[-1].stop
    return left[:b], start[:b], count[:b], levels, leaf_of


def sorted_by(values, key, out=None):
    """Return `values` (P,) >= 0 by ascending int32 `key` (P,), stable, by one fast sort of 64-bit integers."""
    return np.bitwise_and(np.sort(key.astype(np.int64) << 32 | values), 0xFFFFFFFF, out=out)


# ---- rules: return the axis (M,) along which to split each of M nodes, and the number of primitives (M,) on the left -
# order: (3, n) as above; rows: (P, 8) the lower corner negated (3), the upper one (3), padding; centre: (3, P);
# first, count: (M,) begin of a node in `order`, and its number of primitives.


def least_cost(order, rows, centre, first, count, leaf_size, run):
    """Split where the surface area heuristic is least."""
    axis, nl = np.empty((2, len(count)), np.int64)
    choose = partial(_least_cost, order, rows, leaf_size)
    single, many = [], []
    for nodes in _alike(count):
        (single if count[nodes[0]] > BATCH else many).append(nodes)
    chosen = [choose(first[nodes], count[nodes], run) for nodes in single]
    chosen += run(choose, [first[nodes] for nodes in many], [count[nodes] for nodes in many])
    for nodes, (axes, numbers) in zip(single + many, chosen, strict=True):
        axis[nodes], nl[nodes] = axes, numbers
    return axis, nl


def _alike(count):
    """Return batches of nodes of similar count, with FEW to about BATCH primitives, or a single node with more."""
    by = np.argsort(count, kind="stable")
    size, total = np.log(count[by]) // np.log(SPREAD), np.cumsum(count[by])
    cuts, before = list(np.flatnonzero(np.diff(total // BATCH)) + 1), 0
    for cut in np.flatnonzero(np.diff(size)) + 1:
        if total[cut - 1] - before >= FEW:
            cuts.append(cut)
            before = total[cut - 1]
    return np.split(by, np.unique(cuts).astype(int))


def _least_cost(order, rows, leaf_size, first, count, run=map):
    """Split a batch of nodes: find the best of a few places, then the best of those between its neighbours."""
    start = first + order.shape[1] * np.arange(3)[:, None]  # (3, M) begin of each axis in the flat `order`
    costs = partial(_costs, order.ravel(), rows, leaf_size, start, count, run=run)
    nothing = np.full((6, *start.shape), -np.inf, np.float32)
    keys, ends, left, right = costs(np.zeros_like(count)[None], count[None], nothing, nothing)
    if count.max() > PLACES:
        place, ends = keys.argmin(0)[None], np.broadcast_to(ends, left.shape[1:])
        low, high = (np.take_along_axis(ends, place + k, axis=0)[0] for k in (0, 2))
        before = np.take_along_axis(left, place[None], axis=1)[:, 0]
        after = np.take_along_axis(right, place[None] + 2, axis=1)[:, 0]
        keys, *_ = costs(low, high, before, after)
    keys = keys.min(0)
    key, axis = keys.min(0), keys.argmin(0)
    uneven = (key & 0xFFFFFFFF) >> 1
    return axis, (count + np.where(key & 1, uneven, -uneven)) >> 1


def _costs(order, rows, leaf_size, start, count, low, high, before, after, run):
    """Evaluate splits with more than `low` and fewer than `high` primitives on the left.

    The cost of a side is its area times (its primitives + the slots of the fewest leaves that can hold them). Up to
    PLACES - 1 splits are tried, with the same number of primitives between them, give or take one.

    Args:
        start: (3, M) begin of the node in the flat `order`, by axis; low, high: (1 or 3, M).
        before, after: (6, 3, M) bounds, as in `rows`, of the primitives before `low` and from `high` on.
    Returns:
        keys:  (splits, 3, M) int64: the cost in the upper bits; below it the imbalance of the split, and its side.
        ends:  (splits + 2, 1 or 3, M) number of primitives on the left; the first is `low`, the last `high`.
        left, right: (6, splits + 2, 3, M) bounds of the sides.
    """
    wide = high - low
    ends = np.arange(min(wide.max(), PLACES) + 1)[:, None, None] * (wide / np.minimum(wide, PLACES))
    ends = low + np.minimum(ends.astype(np.int64), wide)  # (places + 1, 1 or 3, M); the last one may be repeated
    begin, last = start + np.minimum(ends[:-1], high - 1), start + np.maximum(ends[1:], low + 1) - 1
    most, step = (last - begin).max() + 1, max(BATCH // begin.size, 1)

    def bounds(some):
        at = np.minimum(begin + np.arange(some.start, some.stop)[:, None, None, None], last)
        return np.maximum.reduce(np.take(rows, np.take(order, at), axis=0), axis=0)

    parts = run(bounds, [range(k, min(k + step, most)) for k in range(0, most, step)])
    left, right = np.empty((2, 6, len(ends), *start.shape), np.float32)
    left[:, 1:] = right[:, :-1] = np.moveaxis(reduce(np.maximum, parts), 3, 0)[:6]
    left[:, 0], right[:, -1] = before, after
    _accumulate(left)
    _accumulate(right[:, ::-1])

    nl = ends[1:-1]
    nr = count - nl
    area_l, area_r = (half_area(*(bound[:3, 1:-1] + bound[3:, 1:-1])) for bound in (left, right))
    weight_l, weight_r = ((n + -(-n // leaf_size) * leaf_size).astype(np.float32) for n in (nl, nr))
    weight_l[nl == high] = np.inf
    cost = area_l * weight_l + area_r * weight_r
    # Bits of positive floats order as the floats do. Between costs that are equal up to rounding, the most even wins.
    keys = (cost.view(np.int32) & ~7).astype(np.int64) << 32 | (np.abs(nl - nr) << 1 | (nl > nr))
    return keys, ends, left, right


def _accumulate(bounds):
    """Replace each of the rows (6, rows, 3, M), in place, by the bounds of it and all rows before it."""
    rows = bounds.shape[1]
    if bounds[:, 0].size * bounds.itemsize > LONG_ROW:
        for k in range(1, rows):
            np.maximum(bounds[:, k], bounds[:, k - 1], out=bounds[:, k])
    else:  # more arithmetic in fewer operations
        for step in 2 ** np.arange((rows - 1).bit_length()):
            bounds[:, step:] = np.maximum(bounds[:, step:], bounds[:, :-step])


def half_area(x, y, z):
    """Return half the surface area of a box of these extents."""
    return x * (y + z) + y * z


def equal_counts(order, rows, centre, first, count, leaf_size, run):
    """Split along the axis of the largest extent of the centroids, at half of the count."""
    return _widest(order, centre, first, count)[0], count // 2


def middle(order, rows, centre, first, count, leaf_size, run):
    """Split along the same axis at the middle of that extent; at half of the count if one side would be empty."""
    axis, at = _widest(order, centre, first, count)
    low, high = np.zeros_like(count), count
    while (low < high).any():
        half = (low + high) // 2
        below = centre[axis, order[axis, first + np.minimum(half, count - 1)]] < at
        low, high = np.where(below & (low < high), half + 1, low), np.where(below, high, half)
    return axis, np.where((low > 0) & (low < count), low, count // 2)


def _widest(order, centre, first, count):
    """Return the axis of the largest extent of each node's centroids (M,) and the middle of the extent (M,)."""
    axes = np.arange(3)[:, None]
    lo, hi = centre[axes, order[:, first]], centre[axes, order[:, first + count - 1]]
    axis = (hi - lo).argmax(0)
    return axis, ((lo + hi) / 2)[axis, np.arange(len(count))]


RULES = {"sah": least_cost, "equal": equal_counts, "middle": middle}


# ---- partition ------------------------------------------------------------------------------------------------------
def partition(order, first, count, axis, nl, side, run):
    """Partition `order` (3, n) of M contiguous nodes, in place, into the order of their 2 M children.

    side: (P,) bool, scratch.
    """
    split = partial(_partition, order, first, count, axis, nl, side)
    ends = first + count
    large = np.flatnonzero(count > BATCH)
    full = np.searchsorted(ends, np.arange(BATCH, ends[-1], BATCH))
    cuts = np.unique(np.concatenate([[0, len(count)], large, large + 1, full]))
    some = [slice(a, b) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    for each in (nodes for nodes in some if count[nodes.start] > BATCH):
        split(each, run)
    list(run(split, (nodes for nodes in some if count[nodes.start] <= BATCH)))


def _partition(order, first, count, axis, nl, side, nodes, run=map):
    """Partition contiguous nodes by their splits; stable."""
    begin = first[nodes.start]
    part = order[:, begin : begin + count[nodes].sum()]
    at = np.arange(begin, begin + part.shape[1])
    right = at >= np.repeat((first + nl)[nodes], count[nodes])
    side[np.take(order.ravel(), at + np.repeat(order.shape[1] * axis[nodes], count[nodes]))] = right
    to_left, to_right = np.flatnonzero(~right), np.flatnonzero(right)

    def move(row):
        goes = side[row]
        row[to_left], row[to_right] = row[np.flatnonzero(~goes)], row[np.flatnonzero(goes)]

    list(run(move, part))
