"""What pixels can tell of parameters: scores of two independent renders, their covariance, what is not determined."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# A direction counts as determined if its curvature stands this many standard errors above 0 ...
MIN_SIGNIFICANCE = 4
# ... and its standard error is below this part of the parameters' scale.
MAX_RELATIVE_ERROR = 0.25
# Shares of an undetermined direction below which a component is not named, and not given an infinite error.
NAMED_SHARE, TOUCHED_SHARE = 0.2, 0.03
# Residuals have structure if they agree with this significance, those beyond the clip being clipped.
STRUCTURE_SIGNIFICANCE, STRUCTURE_CLIP = 6, 5


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


def solve(evidence: Evidence, weights, scale, free) -> Solution:
    """Eigenvectors of the curvature, those kept that noise cannot have made, and the sandwich covariance on them.

    Args:
        weights: (N, 3); scale: (n,) units of the components; free: (n,) bool, the others stay where they are.
    """
    weights = np.asarray(weights, np.float64)
    jacobians = np.asarray(evidence.jacobians, np.float64)[..., free] * scale[free]
    evidence = Evidence(np.asarray(evidence.residuals, np.float64), jacobians)
    curvature, vectors = np.linalg.eigh(evidence.matrix(weights, np))
    a, b = jacobians @ vectors
    by_pixel = np.einsum("pci,pci,pc->pi", a, b, weights)
    noise = by_pixel.std(0) * np.sqrt(len(by_pixel))
    # Columns that are the same up to the rounding of float32 leave a curvature of its square.
    rounding = curvature.max() * (10 * np.finfo(np.float32).eps) ** 2
    significant = curvature > np.maximum(MIN_SIGNIFICANCE * noise, rounding)
    # Pixels are independent: their scatter is that of the score, with target, renders and Jacobians (White 1980).
    along = evidence.scores(weights, np) @ vectors
    spread = along - along.mean(0)
    inverse = np.where(significant, 1 / np.where(significant, curvature, 1), 0)
    covariance = inverse[:, None] * (spread.T @ spread) * inverse
    kept = significant & (np.sqrt(np.diag(covariance)) < MAX_RELATIVE_ERROR)

    everywhere = np.zeros((len(free), len(vectors)))
    everywhere[free] = vectors
    inside = everywhere[:, kept]
    covariance = inside @ covariance[np.ix_(kept, kept)] @ inside.T
    return Solution(inside @ inside.T, covariance, everywhere[:, ~kept], -inside @ (inverse * along.sum(0))[kept])


def structure(differences: list[np.ndarray], misfits: list[np.ndarray]) -> tuple[float, float]:
    """Moran's I of the residuals, -1 to 1, and its significance.

    Noise is independent from pixel to pixel, and a wrong image is not: this tells a local minimum, or a scene that
    cannot look like its target, from the answer, however large the noise.

    Their unit is the residuals' median, and the rare large ones count for `STRUCTURE_CLIP` units. So a misfit of a few
    neighbours, as of a lamp that is wrong, does not hide itself by its own size, and a firefly does not count for many.

    Args:
        differences: of each view (H, W, 3) image - target, in any unit in which noise is alike everywhere; nan where
            the target gives no value.
        misfits: the same, but 0 where the target may look so, and nan where it says nothing.
    """
    sizes = np.concatenate([np.abs(d[np.isfinite(d)]) for d in differences])
    # Of normal noise half lies below 0.6745 standard deviations.
    unit = max(np.median(sizes) / 0.6745, np.finfo(float).tiny)
    pairs, squares, pixels = [], 0.0, 0
    for misfit in misfits:
        known = np.isfinite(misfit).any(-1)
        f = np.clip(np.nan_to_num(misfit / unit), -STRUCTURE_CLIP, STRUCTURE_CLIP)
        squares, pixels = squares + np.einsum("hwc,hwd->cd", f, f), pixels + known.sum()
        for here, there in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            pairs.append((f[here] * f[there]).sum(-1)[known[here] & known[there]])
    pairs, squares = np.concatenate(pairs), np.maximum(squares / max(pixels, 1), np.finfo(float).tiny)
    # Of independent pixels: channels of one pixel share their noise.
    deviation = np.sqrt((squares**2).sum() / max(len(pairs), 1))
    mean = pairs.sum() / max(len(pairs), 1)
    return float(mean / np.trace(squares)), float(mean / deviation)
