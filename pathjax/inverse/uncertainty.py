"""What pixels can tell of parameters: scores of two independent renders, their covariance, what is not determined."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

# A direction counts as determined if its curvature stands this many standard errors above 0 ...
MIN_SIGNIFICANCE = 4
# ... and its standard error is below this part of the parameters' scale.
MAX_RELATIVE_ERROR = 0.25
# Shares of an undetermined direction below which a component is not named, and not given an infinite error.
NAMED_SHARE, TOUCHED_SHARE = 0.2, 0.03
# Residuals have structure if they agree with this significance; what is beyond so many deviations is clipped, and noise
# is taken to be alike in windows of so many pixels. Of 900 renders and targets of the shipped scenes, exact, as PNG
# and with noise added, its standard deviation was 0.9 to 1.1 and none was beyond 4.3: false alarms are below 1e-4.
STRUCTURE_SIGNIFICANCE, STRUCTURE_CLIP, STRUCTURE_WINDOW = 5, 5, 7
# Neighbours are all within two pixels: a misfit is smooth, and most pairs tell most. Each pair once.
STRUCTURE_PAIRS = [(down, right) for down in range(3) for right in range(-2, 3) if (down, right) > (0, 0)]
# Terms of the series of a rounding error; what is left out is 7 % of its variance.
ROUNDING_TERMS = 8


class Evidence(NamedTuple):
    """Two independent renders A, B of N pixels; of JAX or NumPy arrays."""

    residuals: jax.Array  # (2, N, 3) image - target
    jacobians: jax.Array  # (2, N, 3, n)

    def scores(self, weights, xp=jnp):
        """(N, n) of each pixel; their mean is 0 at the truth, whatever the noise. weights: (N, 3) 1/variance."""
        (a, b), (ja, jb) = self.residuals, self.jacobians
        return (xp.einsum("pci,pc->pi", ja, weights * b) + xp.einsum("pci,pc->pi", jb, weights * a)) / 2

    def matrix(self, weights, xp=jnp):
        """(n, n) Gauss-Newton matrix, unbiased, symmetric; may be indefinite."""
        a, b = self.jacobians
        product = xp.einsum("pci,pcj->ij", a, b * weights[..., None])
        return (product + product.T) / 2


class Solution(NamedTuple):
    """What one evaluation says about n components, in units of their scale."""

    projector: np.ndarray  # (n, n) onto what is determined
    covariance: np.ndarray  # (n, n) within it
    undetermined: np.ndarray  # (n, k) directions, columns
    step: np.ndarray  # (n,) of Newton's method towards the root, within what is determined
    inverse: np.ndarray  # (n, n) of the curvature, within what is determined


def solve(evidence: Evidence, weights, scale, free, scatter=None) -> Solution:
    """Eigenvectors of the curvature, those kept that noise cannot have made, and the sandwich covariance on them.

    Args:
        weights: (N, 3); scale: (n,) units of the components; free: (n,) bool, the others stay where they are.
        scatter: (N, k) deviations of the scores -> (k, k) covariance of their sum; None: pixels are independent.
    """
    weights = np.asarray(weights, np.float64)
    jacobians = np.asarray(evidence.jacobians, np.float64)[..., free] * scale[free]
    evidence = Evidence(np.asarray(evidence.residuals, np.float64), jacobians)
    curvature, vectors = np.linalg.eigh(evidence.matrix(weights, np))
    a, b = jacobians @ vectors
    by_pixel = np.einsum("pci,pci,pc->pi", a, b, weights)
    noise = by_pixel.std(0) * np.sqrt(len(by_pixel))
    # Columns that are the same up to the rounding of float32 leave a curvature of its square.
    rounding = curvature.max(initial=0) * (10 * np.finfo(np.float32).eps) ** 2
    significant = curvature > np.maximum(MIN_SIGNIFICANCE * noise, rounding)
    # The scatter of pixels is that of the score, with target, renders and Jacobians (White 1980).
    along = evidence.scores(weights, np) @ vectors
    spread = along - along.mean(0)
    inverse = np.where(significant, 1 / np.where(significant, curvature, 1), 0)
    covariance = inverse[:, None] * (spread.T @ spread if scatter is None else scatter(spread)) * inverse
    kept = significant & (np.sqrt(np.diag(covariance)) < MAX_RELATIVE_ERROR)

    everywhere = np.zeros((len(free), len(vectors)))
    everywhere[free] = vectors
    inside = everywhere[:, kept]
    covariance = inside @ covariance[np.ix_(kept, kept)] @ inside.T
    step = -inside @ (inverse * along.sum(0))[kept]
    inverse = (inside * inverse[kept]) @ inside.T
    return Solution(inside @ inside.T, covariance, everywhere[:, ~kept], step, inverse)


def scatter_of_blocks(images: list[np.ndarray], side: int) -> np.ndarray:
    """(k, k) covariance of the sum of images (H, W, k) whose pixels are correlated as far as some part of `side`.

    That of sums over blocks, in all places (Bartlett's window; Conley 1999, J. Econometrics 92): it counts pairs of
    pixels at the distance d by 1 - |d_x| / side and 1 - |d_y| / side, so it is never negative.
    """
    total = 0
    for image in images:
        sums = np.cumsum(np.cumsum(np.pad(image, [(side, side - 1)] * 2 + [(0, 0)]), 0), 1)
        blocks = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
        blocks = blocks.reshape(-1, image.shape[-1])
        total = total + blocks.T @ blocks / side**2
    return total


def rounding_covariance(influence, step, phase, noise) -> np.ndarray:
    """(n, n) covariance that the rounding of a target adds where its noise does not hide it.

    Pixels of nearly equal values are rounded alike, so that their errors do not average out as scatter over pixels has
    it. The error of rounding x is a series of sines in 2 pi k x / step, damped by noise. If what all pixels have in
    common is uniform over a step, its terms are uncorrelated (Widrow and Kollar, Quantization Noise, 2008).

    Args:
        influence: (N, 3, n) of each value of the target on the answer.
        step: (N, 3); phase: (N, 3) image / step, up to whole numbers; noise: (N, 3) standard deviation / step.
    """
    total = np.zeros((influence.shape[-1],) * 2)
    for k in range(1, ROUNDING_TERMS + 1):
        term = step * np.exp(2j * np.pi * k * phase - 2 * (np.pi * k * noise) ** 2)
        sums = np.einsum("pci,pc->ci", influence, term)
        total += np.einsum("ci,cj->ij", sums, sums.conj()).real / (2 * (np.pi * k) ** 2)
    return total


def deviation(values) -> float:
    """Standard deviation of noise, whatever a few of the values are; 1 of none."""
    # Of normal noise half lies below 0.6745 standard deviations.
    return float(np.median(np.abs(values)) / 0.6745) if values.size else 1.0


def structure(misfits: list[np.ndarray], apart: int = 1, alike: float = 1.0) -> tuple[float, float]:
    """Moran's I of the residuals, -1 to 1, and its significance.

    Noise is independent from pixel to pixel, and a wrong image is not: this tells a local minimum, or a scene that
    cannot look like its target, from the answer, however large the noise. Large ones are clipped: a firefly must not
    count for many, nor raise the noise by which a misfit of other pixels is measured. Pixels without a misfit have no
    noise either, as a background that is exactly right, and say nothing.

    Args:
        misfits: of each view (H, W, 3) image - target in standard deviations, 0 where the target may look so.
        apart, alike: where noise is correlated, the distance from which on it is not, and the sum of squared
            correlations around a pixel: only pixels that far from each other are compared.
    """
    products, expected, variances = [], [], []
    for misfit in misfits:
        f = np.clip(misfit, -STRUCTURE_CLIP, STRUCTURE_CLIP)
        present = f.any(-1)
        # (H, W, 3, 3): channels share their noise, and its size differs from place to place all the same.
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
