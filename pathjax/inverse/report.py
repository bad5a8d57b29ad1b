"""Reports of a fit: a table, JSON-ready values, and an image of target, fit and residual."""

from __future__ import annotations

import math

import numpy as np

from pathjax.images.picture import GAP, side_by_side, signed_colors
from pathjax.inverse.fitting import Fit
from pathjax.inverse.prior import is_grid
from pathjax.kinds.parameter import Parameter

_FACTS = (
    *("converged", "message", "values", "standard_errors", "components", "covariance", "undetermined", "at_bound"),
    *("compile_seconds", "run_seconds", "history"),
)
# Residuals of this many standard deviations are shown in full colour.
_FULL_SCALE = 3


def textures(fit: Fit) -> list[str]:
    """Return the names of the parameters that are images."""
    return [name for name in fit.values if is_grid(_parameter(fit, name))]


def summed_up(fit: Fit) -> list[str]:
    """Return the names of the parameters that are reported as a summary: images, volume grids and mesh attributes."""
    return [name for name in fit.values if _parameter(fit, name).is_texture]


def _parameter(fit: Fit, name: str) -> Parameter:
    return fit.scene.described.parameters[name]


def facts(fit: Fit) -> dict:
    """Return what `json_text` writes of a fit, with summaries of textures and grids, whose values belong in files."""
    found = {name: getattr(fit, name) for name in _FACTS}
    images = summed_up(fit)
    if images:
        for each in ("values", "standard_errors"):
            found[each] = {name: value for name, value in found[each].items() if name not in images}
        for each in ("components", "at_bound"):
            found[each] = [label for label in found[each] if label.partition("[")[0] not in images]
        found["textures"] = {name: _summary(fit, name) for name in images}
    return found


def _summary(fit: Fit, name: str) -> dict:
    value, error, seen = fit.values[name], fit.standard_errors[name], fit.seen[name]
    return {
        "shape": value.shape,
        "mean": value.mean(tuple(range(seen.ndim))),
        "seen": float(seen.mean()),
        "median_standard_error": float(np.median(error[seen])) if seen.any() else math.inf,
    }


def text(fit: Fit) -> str:
    images = summed_up(fit)
    listed = [label for label in fit.components if label.partition("[")[0] not in images]
    values, errors = (
        [x for name, array in arrays.items() if name not in images for x in np.ravel(array)]
        for arrays in (fit.values, fit.standard_errors)
    )
    width, lines = max(map(len, [*listed, *images])), []
    for name in images:
        known = _summary(fit, name)
        size = " x ".join(map(str, fit.seen[name].shape))
        typical = f"+- {known['median_standard_error']:.3g} in the median" if known["seen"] else "not determined"
        parts = "texels" if is_grid(_parameter(fit, name)) else "values"
        lines.append(f"{name:<{width}}  {size} {parts}, {known['seen']:.0%} of them seen, {typical}")
    for label, value, error in zip(listed, values, errors, strict=True):
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
    """Return linear RGB (H, W, 3): per view a row of target, fit, and residual, blue where too dark, red if too bright.

    Pixels that were left out have the residual nan, which is black in a PNG.
    """
    rows = []
    for target, image, residual in zip(targets, fit.images, fit.residuals, strict=True):
        share = residual.mean(-1) * math.sqrt(3) / _FULL_SCALE
        rows.append(side_by_side([target, image, signed_colors(share)]))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, GAP), (0, width - row.shape[1]), (0, 0)), constant_values=1) for row in rows]
    return np.concatenate(padded)[:-GAP].astype(np.float32)
