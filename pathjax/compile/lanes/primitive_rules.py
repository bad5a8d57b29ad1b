"""Rules of lanes for JAX's primitives: arithmetic runs component by component, structural operations cost nothing.

Primitives in neither table are left to `vmap`: correct, but slow.

A rule is (interpreter, inputs, params, shape of the first result) -> value, or values if the primitive has several
results, or None: the rule does not apply, and `vmap` does it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.compile.lanes.columns import as_components, components, differs, is_known_zero


def _broadcast_in_dim(interpreter, inputs, params, shape):
    extents = [1] * len(shape)
    for axis, place in enumerate(params["broadcast_dimensions"]):
        extents[place] = inputs[0].shape[axis]
    return np.broadcast_to(inputs[0].reshape(extents), shape)


def _slice(interpreter, inputs, params, shape):
    strides = params["strides"] or [1] * len(shape)
    limits = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return inputs[0][tuple(slice(*limit) for limit in limits)]


def _unstack(interpreter, inputs, params, shape):
    axis = params["axis"]
    return [part.reshape(shape) for part in np.split(inputs[0], inputs[0].shape[axis], axis)]


def _reduce(op, zeros=None):
    def rule(interpreter, inputs, params, shape):
        axes = params["axes"]
        terms = np.moveaxis(inputs[0], axes, range(len(axes))).reshape(-1, math.prod(shape))
        while len(terms) > 1:
            half = len(terms) // 2
            pair = [terms[:half], terms[half : 2 * half]]
            folded = interpreter.componentwise(op, pair, (half, terms.shape[1]), zeros)
            terms = np.concatenate([folded, terms[2 * half :]])
        return terms.reshape(shape)

    return rule


def _dot_general(interpreter, inputs, params, shape):
    (axes_a, axes_b), batch = params["dimension_numbers"]
    if any(batch) or len(axes_a) != 1:
        return None
    a, b = (np.moveaxis(components(x), axes, [0]) for x, axes in zip(inputs, (axes_a, axes_b), strict=True))
    a, b = a.reshape(len(a), -1, 1), b.reshape(len(b), 1, -1)
    products = interpreter.componentwise(lax.mul, [a, b], (len(a), a.shape[1], b.shape[2]), ZEROS["mul"])
    return _reduce(lax.add, ZEROS["add"])(interpreter, [products], {"axes": (0,)}, shape)


def _dynamic_slice(interpreter, inputs, params, shape):
    """Return the entries that lanes pick: gathered from a shared table, selected from components of their own."""
    table, *starts = inputs
    starts = [start.item() if differs(start) else start for start in starts]
    picked = []
    for axis, (start, size) in enumerate(zip(starts, shape, strict=True)):
        extent = table.shape[axis]
        if size == extent:
            continue
        if jnp.ndim(start) or differs(table):
            picked.append(axis)
            if size > 1:  # for a single entry, the gather clamps the index
                starts[axis] = jnp.clip(start, 0, extent - size)
        else:
            table = lax.dynamic_slice_in_dim(table, start, size, axis, allow_negative_indices=False)
    if differs(table):
        for axis in picked:
            size, extent = shape[axis], table.shape[axis]
            windows = [np.take(table, range(k, k + size), axis) for k in range(extent - size + 1)]
            table = windows[0]
            for k, window in enumerate(windows[1:], 1):
                table = interpreter.select(starts[axis] >= k, table, window)
        return table
    if not picked:
        return table
    extents = [table.shape[axis] for axis in picked]
    columns = jnp.moveaxis(table, picked, range(len(picked))).reshape(math.prod(extents), -1)
    blocks = []
    for offsets in np.ndindex(*(shape[axis] for axis in picked)):
        index = 0
        for axis, extent, offset in zip(picked, extents, offsets, strict=True):
            index = index * extent + (starts[axis].astype(jnp.int32) + offset)
        # One column at a time: a gather from a reshaped table would divide and multiply every index again.
        blocks.append([interpreter.rows_of_column(columns[:, k], index) for k in range(columns.shape[1])])
    rest = [size for axis, size in enumerate(shape) if axis not in picked]
    block = as_components([*(shape[axis] for axis in picked), *rest], [item for items in blocks for item in items])
    return np.moveaxis(block, range(len(picked)), picked)


def _gather(interpreter, inputs, params, shape):
    """Gather a single block, as a slice from which some axes of length 1 may be dropped."""
    table, starts = inputs
    numbers = params["dimension_numbers"]
    in_bounds = params["mode"] in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    if np.ndim(starts) != 1 or not in_bounds:
        return None
    places = dict(zip(numbers.start_index_map, components(starts), strict=True))
    offsets = [places.get(axis, jnp.int32(0)) for axis in range(np.ndim(table))]
    offsets = [as_components((), [x]) if jnp.ndim(x) else x for x in offsets]
    block = _dynamic_slice(interpreter, [table, *offsets], params, params["slice_sizes"])
    return None if block is None else block.reshape(shape)


def _dynamic_update_slice(interpreter, inputs, params, shape):
    table, update, *starts = inputs
    if len(starts) != 1 or np.shape(update)[0] != 1:
        return None
    start = starts[0].item() if differs(starts[0]) else starts[0]
    (new,) = components(update).flat
    items = [interpreter.columnwise(lax.select_n, start == k, old, new) for k, old in enumerate(components(table))]
    return as_components(shape, items)


# Results for operands at least one of which is a known zero; None: the operation has to be computed.
ZEROS: dict[str, Callable] = {
    "add": lambda a, b: b if is_known_zero(a) else a,
    "add_any": lambda a, b: b if is_known_zero(a) else a,
    "sub": lambda a, b: a if is_known_zero(b) else lax.neg(b),
    "mul": lambda a, b: a if is_known_zero(a) else b,
    "div": lambda a, b: a if is_known_zero(a) else None,
    "neg": lambda a: a,
}

RULES = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda interpreter, x, params, shape: x[0].reshape(shape),
    "squeeze": lambda interpreter, x, params, shape: x[0].reshape(shape),
    "expand_dims": lambda interpreter, x, params, shape: x[0].reshape(shape),
    "transpose": lambda interpreter, x, params, shape: x[0].transpose(params["permutation"]),
    "stop_gradient": lambda interpreter, x, params, shape: x[0],
    "rev": lambda interpreter, x, params, shape: np.flip(x[0], params["dimensions"]),
    "slice": _slice,
    "concatenate": lambda interpreter, x, params, shape: np.concatenate(list(map(components, x)), params["dimension"]),
    "stack": lambda interpreter, x, params, shape: np.stack(list(map(components, x)), params["axis"]),
    "unstack": _unstack,
    "split": lambda interpreter, x, params, shape: np.split(x[0], np.cumsum(params["sizes"])[:-1], params["axis"]),
    "select_n": lambda interpreter, x, params, shape: interpreter.componentwise(
        lax.select_n, x, shape, lambda which, first, *others: first if all(each is first for each in others) else None
    ),
    "reduce_sum": _reduce(lax.add, ZEROS["add"]),
    "reduce_max": _reduce(lax.max),
    "reduce_min": _reduce(lax.min),
    "reduce_and": _reduce(lax.bitwise_and),
    "reduce_or": _reduce(lax.bitwise_or),
    "dot_general": _dot_general,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "dynamic_update_slice": _dynamic_update_slice,
    "optimization_barrier": lambda interpreter, x, params, shape: x,
    "persistent_test": lambda interpreter, x, params, shape: x[0],
    # `vmap` does it where a scalar becomes several narrower ones.
    "bitcast_convert_type": lambda interpreter, x, params, shape: (
        interpreter.componentwise(partial(lax.bitcast_convert_type_p.bind, **params), x, shape)
        if x[0].shape == shape
        else None
    ),
}

# Primitives for which a component of the result depends only on the same component of the operands.
COMPONENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bessel_i0e bessel_i1e cbrt ceil clamp clz complex "
    "conj convert_element_type copy copy_p cos cosh digamma div eq eq_to erf erf_inv erfc exp exp2 expm1 floor ge gt "
    "igamma igamma_grad_a igammac imag integer_pow is_finite le le_to lgamma log log1p log2 logistic lt lt_to max min "
    "mul mulhi ne neg nextafter not one_minus_square or polygamma population_count pow real reduce_precision "
    "regularized_incomplete_beta rem round rsqrt shift_left shift_right_arithmetic shift_right_logical sign sin sinh "
    "sqrt square sub tan tanh xor zeta".split()
)
