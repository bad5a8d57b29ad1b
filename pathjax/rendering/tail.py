"""Estimate the light that max_depth cuts off, by a geometric series through the last terms of L = Le + T Le + ...

Terms decay like powers of the largest eigenvalue of T once their light is spread over the scene. No fit can account for
paths that reach a light only after more vertices than were rendered (glass in glass).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pathjax.errors import InputError

# Number of last terms in the fit. The first term, lamps in view, is left out: it says nothing about the decay.
LAST = 4


@dataclass(frozen=True, eq=False)
class Tail:
    """Fit per channel, NumPy float64. The series continues after the last term as light * (1 - ratio) * ratio^k."""

    terms: np.ndarray  # (depth, 3) mean radiance of each term over the image
    standard_error: np.ndarray  # (depth, 3)
    ratio: np.ndarray  # (3,) of a term to the one before it; 0 where no light is left
    light: np.ndarray  # (3,) radiance of all terms beyond; inf where they do not decay
    covariance: np.ndarray  # (3, 2, 2) of log(last term) and log(ratio)

    def cut_off(self, max_depth: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the share of all light (3,) that is lost beyond max_depth terms, and its standard error (3,).

        Errors of terms are added as if fully correlated, the worst case.
        """
        if max_depth < 0:
            raise InputError(f"max_depth = {max_depth}; it is a number of terms, 0 or more")
        depth = len(self.terms)
        further = max(max_depth - depth, 0)
        with np.errstate(invalid="ignore"):
            beyond = self.light * self.ratio**further
            by_log = np.stack([np.ones(3), 1 / np.maximum(1 - self.ratio, np.finfo(float).tiny) + further], -1)
            error = beyond * np.sqrt(np.einsum("ci,cij,cj->c", by_log, self.covariance, by_log))
        lost = beyond + self.terms[max_depth:].sum(0)
        error = error + self.standard_error[max_depth:].sum(0)
        total = self.terms.sum(0) + self.light
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = [
                np.where(np.isinf(self.light), bad, np.where(total > 0, x / total, 0))
                for x, bad in ((lost, 1.0), (error, np.inf))
            ]
        return tuple(shares)

    def depth_for(self, error: float) -> int | None:
        """Return the least max_depth that cuts off at most this share of light in every channel; None: no decay.

        Raises:
            InputError: error is not between 0 and 1.
        """
        check_share(error)
        if not np.isfinite(self.light).all():
            return None
        depth = len(self.terms)
        for max_depth in range(1, depth + 1):
            if (self.cut_off(max_depth)[0] <= error).all():
                return max_depth
        share, _ = self.cut_off(depth)
        lacking = share > error
        further = np.log(error / share[lacking]) / np.log(self.ratio[lacking])
        return depth + math.ceil(further.max())


def check_share(error: float) -> None:
    """Refuse, with an InputError, a share of light to cut off that is not between 0 and 1."""
    if not 0 < error < 1:
        raise InputError(f"error = {error}; a share of light that may be cut off lies between 0 and 1")


def fit(terms: np.ndarray, standard_error: np.ndarray) -> Tail:
    """Fit the Tail to mean radiances (depth, 3) with their standard errors.

    Least squares for the logarithms, weighted by their errors; if they scatter more, the covariance grows accordingly.

    Raises:
        InputError: fewer than 3 terms.
    """
    if len(terms) < 3:
        raise InputError(f"depth = {len(terms)}; a tail needs two terms beside emission, so render 3 or more")
    terms, standard_error = np.asarray(terms, float), np.asarray(standard_error, float)
    first = max(1, len(terms) - LAST)
    fits = [_fit(terms[first:, channel], standard_error[first:, channel]) for channel in range(3)]
    ratio, light, covariance = (np.array(x) for x in zip(*fits, strict=True))
    return Tail(terms, standard_error, ratio, light, covariance)


def _fit(m, error):
    """Return ratio, light beyond, and the covariance (2, 2) of one channel."""
    if m[-1] <= 0:
        return 0.0, 0.0, np.zeros((2, 2))
    k = np.arange(len(m)) - (len(m) - 1.0)
    lit = m > 0
    k, m, error = k[lit], m[lit], error[lit]
    if len(m) < 2:
        return np.inf, np.inf, np.full((2, 2), np.inf)
    # Terms rendered without noise still have rounding errors.
    sigma = np.maximum(np.nan_to_num(error), np.finfo(np.float32).eps * m) / m
    design = np.stack([np.ones_like(k), k], -1) / sigma[:, None]
    covariance = np.linalg.inv(design.T @ design)
    last, slope = covariance @ design.T @ (np.log(m) / sigma)
    misfit = ((np.log(m) / sigma - design @ [last, slope]) ** 2).sum()
    covariance = covariance * max(1.0, misfit / max(len(m) - 2, 1))
    ratio = float(np.exp(slope))
    return ratio, float(np.exp(last) * ratio / (1 - ratio)) if ratio < 1 else np.inf, covariance
