"""Primitives packed for intersection: blocks of scalars with one primitive per lane, and a tree over many blocks."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.core.math import integer_like
from pathjax.shapes.accel import build as bvh_build
from pathjax.shapes.accel import traverse as bvh

# Up to this number of primitives of a kind, every ray tests all of them in turn; above, a tree is faster.
FLAT_LIMIT = 32
LEAF_WIDTH = 8


def pack(numbers, lo, hi, dtype, rule="sah", first=0, step=1):
    """Pack primitives for intersection.

    Args:
        numbers: (P, K) scalars that `intersect` reads per primitive, in any dtype.
        lo, hi: (P, 3) bounds.
        first, step: primitive i is row first + step i of its table.
    Returns:
        leaves (L, K + 1, W), tree (None for a few primitives, each a leaf of its own), built tree for reports or None.
        A leaf holds the bits of its scalars, as integers, then its rows. It is one block, so that a visit misses the
        cache once. As the padding is integer, no array of the scene holds a NaN that JAX's debug_nans would report.
    """
    count = len(numbers)
    if count <= FLAT_LIMIT:
        built, tree = None, None
        rows = np.arange(count, dtype=np.int32)[:, None]
    else:
        built = bvh_build.build(lo, hi, rule=rule, leaf_size=LEAF_WIDTH)
        lane = np.arange(LEAF_WIDTH)
        place = built.leaf_first[:, None] + lane
        rows = np.where(lane < built.leaf_count[:, None], built.order[np.minimum(place, count - 1)], -1)
        tree = bvh.pack(built, dtype)
    dtype = np.dtype(dtype)
    integer = integer_like(dtype)
    blocks = np.empty((len(rows), numbers.shape[1] + 1, rows.shape[1]), integer)
    bits = numbers.astype(dtype, copy=False).view(integer)
    blocks[:, :-1] = np.moveaxis(np.take(bits, rows, axis=0, mode="wrap"), 1, 2)
    np.moveaxis(blocks[:, :-1], 2, 1)[rows < 0] = np.array(np.nan, dtype).view(integer)
    blocks[:, -1] = np.where(rows < 0, rows, first + step * rows)
    return blocks, tree, built


def numbers_of(block, dtype):
    """Return the scalars whose bits are (a part of) a leaf; ignore the last entry, which holds the rows."""
    return lax.bitcast_convert_type(block, dtype)


def rows_of(leaf):
    """Return the rows (..., W) of the primitives of a leaf (..., K + 1, W), ascending; -1 in empty lanes."""
    return leaf[..., -1, :].astype(jnp.int32)
