"""Replicates: an image is the mean of COUNT independent randomisations of one sequence, whose spread tells its error.

Sample i of a pixel is sample i // COUNT of replicate i % COUNT. Arrays are NumPy: means (COUNT, N, 3) of each
replicate, count (N,) samples of all replicates together.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from pathjax.core import sampler

COUNT = 4


def seeds(seed: int) -> np.ndarray:
    """(COUNT,) uint32 seeds of the replicates of a seed."""
    return np.asarray(sampler.combine(jnp.arange(COUNT, dtype=jnp.uint32), jnp.uint32(seed)))


def shares(count: np.ndarray) -> np.ndarray:
    """(COUNT, N) int32: samples of each replicate among the first `count`."""
    first_come = COUNT - 1 - np.arange(COUNT, dtype=np.int32)
    return (count + first_come[:, None]) // COUNT


def mean(means: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(N, 3) image: mean over all samples; 0 where there is none."""
    image = np.zeros_like(means[0])
    for replicate, share in zip(means, shares(count), strict=True):
        image += replicate * (share / np.maximum(count, 1)).astype(means.dtype)[:, None]
    return image


def variance(means: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(N, 3) unbiased estimate of the image's variance, COUNT - 1 degrees of freedom; nan with fewer than 2 samples.

    Replicates of unequal numbers of samples count as if variance fell with their number.
    """
    image, total = mean(means, count), np.zeros_like(means[0])
    with np.errstate(invalid="ignore"):
        for replicate, share in zip(means, shares(count), strict=True):
            difference = replicate - image
            difference *= difference
            total += difference * share.astype(means.dtype)[:, None]
    freedom = np.minimum(count, COUNT) - 1
    known = freedom > 0
    scale = np.where(known, 1 / np.where(known, freedom * count.astype(float), 1), np.nan)
    return total * scale.astype(means.dtype)[:, None]
