"""Estimate the error of an image, per pixel and as a whole, from the variance between its replicates.

Three degrees of freedom are few, so a pixel borrows from its neighbours. Light that no sample of a pixel and its
neighbours has met is not in the estimates, which are then too small. Variances are float64, as in `replicates.moments`,
so nothing here depends on the unit of radiance, except where float32 cannot hold the radiance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pathjax.images.metrics import RELATIVE_FLOOR, level, mean_of_channels
from pathjax.rendering.progressive.replicates import blocks

# Weight of a pixel's own variance; its eight neighbours share the rest.
OWN_SHARE = 0.25
# One-sided 95 % of a normal distribution.
CONFIDENCE = 1.645
# Least number of samples of a pixel, relative to the mean.
LEAST_SHARE = 0.25


class ImageError(NamedTuple):
    """Estimated `images.relative_error` of an image against the truth; nan where nothing is known."""

    estimate: float
    bound: float  # exceeded by the error in some 5 % of renders


def standard_error(image: np.ndarray, variance: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the standard error (H, W, 3); nan where a pixel is not finite or has fewer than 2 samples.

    It is at least image / (3 count): even if the 9 count samples of the neighbourhood agree, the next could be twice as
    bright. Without this bound, reflections in glass that one path in a hundred finds had no error. It is too small
    where a pixel's true variance is many times its neighbours' but its samples agree by luck, and where pixels are
    black.

    Args:
        variance: (H, W, 3) of each pixel of the image (H, W, 3).
        count: (H, W) samples per pixel.
    """
    result = np.empty_like(image)
    for rows in blocks(len(image), image.shape[1]):
        near = slice(max(rows.start - 1, 0), rows.stop + 1)
        error = _standard_error(image[near], variance[near], count[near])
        result[rows] = error[rows.start - near.start :][: rows.stop - rows.start]
    return result


def _standard_error(image, variance, count):
    # Channels first: loops over an innermost axis of length 3 are slow.
    image, variance = (np.ascontiguousarray(np.moveaxis(x, -1, 0)) for x in (image, variance))
    around = _around(variance, 1)
    pooled = np.where(np.isfinite(around), OWN_SHARE * variance + (1 - OWN_SHARE) * around, variance)
    least = image / (3.0 * np.maximum(count, 1))
    return np.moveaxis(np.sqrt(np.maximum(pooled, least**2)), 0, -1)


def contributions(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return each pixel's contribution (...,) to the squared relative error, from (..., 3); nan where unknown.

    image^2 - variance estimates the squared truth without bias. Taking image^2 would halve the error of noisy images,
    since what makes a pixel too bright makes its variance large.
    """
    with np.errstate(invalid="ignore"):
        relative = variance / (np.maximum(np.square(image, dtype=float) - variance, 0) + _floor(image))
    relative = mean_of_channels(relative)
    return np.where(np.isfinite(relative), relative, np.nan)


def _floor(image: np.ndarray) -> float:
    """Return the constant added to the squared truth in relative errors; nan where the image has no level."""
    return RELATIVE_FLOOR * level(image) ** 2


def image_error(image: np.ndarray, variance: np.ndarray, alike: float = 1.0) -> ImageError:
    """Estimate the error of an image (..., 3) over its finite pixels; nan without an `images.level`.

    The bound treats pixels as draws from a population: if a few of them cause most of the error, their number is small
    and the bound high. If single samples do (skewness beyond 6), the error exceeds the bound more often.

    alike: number of pixels that carry as much information on variances as one that shares no samples: the sum of
        squared correlations.
    """
    shares = contributions(image, variance)
    known = shares[np.isfinite(shares)]
    if not known.size:
        return ImageError(np.nan, np.nan)
    total = known.sum()
    uncertainty = np.sqrt(alike * (known**2).sum()) / total if total > 0 else 0.0
    square = total / known.size
    return ImageError(float(np.sqrt(square)), float(np.sqrt(square * (1 + CONFIDENCE * uncertainty))))


def sample_weights(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the best weights (H, W) for samples per pixel, float32 of mean 1, given equally many samples per pixel.

    They are proportional to the relative standard deviation in the 24 pixels around a pixel, without the pixel itself.
    So a pixel's number of samples does not depend on their values (except through the mean of all weights, by 1/N), and
    its mean stays unbiased.
    """
    with np.errstate(invalid="ignore"):
        relative = mean_of_channels(variance / (np.square(image, dtype=float) + _floor(image)))
    (weights,) = np.sqrt(_around(np.where(np.isfinite(relative), relative, np.nan)[None], 2))
    known = np.isfinite(weights)
    if not known.any() or not weights[known].any():
        return np.ones(weights.shape, np.float32)
    average = weights[known].mean()
    weights = np.maximum(np.where(known, weights, average), LEAST_SHARE * average)
    return (weights / weights.mean()).astype(np.float32)


def _around(x: np.ndarray, radius: int) -> np.ndarray:
    """Return means (C, H, W) over the square around each pixel, without itself and non-finite pixels; nan if none."""
    known = np.isfinite(x).all(0)
    values = np.where(known, x, 0)
    count = _box(known.astype(x.dtype), radius) - known
    total = _box(values, radius)
    total -= values
    return np.where(count > 0, np.maximum(total, 0) / np.maximum(count, 1), np.nan).astype(x.dtype)


def _box(x: np.ndarray, radius: int) -> np.ndarray:
    """Return sums (..., H, W) over the square around each pixel, cut off at the border."""
    for axis in (-2, -1):
        total = x.copy()
        line, out = np.moveaxis(x, axis, 0), np.moveaxis(total, axis, 0)
        for shift in range(1, radius + 1):
            out[shift:] += line[:-shift]
            out[:-shift] += line[shift:]
        x = total
    return x
