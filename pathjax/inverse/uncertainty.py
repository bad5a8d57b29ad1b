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
# Residuals have structure if neighbours share this part of their variance, with this significance.
STRUCTURE_SHARE, STRUCTURE_SIGNIFICANCE = 0.15, 5


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


def structure(residuals: list[np.ndarray], weights: list[np.ndarray]) -> tuple[float, float]:
    """Share of the residuals' variance that neighbouring pixels have in common, and its significance.

    Noise is independent from pixel to pixel, and a wrong image is not: this tells a local minimum, or a scene that
    cannot look like its target, from the answer, however large the noise.

    Args:
        residuals: of each view (2, H, W, 3), of two independent renders; weights: of each view (H, W, 3).
    """
    products, total = [], 0.0
    for (a, b), weight in zip(residuals, weights, strict=True):
        a, b = a * np.sqrt(weight), b * np.sqrt(weight)
        total += (a * b).sum()
        for x, y in ((a[1:], b[:-1]), (a[:-1], b[1:]), (a[:, 1:], b[:, :-1]), (a[:, :-1], b[:, 1:])):
            products.append((x * y).sum(-1).ravel() / 4)
    products = np.concatenate(products)
    spread = products.std() * np.sqrt(len(products))
    shared = products.sum()
    return float(shared / max(total, spread, np.finfo(float).tiny)), float(shared / max(spread, np.finfo(float).tiny))
