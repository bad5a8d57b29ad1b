"""Comparison of an image file with a reference: metrics, z-scores if standard errors are known, a difference image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pathjax.errors import InputError
from pathjax.images.decoder import LINEAR, file_format
from pathjax.images.exr import read_exr
from pathjax.images.metrics import flip, mse, psnr, rel_mse, relative_error, sidak_p, z_scores
from pathjax.images.picture import side_by_side, signed_colors
from pathjax.images.read import read_rgb

ERROR_CHANNELS = "error.R", "error.G", "error.B"
# z-scores of this magnitude are shown in full colour.
_FULL_Z = 5


class Comparison(NamedTuple):
    image: np.ndarray  # (H, W, 3)
    reference: np.ndarray  # (H, W, 3)
    compared: np.ndarray  # (H, W) bool: finite in both images and in their errors
    hdr: bool  # both files are OpenEXR or Radiance HDR
    mse: float
    rel_mse: float
    relative_error: float  # nan if the reference has no level
    psnr: float  # dB
    peak: float  # of the PSNR: the reference's maximum if `hdr`, else 1
    flip: float | None  # mean; None without `flip-evaluator`
    z: np.ndarray | None  # (H, W, 3), nan where not compared; None without standard errors
    p: float | None  # Sidak's, over all pixels and channels
    exact: str | None  # file that was taken as exact, because it holds no standard errors


def compare(image_file: str, reference_file: str, errors: bool = False) -> Comparison:
    """Compare two files.

    Args:
        errors: weigh the differences by standard errors, which one or both hold as channels error.R, error.G, error.B.
    Raises:
        InputError: a file cannot be read, sizes differ, requested standard errors are missing, or no pixel is finite.
    """
    files = image_file, reference_file
    image, reference = (read_rgb(file) for file in files)
    if image.shape != reference.shape:
        (h, w, _), (k, v, _) = image.shape, reference.shape
        raise InputError(f"{image_file} is {w} x {h} and {reference_file} is {v} x {k}: compare images of one size")
    deviations = _read_errors(files, image.shape) if errors else ()
    compared = np.all([np.isfinite(x).all(-1) for x in (image, reference, *deviations) if x is not None], 0)
    if not compared.any():
        raise InputError(f"{image_file}, {reference_file}: no pixel is finite in both, so there is nothing to compare")

    a, b = image[compared], reference[compared]
    hdr = all(file_format(file) in LINEAR for file in files)
    peak = max(float(b.max()), 0.0) if hdr else 1.0
    shown = compared[..., None]
    differences = flip(np.where(shown, image, 0), np.where(shown, reference, 0), hdr)
    z, p, exact = None, None, None
    if errors:
        z = np.full(image.shape, np.nan)
        z[compared] = z_scores(a, b, *(0 if e is None else e[compared] for e in deviations))
        p = sidak_p(z[compared])
        exact = next((file for file, e in zip(files, deviations, strict=True) if e is None), None)
    mean_flip = None if differences is None else float(differences[compared].mean())
    measures = mse(a, b), rel_mse(a, b), relative_error(a, b), psnr(a, b, peak), peak, mean_flip
    return Comparison(image, reference, compared, hdr, *measures, z, p, exact)


def _read_errors(files, shape) -> list[np.ndarray | None]:
    """Return the standard errors (H, W, 3) of each file, None if it holds none."""
    errors, held = [], []
    for file in files:
        channels = read_exr(file)[0] if file_format(file) == "OpenEXR" else {}
        missing = [name for name in ERROR_CHANNELS if name not in channels]
        held.append(f"{file} holds {', '.join(sorted(channels)) or 'no named channels'}")
        error = None if missing else np.stack([channels[name] for name in ERROR_CHANNELS], -1)
        errors.append(error)
        if 0 < len(missing) < len(ERROR_CHANNELS) or error is not None and error.shape != shape:
            raise InputError(f"{file}: {', '.join(ERROR_CHANNELS)} must be there, all three, at the image's size")
    if all(e is None for e in errors):
        raise InputError(
            f"{'; '.join(held)}: standard errors are read from channels {', '.join(ERROR_CHANNELS)} of an EXR file; "
            "make them by `pathjax render -o x.exr --aov error`"
        )
    return errors


def facts(comparison: Comparison) -> dict:
    """Return a comparison as a dictionary for `json_text`."""
    c = comparison
    height, width = c.compared.shape
    values = {
        "width": width,
        "height": height,
        "not_finite_pixels": int((~c.compared).sum()),
        "mse": c.mse,
        "rel_mse": c.rel_mse,
        "relative_error": c.relative_error,
        "psnr": c.psnr,
        "psnr_peak": c.peak,
        "flip": c.flip,
        "flip_kind": "HDR" if c.hdr else "LDR",
    }
    if c.z is not None:
        z = c.z[c.compared]
        values |= {"mean_z2": float(np.mean(z**2)), "max_z": float(np.abs(z).max()), "p": c.p, "exact": c.exact}
    return values


def text(comparison: Comparison) -> str:
    c = comparison
    lost = int((~c.compared).sum())
    peak = "the reference's maximum" if c.hdr else "of display-referred images"
    seen = f"{c.flip:.4f} ({'HDR' if c.hdr else 'LDR'})" if c.flip is not None else "needs pip install 'pathjax[flip]'"
    lines = [
        f"MSE     {c.mse:.6g}",
        f"relMSE  {c.rel_mse:.6g}",
        f"error   {c.relative_error:.4g} (sqrt(relMSE) at the exposure of level 1, as of `render --error`)",
        f"PSNR    {c.psnr:.2f} dB (peak {c.peak:.6g}, {peak})",
        f"FLIP    {seen}",
    ]
    if c.z is not None:
        z = c.z[c.compared]
        lines.append(f"z       mean z^2 {np.mean(z**2):.4g}, largest |z| {np.abs(z).max():.4g}")
        lines.append(f"p       {c.p:.3g} (Sidak, over {z.size} values)")
    if c.exact is not None:
        lines.append(f"{c.exact} holds no standard errors and was taken as exact")
    if lost:
        lines.append(f"{lost} pixels are not finite and were left out")
    return "\n".join(lines)


def picture(comparison: Comparison) -> tuple[np.ndarray, float]:
    """Return (H, W', 3) linear RGB: image, reference, difference, and z if known; and the difference of full colour.

    Differences are means over the channels, z is the farthest from 0 of the three. Both are red where the image is
    brighter, blue where it is darker, black where not compared; z has full colour at +-5.
    """
    c = comparison
    with np.errstate(invalid="ignore"):
        difference = np.where(c.compared, (c.image.astype(float) - c.reference).mean(-1), np.nan)
    sizes = np.abs(difference[c.compared])
    scale = float(np.quantile(sizes, 0.99) or sizes.max() or 1)  # a firefly must not hide the rest
    parts = [c.image, c.reference, signed_colors(difference / scale)]
    if c.z is not None:
        farthest = np.abs(np.nan_to_num(c.z)).argmax(-1)[..., None]
        parts.append(signed_colors(np.take_along_axis(c.z, farthest, -1)[..., 0] / _FULL_Z))
    return side_by_side(parts), scale
