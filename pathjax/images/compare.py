"""How an image differs from a reference: measures of error, z-scores where standard errors are known, a picture.

Images are (H, W, 3) linear RGB; what averages over pixels takes (..., 3) of any shape.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pathjax.errors import InputError
from pathjax.images.image import file_format, read_exr, read_rgb
from pathjax.images.picture import side_by_side, signed_colors

# Added to the squared reference in relative errors, so that black pixels do not rule them.
RELATIVE_FLOOR = 0.01
# The brightest of the lit pixels, lamps and skies in view, do not count in the level of an image; the others do.
LEVEL_SHARE = 0.75
# Values are equal if they differ by this share or less: float32 leaves as much in the mean of a pixel's samples.
ROUNDING = 1e-5
ERROR_CHANNELS = "error.R", "error.G", "error.B"
# FLIP ends the process if its reference is darker than this everywhere.
_FLIP_LEAST_LUMINANCE = 2e-7
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_FULL_Z = 5


# ---- measures -----------------------------------------------------------------------------------------------------


def mse(image, reference) -> float:
    return float(np.mean((np.asarray(image, float) - reference) ** 2))


def rel_mse(image, reference) -> float:
    """mean((I - R)^2 / (R^2 + 0.01)); nan if the image holds one."""
    reference = np.asarray(reference, float)
    return float(np.mean((np.asarray(image, float) - reference) ** 2 / (reference**2 + RELATIVE_FLOOR)))


def relative_error(image, reference) -> float:
    """sqrt(relMSE) of images exposed so that the reference has the level 1: the same in any unit of radiance.

    So sqrt(mean((I - R)^2 / (R^2 + 0.01 L^2))), where L is `level` of R. nan where that is not known.
    """
    exposure = 1 / level(reference)
    return math.sqrt(rel_mse(exposure * np.asarray(image, float), exposure * np.asarray(reference, float)))


def level(image) -> float:
    """How bright an image (..., 3) is: the mean of its lit pixels and their channels, but for the brightest quarter.

    So neither what is black counts nor a lamp in view, however bright. Pixels that are not finite are left out. nan
    where nothing is lit, or the level is below 1e-31: what single paths add to it then underflows in float32.
    """
    brightness = mean_of_channels(np.asarray(image, float))
    lit = brightness[np.isfinite(brightness) & (brightness > 0)]
    if not lit.size:
        return math.nan
    count = math.ceil(LEVEL_SHARE * lit.size)
    level = float(np.partition(lit, count - 1)[:count].mean())
    single = np.finfo(np.float32)
    return level if level > single.tiny / single.eps else math.nan


def mean_of_channels(x: np.ndarray) -> np.ndarray:
    """(...) of (..., 3): `x.mean(-1)`, but faster."""
    return sum(np.moveaxis(x, -1, 0)) / x.shape[-1]


def psnr(image, reference, peak: float) -> float:
    """10 log10(peak^2 / MSE) in dB; infinite for equal images."""
    error = mse(image, reference)
    with np.errstate(divide="ignore"):
        return math.inf if error == 0 else float(10 * np.log10(peak**2 / error))


def flip(image, reference, hdr: bool) -> np.ndarray | None:
    """FLIP map (H, W) in [0, 1] of finite images, seen at 67 pixels per degree; None without `flip-evaluator`.

    Args:
        hdr: HDR-FLIP, over the exposures that suit the reference (Andersson et al. 2021), of values clipped at 0;
            else LDR-FLIP (Andersson et al. 2020), of values clipped to [0, 1].
    """
    try:
        import flip_evaluator
    except ImportError:
        return None
    top, exposures = 1, {}
    if hdr:
        # FLIP exposes the reference well in any unit of radiance, if the program does not take it for black.
        top, brightest = np.finfo(np.float32).max, np.max(np.asarray(reference, float) @ _LUMINANCE)
        _, exponent = np.frexp(np.nanmax([brightest, level(image)]))
        image, reference = (np.ldexp(np.asarray(x, float), -exponent) for x in (image, reference))
        if np.ldexp(brightest, -exponent) < _FLIP_LEAST_LUMINANCE:
            exposures = {"startExposure": 0.0, "stopExposure": 0.0}
    image, reference = (np.ascontiguousarray(np.clip(x, 0, top), np.float32) for x in (image, reference))
    errors, _, _ = flip_evaluator.evaluate(
        reference, image, "HDR" if hdr else "LDR", inputsRGB=False, applyMagma=False, parameters=exposures
    )
    return errors[..., 0]


def z_scores(image, reference, image_error, reference_error) -> np.ndarray:
    """Differences over their standard errors, in float64.

    Values that are equal up to float32's rounding: 0. Different values without error: infinite.
    """
    image, reference = np.asarray(image, float), np.asarray(reference, float)
    difference = image - reference
    equal = np.abs(difference) <= ROUNDING * np.maximum(np.abs(image), np.abs(reference))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(equal, 0, difference / np.hypot(image_error, reference_error))


def sidak_p(z) -> float:
    """Chance that some one of as many independent standard normal numbers is as far from 0 as the farthest of `z`.

    Standard errors that are themselves estimated from few passes spread z more widely than that, and p comes out low.
    """
    from scipy.special import log_ndtr

    tails = min(math.exp(math.log(2) + log_ndtr(-np.abs(z).max())), 1.0)
    with np.errstate(divide="ignore"):
        return float(-np.expm1(np.size(z) * np.log1p(-tails)))


# ---- two files ----------------------------------------------------------------------------------------------------


class Comparison(NamedTuple):
    image: np.ndarray  # (H, W, 3)
    reference: np.ndarray  # (H, W, 3)
    compared: np.ndarray  # (H, W) bool: finite in all that was read
    hdr: bool  # neither is PNG or JPEG
    mse: float
    rel_mse: float
    relative_error: float  # nan where the reference has no level
    psnr: float  # dB
    peak: float  # of the PSNR: 1 where one is PNG or JPEG, else the reference's maximum
    flip: float | None  # mean; None without `flip-evaluator`
    z: np.ndarray | None  # (H, W, 3), nan where not compared; None without standard errors
    p: float | None  # Sidak's, over all pixels and channels
    exact: str | None  # the file that was taken as exact, for it holds no standard errors


def compare(image_file: str, reference_file: str, errors: bool = False) -> Comparison:
    """Compare two files.

    Args:
        errors: weigh the differences by standard errors, which one or both hold as channels error.R, error.G, error.B.
    Raises:
        InputError: a file that cannot be read, two sizes, no standard errors where they are asked for, nothing finite.
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
    hdr = all(file_format(file) == "OpenEXR" for file in files)
    peak = max(float(b.max()), 0.0) if hdr else 1.0
    differences = flip(*(np.where(compared[..., None], x, 0) for x in (image, reference)), hdr)
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
    """(H, W, 3) of each file, None where it holds none."""
    errors, held = [], []
    for file in files:
        channels = read_exr(file)[0] if file_format(file) == "OpenEXR" else {}
        missing = [name for name in ERROR_CHANNELS if name not in channels]
        held.append(f"{file} holds {', '.join(sorted(channels)) or 'no named channels'}")
        errors.append(None if missing else np.stack([channels[name] for name in ERROR_CHANNELS], -1))
        if 0 < len(missing) < len(ERROR_CHANNELS) or not missing and errors[-1].shape != shape:
            raise InputError(f"{file}: {', '.join(ERROR_CHANNELS)} must be there, all three, at the image's size")
    if all(e is None for e in errors):
        raise InputError(
            f"{'; '.join(held)}: standard errors are read from channels {', '.join(ERROR_CHANNELS)} of an EXR file; "
            "make them by `pathjax render -o x.exr --aov error`"
        )
    return errors


# ---- reports ------------------------------------------------------------------------------------------------------


def facts(comparison: Comparison) -> dict:
    """What `json_text` writes of a comparison."""
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
    """(H, W', 3) linear RGB: image, reference, difference, and z where known; and the difference of full colour.

    Differences are means over the channels, z the farthest from 0 of the three; both red where the image is brighter,
    blue where it is darker, black where they were not compared; z in full colour at +-5.
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
