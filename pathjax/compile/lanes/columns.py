"""Values of lanes: a jax array that all share, or a NumPy array of objects, the components, each (W,) or ()."""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp
import numpy as np
from jax import lax


def differs(value) -> bool:
    """Whether lanes hold values of their own."""
    return isinstance(value, np.ndarray) and value.dtype == object


def as_components(shape, items) -> np.ndarray:
    """An array of this shape of objects, which NumPy would take apart."""
    flat = np.empty(math.prod(shape), object)
    for place, item in enumerate(items):
        flat[place] = item
    return flat.reshape(shape)


@functools.cache
def known_zero(dtype: np.dtype) -> np.generic:
    """The component that stands for what is known to be zero: this very object, elsewhere a number as any other."""
    return dtype.type(0)


def is_known_zero(item) -> bool:
    return isinstance(item, np.generic) and item is known_zero(item.dtype)


def split(x) -> np.ndarray:
    """(W, ...) -> components (...)."""
    columns = x.reshape(len(x), -1)
    items = [lax.index_in_dim(columns, k, 1, keepdims=False) for k in range(columns.shape[1])]
    return as_components(x.shape[1:], items)


def join(value, width):
    """Components (...), or what is shared, -> (W, ...)."""
    if not differs(value):
        return jnp.broadcast_to(value, (width, *jnp.shape(value)))
    columns = [jnp.broadcast_to(item, (width,)) for item in value.flat]
    return jnp.stack(columns, -1).reshape(width, *value.shape)


def components(value) -> np.ndarray:
    """Components of any value, those of a shared one being ()."""
    if differs(value):
        return value
    if not np.shape(value):
        return as_components((), [jnp.asarray(value)])
    flat = jnp.ravel(value)
    return as_components(np.shape(value), [lax.index_in_dim(flat, k, keepdims=False) for k in range(flat.size)])


def entry(x, index):
    """x[index] for an index () inside: one contiguous load. (Unsigned ones are clamped in two instructions.)"""
    return lax.dynamic_index_in_dim(x, jnp.asarray(index, jnp.uint32), keepdims=False, allow_negative_indices=False)


def with_entry(x, value, index):
    """x whose entry at an index () inside is the value."""
    return lax.dynamic_update_index_in_dim(x, value, index, 0, allow_negative_indices=False)


def gathered(column, indices):
    """(W,) entries of a column (N,)."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(column, indices[:, None], dimensions, (1,), mode="clip")
