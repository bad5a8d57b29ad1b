"""What pixels tell about parameters: the covariance from scores of two renders, and the undetermined directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from pathjax.inverse.normal import NormalEquations

# A direction counts as determined if its curvature is this many standard errors above 0 ...
MIN_SIGNIFICANCE = 4
# ... and its standard error is below this part of the parameters' scale.
MAX_RELATIVE_ERROR = 0.25
# Shares of an undetermined direction below which a component is not named, and not given an infinite error.
NAMED_SHARE, TOUCHED_SHARE = 0.2, 0.03
# Residuals have structure if they agree with this significance. They are clipped at this many standard deviations, and
# noise is taken to be uniform in windows of this width. For 900 renders and targets of the shipped scenes, exact, as
# PNG and with noise added, the significance had a standard deviation of 0.9 to 1.1, and none was beyond 4.3: false
# alarms are below 1e-4.
STRUCTURE_SIGNIFICANCE, STRUCTURE_CLIP, STRUCTURE_WINDOW = 5, 5, 7
# Neighbours are all pixels within two: a misfit is smooth, and more pairs tell more. Each pair once.
STRUCTURE_PAIRS = [(down, right) for down in range(3) for right in range(-2, 3) if (down, right) > (0, 0)]
# Sines and cosines in the series of a rounding error; the omitted ones hold 7 % of its variance.
ROUNDING_IMAGES = 16


class Solution(NamedTuple):
    """The solution of normal equations of n components, in units of their scale."""

    covariance: np.ndarray  # (n, n) within the determined directions
    undetermined: np.ndarray  # (n, k) directions, columns
    step: np.ndarray  # (n,) of Newton's method towards the root, within the determined directions
    inverse: np.ndarray  # (n, n) of the curvature, within the determined directions


def solve(normal: NormalEquations, free: np.ndarray) -> Solution:
    """Solve on the eigenvectors of the curvature that noise cannot have made, with the sandwich covariance.

    Args:
        normal: in units of the scale.
        free: (n,) bool; False: the component stays fixed.
    """
    matrices = np.asarray(normal.matrices, np.float64)[:, free][:, :, free]
    matrix, groups = matrices.sum(0), len(matrices)
    curvature, vectors = np.linalg.eigh(matrix)
    by_group = np.einsum("gik,ik->gk", matrices @ vectors, vectors)
    noise = by_group.std(0, ddof=min(1, groups - 1)) * np.sqrt(groups)
    # Rounding errors of sums in the scene's dtype, where the curvature is 0.
    size = np.abs(vectors).T @ np.sqrt(np.abs(np.diag(matrix)))
    rounding = 10 * np.finfo(normal.matrices.dtype).eps * size**2
    significant = curvature > np.maximum(MIN_SIGNIFICANCE * noise, rounding)
    # The scatter over pixels is that of the score, with the noise of target, renders and Jacobians (White 1980).
    along = np.asarray(normal.gradient, np.float64)[free] @ vectors
    scatter = vectors.T @ np.asarray(normal.scatter, np.float64)[np.ix_(free, free)] @ vectors
    inverse = np.where(significant, 1 / np.where(significant, curvature, 1), 0)
    covariance = _not_negative(inverse[:, None] * scatter * inverse)
    kept = significant & (np.sqrt(np.diag(covariance)) < MAX_RELATIVE_ERROR)

    everywhere = np.zeros((len(free), len(vectors)))
    everywhere[free] = vectors
    inside = everywhere[:, kept]
    covariance = inside @ covariance[np.ix_(kept, kept)] @ inside.T
    step = -inside @ (inverse * along)[kept]
    inverse = (inside * inverse[kept]) @ inside.T
    return Solution(covariance, everywhere[:, ~kept], step, inverse)


def _not_negative(covariance: np.ndarray) -> np.ndarray:
    """Return the covariance with negative variances, which rounding makes of 0, replaced by 0."""
    variances, vectors = np.linalg.eigh(covariance)
    return vectors * np.maximum(variances, 0) @ vectors.T


def rounding_images(step, phase, noise) -> np.ndarray:
    """Return (N, 3, ROUNDING_IMAGES) uncorrelated parts of a target's rounding error, as far as noise does not hide it.

    Pixels of nearly equal values are rounded alike, so their errors do not average out as the scatter over pixels
    assumes. The error of rounding x is a series of sines in 2 pi k x / step, damped by noise. If an offset common to
    all pixels is uniform over a step, its terms are uncorrelated (Widrow and Kollar, Quantization Noise, 2008).

    Args:
        step: (N, 3).
        phase: (N, 3) image / step, up to whole numbers.
        noise: (N, 3) standard deviation / step.
    """
    k = np.arange(1, ROUNDING_IMAGES // 2 + 1)
    terms = np.exp(2j * np.pi * k * phase[..., None] - 2 * (np.pi * k * noise[..., None]) ** 2)
    terms *= step[..., None] / (np.sqrt(2) * np.pi * k)
    return np.concatenate([terms.real, terms.imag], -1)


def deviation(values) -> float:
    """Return the standard deviation of noise, robust to a few outliers; 1 if there are no values."""
    # Half of normal noise lies below 0.6745 standard deviations.
    return float(np.median(np.abs(values)) / 0.6745) if values.size else 1.0


def structure(misfits: list[np.ndarray], apart: int = 1, alike: float = 1.0) -> tuple[float, float]:
    """Return Moran's I of the residuals, -1 to 1, and its significance.

    Noise is independent from pixel to pixel, and the misfit of a wrong image is not: this tells a local minimum, or a
    scene that cannot look like its target, from the right values, however large the noise. Large residuals are clipped:
    a firefly must not count for many pixels, nor raise the noise against which the misfit of others is measured. Pixels
    without a misfit, such as an exactly right background, have no noise either and are left out.

    Args:
        misfits: per view (H, W, 3) image - target in standard deviations, 0 where the target allows the image's value.
        apart, alike: for correlated noise, the distance from which on it is independent, and the sum of squared
            correlations around a pixel: only pixels that far from each other are compared.
    """
    products, expected, variances = [], [], []
    for misfit in misfits:
        f = np.clip(misfit, -STRUCTURE_CLIP, STRUCTURE_CLIP)
        present = f.any(-1)
        # (H, W, 3, 3): noise is correlated between channels, and its size differs from place to place.
        share = ndimage.uniform_filter(present.astype(float), STRUCTURE_WINDOW, mode="constant")
        size = STRUCTURE_WINDOW, STRUCTURE_WINDOW, 1, 1
        squares = ndimage.uniform_filter(f[..., :, None] * f[..., None, :], size, mode="constant")
        squares /= np.where(present, share, 1)[..., None, None]
        for down, right in STRUCTURE_PAIRS if apart == 1 else [(0, apart), (apart, -apart), (apart, 0), (apart, apart)]:
            one = np.s_[down:, max(right, 0) : f.shape[1] + min(right, 0)]
            other = np.s_[: f.shape[0] - down, max(-right, 0) : f.shape[1] + min(-right, 0)]
            both = present[one] & present[other]
            products.append((f[one] * f[other]).sum(-1)[both])
            variances.append((squares[one] * squares[other]).sum((-2, -1))[both])
            expected.append(((f[one] ** 2 + f[other] ** 2).sum(-1) / 2)[both])
    shared, total, variance = (np.concatenate(parts).sum() for parts in (products, expected, variances))
    return (float(shared / total), float(shared / np.sqrt(alike * variance))) if total else (0.0, 0.0)
