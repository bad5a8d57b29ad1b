"""Values of lanes: a jax array that all share, or a NumPy array of objects, the components, each (W,) or ()."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import lax


def differs(value) -> bool:
    """Whether lanes hold values of their own."""
    return isinstance(value, np.ndarray) and value.dtype == object


def objects(shape, items) -> np.ndarray:
    flat = np.empty(math.prod(shape), object)
    for place, item in enumerate(items):
        flat[place] = item
    return flat.reshape(shape)


def split(x) -> np.ndarray:
    """(W, ...) -> components (...)."""
    columns = x.reshape(len(x), -1)
    return objects(x.shape[1:], [columns[:, k] for k in range(columns.shape[1])])


def join(value, width):
    """Components (...), or what is shared, -> (W, ...)."""
    if not differs(value):
        return jnp.broadcast_to(value, (width, *jnp.shape(value)))
    columns = [jnp.broadcast_to(item, (width,)) for item in value.flat]
    return jnp.stack(columns, -1).reshape(width, *value.shape)


def components(value) -> np.ndarray:
    if differs(value):
        return value
    flat = jnp.ravel(value)
    return objects(np.shape(value), [flat[k] for k in range(flat.size)])


def fits(shape, whole) -> bool:
    """Whether an operand is one number, or repeats along axes of length 1."""
    return shape == () or len(shape) == len(whole) and all(a in (1, b) for a, b in zip(shape, whole, strict=True))


def entries(column, numbers):
    """(W,) of a column (N,)."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(column, numbers[:, None], dimensions, (1,), mode="clip")
