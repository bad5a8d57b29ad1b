"""A fit for people and scripts: a table, JSON-ready values, and a picture of target, fit and residual."""

from __future__ import annotations

import math

import numpy as np

from pathjax.images.picture import GAP, side_by_side, signed_colors
from pathjax.inverse.fitting import Fit

_FACTS = (
    *("converged", "message", "values", "standard_errors", "components", "covariance", "undetermined", "at_bound"),
    *("compile_seconds", "run_seconds", "history"),
)
# Residuals of this many standard deviations are shown in full colour.
_FULL_SCALE = 3


def facts(fit: Fit) -> dict:
    """What `json_text` writes of a fit."""
    return {name: getattr(fit, name) for name in _FACTS}


def text(fit: Fit) -> str:
    values = np.concatenate([np.ravel(v) for v in fit.values.values()])
    errors = np.concatenate([np.ravel(e) for e in fit.standard_errors.values()])
    width = max(map(len, fit.components))
    lines = []
    for label, value, error in zip(fit.components, values, errors, strict=True):
        digits = 6 if not 0 < error < math.inf else min(max(1 - math.floor(math.log10(error)), 0), 8)
        stated = f"+- {error:.{digits}f}" if math.isfinite(error) else "not determined" if error > 0 else "unknown"
        note = "  (at its bound)" if label in fit.at_bound else ""
        lines.append(f"{label:<{width}}  {value:.{digits}f}  {stated}{note}")
    for direction in fit.undetermined:
        together = ", ".join(f"{name} {change:+.3g}" for name, change in direction.items())
        lines.append(f"the images look the same along: {together}")
    lines.append(f"{fit.message} ({fit.run_seconds:.1f} s, and {fit.compile_seconds:.1f} s of compilation)")
    return "\n".join(lines)


def picture(fit: Fit, targets) -> np.ndarray:
    """(H, W, 3) linear RGB: a row for each view, of target, fit, and residual: blue too dark, red too bright.

    What was left out has no residual: nan, which a PNG shows black.
    """
    rows = []
    for target, image, residual in zip(targets, fit.images, fit.residuals, strict=True):
        share = residual.mean(-1) * math.sqrt(3) / _FULL_SCALE
        rows.append(side_by_side([target, image, signed_colors(share)]))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, GAP), (0, width - row.shape[1]), (0, 0)), constant_values=1) for row in rows]
    return np.concatenate(padded)[:-GAP].astype(np.float32)
