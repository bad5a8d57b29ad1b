"""JAX's promotion of dtypes and ranks, as pathjax's own code expects it."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def usual_promotion(f: Callable[P, R]) -> Callable[P, R]:
    """f, within which JAX promotes dtypes and ranks as by default: what the user forbids is meant for the user's code.

    For what is called from outside, and for what JAX calls later, such as rules of differentiation.
    """

    @wraps(f)
    def usual(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return f(*args, **kwargs)

    return usual
