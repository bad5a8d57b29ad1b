"""How wrong an image is, from the variance between its replicates: of a pixel, and of the whole.

Three degrees of freedom are few, so a pixel borrows from its neighbours. Of light that no sample of a pixel and its
neighbours has met these numbers cannot know: they are then too small. Variances are float64, as those of
`replicates.moments`: so nothing here depends on the unit of radiance, but for what float32 cannot hold.
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
# Least share of the samples that a pixel gets, of the mean.
LEAST_SHARE = 0.25


class ImageError(NamedTuple):
    """`images.relative_error` of an image against the truth; nan where nothing is known."""

    estimate: float
    bound: float  # that the error exceeds in some 5 % of renders


def standard_error(image: np.ndarray, variance: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(H, W, 3) of the image; nan where a pixel is not finite or has fewer than 2 samples.

    Never less than image / (3 count): among the 9 count samples of the neighbourhood, which may all agree, the next
    could have been twice as bright. Without this, what is reflected in glass by one path in a hundred had no error.
    Too small where the variance of a pixel is many times its neighbours' and it was lucky, and where pixels are black.

    Args:
        variance: (H, W, 3) of each pixel of the image (H, W, 3); count: (H, W) its samples.
    """
    result = np.empty_like(image)
    for rows in blocks(len(image), image.shape[1]):
        near = slice(max(rows.start - 1, 0), rows.stop + 1)
        error = _standard_error(image[near], variance[near], count[near])
        result[rows] = error[rows.start - near.start :][: rows.stop - rows.start]
    return result


def _standard_error(image, variance, count):
    # By planes: loops over three neighbours in memory are slow.
    image, variance = (np.ascontiguousarray(np.moveaxis(x, -1, 0)) for x in (image, variance))
    around = _around(variance, 1)
    pooled = np.where(np.isfinite(around), OWN_SHARE * variance + (1 - OWN_SHARE) * around, variance)
    least = image / (3.0 * np.maximum(count, 1))
    return np.moveaxis(np.sqrt(np.maximum(pooled, least**2)), 0, -1)


def contributions(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(...,) share of each pixel in the squared relative error, from (..., 3); nan where it is not known.

    image^2 - variance estimates the squared truth without bias. Taking image^2 would halve the error of noisy images,
    since what makes a pixel too bright makes its variance large.
    """
    with np.errstate(invalid="ignore"):
        relative = variance / (np.maximum(np.square(image, dtype=float) - variance, 0) + _floor(image))
    relative = mean_of_channels(relative)
    return np.where(np.isfinite(relative), relative, np.nan)


def _floor(image: np.ndarray) -> float:
    """What is added to the squared truth in relative errors; nan where the image has no level."""
    return RELATIVE_FLOOR * level(image) ** 2


def image_error(image: np.ndarray, variance: np.ndarray, alike: float = 1.0) -> ImageError:
    """Estimate the error of an image (..., 3); pixels that are not finite are left out, nan without an `images.level`.

    The bound takes pixels as draws from a population: where few of them make up most of the error, their number is
    small and the bound high. Where single samples do (skewness beyond 6), the error exceeds it more often.

    alike: how many pixels tell as much of variances as one that shares no samples: sum of squared correlations.
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
    """(H, W) float32 of mean 1: how samples are best spread over the pixels, from equally many in each.

    In proportion to the relative standard deviation, in the 24 pixels around a pixel and never in itself: so its
    number of samples does not depend on what they were (but through the mean of all weights, by 1/N), and its mean
    stays unbiased.
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
    """(C, H, W) mean over the square around each pixel, without itself and what is not finite; nan if none is left."""
    known = np.isfinite(x).all(0)
    values = np.where(known, x, 0)
    count = _box(known.astype(x.dtype), radius) - known
    total = _box(values, radius)
    total -= values
    return np.where(count > 0, np.maximum(total, 0) / np.maximum(count, 1), np.nan).astype(x.dtype)


def _box(x: np.ndarray, radius: int) -> np.ndarray:
    """(..., H, W) sums over squares, cut off at the border."""
    for axis in (-2, -1):
        total = x.copy()
        line, out = np.moveaxis(x, axis, 0), np.moveaxis(total, axis, 0)
        for shift in range(1, radius + 1):
            out[shift:] += line[:-shift]
            out[:-shift] += line[shift:]
        x = total
    return x
