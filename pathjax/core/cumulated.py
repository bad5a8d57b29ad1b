"""Sampling from tables of cumulated probabilities."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.core.math import at

# Tabled probabilities are multiples of this, and random numbers odd multiples of half of it, so entries are drawn with
# exactly the tabled probabilities.
STEP = 2.0**-23


def cumulated(weights: np.ndarray) -> np.ndarray:
    """Turn (..., N) weights into the cumulated probabilities (..., N + 1) before each entry, multiples of STEP.

    Every positive weight gets at least STEP. Where all weights are 0, all entries are equally likely.
    """
    weights = np.where(weights.any(-1, keepdims=True), weights, 1)
    total, lit = np.cumsum(weights, -1), np.cumsum(weights > 0, -1)
    steps = np.rint(total / total[..., -1:] * (1 / STEP - lit[..., -1:])) + lit
    return np.concatenate([np.zeros_like(steps[..., :1]), steps * STEP], -1)


def search(
    cdf: Float[Array, " N"],
    first: Int[Array, ""] | int,
    count: Int[Array, ""] | int,
    u: Float[Array, ""],
    most: int | None = None,
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Return the last i < count with cdf[first + i] <= u, and the relative position of u up to the next, in [0, 1).

    most: upper bound of count, if count is traced.
    """
    halvings = max((int(count) if most is None else most) - 1, 0).bit_length()

    def halve(k: Int[Array, ""], i: Int[Array, ""]) -> Int[Array, ""]:
        further = i + jnp.left_shift(jnp.int32(1), halvings - 1 - k)
        return jnp.where((further < count) & (at(cdf, first + jnp.minimum(further, count)) <= u), further, i)

    i = lax.fori_loop(0, halvings, halve, jnp.int32(0))
    low, high = at(cdf, first + i), at(cdf, first + i + 1)
    return i, jnp.minimum((u - low) / (high - low), 1 - STEP)
