"""Weights of the values of a target, by the noise of renders and of rounding; clipped values have weight 0.

Per-view data is a list of arrays (H, W, 3), in the caller's order. `halves` are the residuals, image - target, of two
independent renders of each view.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from pathjax.inverse import uncertainty
from pathjax.inverse.problem import Problem

# Samples per pixel of each of the two renders that measure the noise of every pixel.
NOISE_SPP = 8
# This part of the mean variance is added to all variances, so that no pixel gets an excessive weight.
NOISE_FLOOR = 0.05
# Pixels less than this many standard deviations of noise below the target's clipping level are left out. The part of
# normal noise that is still clipped moves the mean of the others by 1e-4 standard deviations.
CLIP_MARGIN = 4

Halves = list[tuple[np.ndarray, np.ndarray]]


class Noise(NamedTuple):
    """Variances of the values of each view."""

    spp: int  # of the renders
    renders: list[np.ndarray]  # (H, W, 1) of renders, smoothed over neighbours
    values: list[np.ndarray]  # (H, W, 3) of renders and the target's rounding


def noise(halves: Halves, problem: Problem, spp: int) -> Noise:
    """Return the noise of renders of `spp` samples, from `halves` of NOISE_SPP. The target is taken to be as noisy."""
    renders = []
    for a, b in halves:
        variance = _smoothed(((a - b) ** 2).mean(-1, keepdims=True) / 2, 3) * (NOISE_SPP / spp)
        renders.append(variance + NOISE_FLOOR * variance.mean() + problem.rounding**2)
    return Noise(spp, renders, [v + target.step**2 / 12 for v, target in zip(renders, problem.targets, strict=True)])


def surely_unclipped(halves: Halves, problem: Problem, noise: Noise) -> list[np.ndarray]:
    """Return per view (H, W, 3) bool: the values that noise cannot have raised to the target's clipping level.

    Leaving out only the values that it did clip would keep the darker ones. Renders and the noise around a pixel decide
    which these are, never the pixel itself.
    """
    ratio, masks = _target_ratio(halves, problem, noise, 2), []
    for (a, b), target, variance in zip(halves, problem.targets, noise.renders, strict=True):
        # The image is the mean of two renders over 3 x 3 pixels.
        image = _smoothed((a + b) / 2 + target.image, 3)
        variance = variance * (ratio + noise.spp / NOISE_SPP / 18) + target.step**2 / 12
        masks.append(image + CLIP_MARGIN * np.sqrt(variance) < target.ceiling)
    return masks


def _target_ratio(halves: Halves, problem: Problem, noise: Noise, errors: float) -> float:
    """Return the variance of the targets over that of the renders of `noise`, plus `errors` standard errors of it.

    At most that of one sample per pixel: more than that is a misfit.
    """
    ratios = np.concatenate(
        [
            ((a * b - target.step**2 / 12) / variance)[target.usable]
            for (a, b), target, variance in zip(halves, problem.targets, noise.renders, strict=True)
        ]
    )
    return float(np.clip(ratios.mean() + errors * ratios.std() / np.sqrt(ratios.size), 0, noise.spp))


def target_rounding(halves: Halves, problem: Problem, noise: Noise) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the arguments of `uncertainty.rounding_images`, (H, W, 3) each, for each view.

    They are the rounding step and, in units of it, the image (up to whole steps) and the noise's standard deviation.
    """
    ratio, parts = _target_ratio(halves, problem, noise, -2), []
    for (a, b), target in zip(halves, problem.targets, strict=True):
        step = np.where(target.step > 0, target.step, np.inf)
        # Neighbours have nearly equal values where this matters, and their mean is less noisy.
        image = _smoothed((a + b) / 2 + target.image, 5)
        # Per channel and without a floor: one channel may be rounded alike where others are noisy.
        deviation = np.sqrt(ratio * _smoothed((a - b) ** 2 / 2, 5))
        parts.append((target.step, (image - target.image) / step, deviation / step))
    return parts


def structure(halves: Halves, problem: Problem, noise: Noise, used: list[np.ndarray]) -> tuple[float, bool]:
    """Return how well neighbouring residuals agree, and whether that is more than chance.

    Args:
        used: (H, W, 3) bool per view, which values have a weight.
    """
    # The noise is that of other renders: a firefly that raised its own noise would weigh less and bias the residuals.
    parts = [
        ((a + b) / 2, np.sqrt(variance), use, target)
        for (a, b), variance, use, target in zip(halves, noise.values, used, problem.targets, strict=True)
    ]
    least = problem.rounding
    unit = uncertainty.deviation(np.concatenate([(m / n)[u & (np.abs(m) > least)] for m, n, u, _ in parts]))
    misfits = []
    for mean, deviation, use, target in parts:
        # Where values are clipped, or may be, only a misfit beyond noise is certain.
        misfit = target.misfit(target.image + mean, np.where(use, 0, CLIP_MARGIN * deviation * unit))
        misfits.append(np.where(np.abs(mean) > least, misfit, 0) / (deviation * unit))
    agreement, significance = uncertainty.structure(misfits, problem.reach + 1, problem.alike)
    return agreement, significance > uncertainty.STRUCTURE_SIGNIFICANCE


def _smoothed(image: np.ndarray, size: int) -> np.ndarray:
    """Return means (H, W, C) over squares of `size` by `size` pixels."""
    return ndimage.uniform_filter(image, (size, size, 1))
