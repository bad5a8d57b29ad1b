"""Values of lanes: a jax array that all lanes share, or a NumPy object array of components, each (W,) or ()."""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp
import numpy as np
from jax import lax


def differs(value) -> bool:
    """Return whether lanes hold values of their own."""
    return isinstance(value, np.ndarray) and value.dtype == object


def as_components(shape, items) -> np.ndarray:
    """Return an object array of this shape, without NumPy's taking the items apart."""
    flat = np.empty(math.prod(shape), object)
    for place, item in enumerate(items):
        flat[place] = item
    return flat.reshape(shape)


@functools.cache
def known_zero(dtype: np.dtype) -> np.generic:
    """Return the component that marks a known zero, by its identity; outside of lanes it is an ordinary number."""
    return dtype.type(0)


def is_known_zero(item) -> bool:
    return isinstance(item, np.generic) and item is known_zero(item.dtype)


def split(x) -> np.ndarray:
    """Split an array (W, ...) into components (...)."""
    columns = x.reshape(len(x), -1)
    items = [lax.index_in_dim(columns, k, 1, keepdims=False) for k in range(columns.shape[1])]
    return as_components(x.shape[1:], items)


def join(value, width):
    """Join components (...), or broadcast a shared value, to an array (W, ...)."""
    if not differs(value):
        return jnp.broadcast_to(value, (width, *jnp.shape(value)))
    columns = [jnp.broadcast_to(item, (width,)) for item in value.flat]
    return jnp.stack(columns, -1).reshape(width, *value.shape)


def components(value) -> np.ndarray:
    """Return the components of any value; those of a shared value are ()."""
    if differs(value):
        return value
    if not np.shape(value):
        return as_components((), [jnp.asarray(value)])
    flat = jnp.ravel(value)
    return as_components(np.shape(value), [lax.index_in_dim(flat, k, keepdims=False) for k in range(flat.size)])


def entry(x, index):
    """Return x[index] for an in-range index (): one contiguous load. (Unsigned ones are clamped in 2 instructions.)"""
    return lax.dynamic_index_in_dim(x, jnp.asarray(index, jnp.uint32), keepdims=False, allow_negative_indices=False)


def with_entry(x, value, index):
    """Return x with its entry at an in-range index () set to the value."""
    return lax.dynamic_update_index_in_dim(x, value, index, 0, allow_negative_indices=False)


def gathered(column, indices):
    """Gather entries (W,) of a column (N,)."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(column, indices[:, None], dimensions, (1,), mode="clip")
