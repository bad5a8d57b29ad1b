"""Bounding volume hierarchies with eight children per node, built in NumPy.

Three stages: compute the bounds of the primitives (rounded outwards to float32), build a binary tree over them
(`binary`), collapse it to eight children per node and lay it out for `traverse` (`collapse`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pathjax.shapes.accel.binary import RULES, binary_tree
from pathjax.shapes.accel.collapse import widen
from pathjax.system.cores import over_cores


@dataclass(frozen=True)
class Tree:
    """N nodes of 8 slots, L leaves, P primitives. Node 0 is the root and always an inner node.

    bounds:     (N, 2, 3, 8) float32; [node, lo/hi, axis, slot]. An empty slot holds NaN, so no ray hits it.
    child:      (N, 8) int32; > 0 a node, < 0 the leaf `~child`, 0 an empty slot. Rays of direction octant o (bit a set
                where d[a] < 0) should visit slot k ^ o for k = 0, 1, ... 7.
    leaf_first: (L,) int32, index into `order`.
    leaf_count: (L,) int32, 1 to `leaf_size`.
    order:      (P,) int32, a permutation of the primitives; ascending within each leaf.
    depth:      levels of nodes, 1 if there is only the root: a path down the tree has at most `depth` nodes and a leaf.
    sah_cost:   expected number of nodes and leaves that a random line through the root's box meets: the sum of their
                areas over the root's area.
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
        leaf_size: maximum number of primitives in a leaf.
        width:     maximum number of children of a node, 2 to 8.
    """
    if rule not in RULES:
        raise ValueError(f"BVH rule {rule!r} is not known; use one of {', '.join(RULES)}")
    if not 2 <= width <= 8 or leaf_size < 1:
        raise ValueError(f"a BVH has width 2 to 8 and leaf_size 1 or more, not {width} and {leaf_size}")
    box, unit = primitive_bounds(lo, hi)
    return Tree(*widen(box, *binary_tree(unit, rule, leaf_size), width))


# ---- 1: bounds ------------------------------------------------------------------------------------------------------
def primitive_bounds(lo, hi):
    """Check the boxes, round them outwards to float32, and map the scene into the unit cube for the heuristic.

    Returns:
        box:  (2, 3, P) float32 that encloses [lo, hi].
        unit: (2, 3, P) float32 from 0 to 1, with one scale for all axes, so that areas neither overflow nor vanish.
    """
    lo, hi = np.asarray(lo), np.asarray(hi)
    if lo.ndim != 2 or lo.shape[1] != 3 or lo.shape != hi.shape or len(lo) == 0:
        raise ValueError(f"a BVH needs lo and hi of shape (P, 3) with P >= 1, not {lo.shape} and {hi.shape}")
    box, unit = np.empty((2, 2, 3, len(lo)), np.float32)

    def rounded(side, axis):
        exact, beyond, way = ((lo, np.greater, -np.inf), (hi, np.less, np.inf))[side]
        exact, row = exact[:, axis], box[side, axis]
        with np.errstate(over="ignore", invalid="ignore"):
            row[:] = exact
        if exact.dtype != np.float32:
            np.copyto(row, np.nextafter(row, np.float32(way)), where=beyond(row, exact))

    def scaled(side, axis):
        unit[side, axis] = (box[side, axis] - origin[axis]) / extent

    rows = np.indices((2, 3)).reshape(2, -1)
    with over_cores(len(lo)) as run:
        list(run(rounded, *rows))
        bad = ~((lo.T <= hi.T).all(0) & np.isfinite(box).all((0, 1)))
        if bad.any():
            what = "bounds are not finite float32s or have lo > hi"
            raise ValueError(f"{bad.sum()} {what}; first is number {bad.argmax()}")
        origin = box[0].min(1).astype(np.float64)
        extent = (box[1].max(1) - origin).max() or 1.0
        list(run(scaled, *rows))
    return box, unit
