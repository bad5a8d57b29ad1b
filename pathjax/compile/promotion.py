"""JAX's default promotion of dtypes and ranks, which pathjax's own code relies on."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def standard_promotion(f: Callable[P, R]) -> Callable[P, R]:
    """Return f with JAX's default promotion inside: a stricter setting of the user's is meant for the user's code.

    For public functions, and for functions that JAX calls later, such as differentiation rules.
    """

    @wraps(f)
    def promoted(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return f(*args, **kwargs)

    return promoted
