"""How much each value of a target weighs: by the noise of renders and of rounding; clipped values do not at all.

What is of views is a list of arrays (H, W, 3), in the order of the caller. `halves` are the residuals, image - target,
of two independent renders of each view.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from pathjax.inverse import uncertainty
from pathjax.inverse.problem import Problem

# Samples per pixel of each of the two renders that tell how noisy every pixel is.
NOISE_SPP = 8
# Variances are floored at this part of their mean, so that no pixel weighs beyond measure.
NOISE_FLOOR = 0.05
# Pixels are left out that lie this many standard deviations of noise or less below the level where the target is
# clipped: what is then lost of normal noise moves their mean by 1e-4 standard deviations.
CLIP_MARGIN = 4

Halves = list[tuple[np.ndarray, np.ndarray]]


class Noise(NamedTuple):
    """Variances of the values of each view."""

    spp: int  # of the renders
    renders: list[np.ndarray]  # (H, W, 1) smoothed over neighbours
    values: list[np.ndarray]  # (H, W, 3) with that of the target's rounding


def noise(halves: Halves, problem: Problem, spp: int) -> Noise:
    """The noise of renders of `spp` samples, from `halves` of NOISE_SPP. That of the target is taken to be like it."""
    renders = []
    for a, b in halves:
        variance = _smoothed(((a - b) ** 2).mean(-1, keepdims=True) / 2, 3) * (NOISE_SPP / spp)
        renders.append(variance + NOISE_FLOOR * variance.mean() + problem.rounding**2)
    return Noise(spp, renders, [v + target.step**2 / 12 for v, target in zip(renders, problem.targets, strict=True)])


def surely_unclipped(halves: Halves, problem: Problem, noise: Noise) -> list[np.ndarray]:
    """(H, W, 3) bool of each view: the values that noise cannot have brought up to where the target is clipped.

    To leave out only those that it did clip would keep the darker ones. Which these are is told by renders and the
    noise around, never by the pixel itself.
    """
    ratio, masks = _target_ratio(halves, problem, noise, 2), []
    for (a, b), target, variance in zip(halves, problem.targets, noise.renders, strict=True):
        # The image is known by two renders and three by three pixels.
        image = _smoothed((a + b) / 2 + target.image, 3)
        variance = variance * (ratio + noise.spp / NOISE_SPP / 18) + target.step**2 / 12
        masks.append(image + CLIP_MARGIN * np.sqrt(variance) < target.ceiling)
    return masks


def _target_ratio(halves: Halves, problem: Problem, noise: Noise, errors: float) -> float:
    """Variance of the targets over that of the renders of `noise`, and so many of its standard errors.

    At most that of one sample per pixel: what is more is a misfit.
    """
    ratios = np.concatenate(
        [
            ((a * b - target.step**2 / 12) / variance)[target.usable]
            for (a, b), target, variance in zip(halves, problem.targets, noise.renders, strict=True)
        ]
    )
    return float(np.clip(ratios.mean() + errors * ratios.std() / np.sqrt(ratios.size), 0, noise.spp))


def target_rounding(halves: Halves, problem: Problem, noise: Noise) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each view steps of rounding, and in units of these the image and the deviation of the noise: (H, W, 3) each.

    They are the arguments of `uncertainty.rounding_images`: pixels of nearly equal values are rounded alike.
    """
    ratio, parts = _target_ratio(halves, problem, noise, -2), []
    for (a, b), target in zip(halves, problem.targets, strict=True):
        step = np.where(target.step > 0, target.step, np.inf)
        # Neighbours are of nearly equal value where this matters, and their mean is less noisy.
        image = _smoothed((a + b) / 2 + target.image, 5)
        # Each channel by itself, without a floor: one may be rounded alike where others are noisy.
        deviation = np.sqrt(ratio * _smoothed((a - b) ** 2 / 2, 5))
        parts.append((target.step, (image - target.image) / step, deviation / step))
    return parts


def structure(halves: Halves, problem: Problem, noise: Noise, used: list[np.ndarray]) -> tuple[float, bool]:
    """How well neighbouring residuals agree, and whether that is more than chance.

    Args:
        used: (H, W, 3) bool of each view, which values have a weight.
    """
    # The noise is that of other renders: a firefly that raised its own would weigh less, and residuals be biased.
    parts = [
        ((a + b) / 2, np.sqrt(variance), use, target)
        for (a, b), variance, use, target in zip(halves, noise.values, used, problem.targets, strict=True)
    ]
    least = problem.rounding
    unit = uncertainty.deviation(np.concatenate([(m / n)[u & (np.abs(m) > least)] for m, n, u, _ in parts]))
    misfits = []
    for mean, deviation, use, target in parts:
        # Where values are clipped, or may be, only what is beyond noise is known to be wrong.
        misfit = target.misfit(target.image + mean, np.where(use, 0, CLIP_MARGIN * deviation * unit))
        misfits.append(np.where(np.abs(mean) > least, misfit, 0) / (deviation * unit))
    agreement, significance = uncertainty.structure(misfits, problem.reach + 1, problem.alike)
    return agreement, significance > uncertainty.STRUCTURE_SIGNIFICANCE


def _smoothed(image: np.ndarray, size: int) -> np.ndarray:
    """(H, W, C) means over squares of `size` by `size` pixels."""
    return ndimage.uniform_filter(image, (size, size, 1))
