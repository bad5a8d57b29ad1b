"""Replicates: an image is the mean of COUNT independent randomisations of one sequence; their spread gives its error.

Sample i of a pixel is sample i // COUNT of replicate i % COUNT. Arrays are NumPy: means (COUNT, N, 3) of each
replicate, count (N,) samples of all replicates together.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import is_traced
from pathjax.core import sampler

COUNT = 4
# Pixels processed at a time, few enough that intermediate arrays stay in the cache and need no new memory.
_BLOCK = 1 << 13


def seeds(seed) -> np.ndarray | jax.Array:
    """Return the seeds (COUNT,) uint32 of the replicates of a seed; a JAX array within `jax.jit`."""
    seeds = _seeds(jnp.uint32(seed))
    return seeds if is_traced(seeds) else np.asarray(seeds)


@jax.jit
def _seeds(seed):
    return sampler.combine(jnp.arange(COUNT, dtype=jnp.uint32), seed)


def shares(count: np.ndarray | jax.Array) -> np.ndarray | jax.Array:
    """Return (COUNT, N) int32: the samples of each replicate among the first `count`."""
    first_come = COUNT - 1 - np.arange(COUNT, dtype=np.int32)
    return (count + first_come[:, None]) // COUNT


def blocks(count: int, pixels: int = 1) -> Iterator[slice]:
    """Yield slices of `count` items of `pixels` pixels each, to process at a time."""
    size = max(_BLOCK // pixels, 1)
    return (slice(first, min(first + size, count)) for first in range(0, count, size))


def one_if_equal(x: np.ndarray) -> np.ndarray:
    """Return x (N,), or (1,) if all are equal, the usual case: NumPy broadcasts one value over channels far faster."""
    return x[:1] if (x == x[0]).all() else x


def moments(means: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the image (N, 3), the mean over all samples, and an unbiased estimate of its variance (N, 3).

    The variance has COUNT - 1 degrees of freedom, and is nan with fewer than 2 samples; replicates with unequal sample
    counts are weighted as if their variance fell with the count. A pixel without samples is black. The variance is
    float64: squares of radiances leave the range of float32.
    """
    image, variance = np.empty_like(means[0]), np.empty(means[0].shape)
    for block in blocks(len(count)):
        replicates, samples = means[:, block].astype(float), one_if_equal(count[block])
        n, share = (x.astype(float)[..., None] for x in (samples, shares(samples)))
        freedom = np.minimum(n, COUNT) - 1
        with np.errstate(invalid="ignore"):  # non-finite pixels
            mean = (replicates * share).sum(0) / np.maximum(n, 1)
            spread = ((replicates - mean) ** 2 * share).sum(0) / np.maximum(n, 1)
        image[block] = mean
        variance[block] = np.where(freedom > 0, spread / np.maximum(freedom, 1), np.nan)
    return image, variance
