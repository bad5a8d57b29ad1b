"""Metrics of an image against a reference, for arrays (..., 3) of any shape except in `flip`."""

from __future__ import annotations

import math

import numpy as np

# Added to the squared reference in relative errors, so that black pixels do not dominate them.
RELATIVE_FLOOR = 0.01
# Share of the lit pixels that count in the level of an image; the brightest, visible lamps and skies, do not.
LEVEL_SHARE = 0.75
# Relative difference up to which values are equal: the rounding error of the mean of a pixel's samples in float32.
ROUNDING = 1e-5
# FLIP terminates the process if its reference is darker than this everywhere.
_FLIP_LEAST_LUMINANCE = 2e-7
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def mse(image, reference) -> float:
    return float(np.mean((np.asarray(image, float) - reference) ** 2))


def rel_mse(image, reference) -> float:
    """Return mean((I - R)^2 / (R^2 + 0.01)); nan if the image holds a nan."""
    reference = np.asarray(reference, float)
    return float(np.mean((np.asarray(image, float) - reference) ** 2 / (reference**2 + RELATIVE_FLOOR)))


def relative_error(image, reference) -> float:
    """Return sqrt(relMSE) of images exposed so that the reference has level 1, independent of the unit of radiance.

    This is sqrt(mean((I - R)^2 / (R^2 + 0.01 L^2))), where L is `level` of R; nan if L is nan.
    """
    exposure = 1 / level(reference)
    return math.sqrt(rel_mse(exposure * np.asarray(image, float), exposure * np.asarray(reference, float)))


def level(image) -> float:
    """Return the brightness of an image (..., 3): the mean of its lit pixels and channels, less the brightest quarter.

    So neither black pixels nor a visible lamp count, however bright. Pixels that are not finite are left out. nan if
    no pixel is lit, or if the level is below 1e-31, where contributions of single paths underflow in float32.
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
    """Return `x.mean(-1)`, faster: (..., 3) to (...)."""
    return sum(np.moveaxis(x, -1, 0)) / x.shape[-1]


def psnr(image, reference, peak: float) -> float:
    """Return 10 log10(peak^2 / MSE) in dB; infinite for equal images."""
    error = mse(image, reference)
    with np.errstate(divide="ignore"):
        return math.inf if error == 0 else float(10 * np.log10(peak**2 / error))


def flip(image, reference, hdr: bool) -> np.ndarray | None:
    """Return the FLIP map (H, W) in [0, 1] of finite images, at 67 pixels per degree; None without `flip-evaluator`.

    Args:
        hdr: HDR-FLIP of values clipped at 0, over exposures that suit the reference (Andersson et al. 2021);
            else LDR-FLIP of values clipped to [0, 1] (Andersson et al. 2020).
    """
    try:
        import flip_evaluator
    except ImportError:
        return None
    top, exposures = 1.0, {}
    if hdr:
        # FLIP finds exposures for any unit of radiance, unless it takes the reference for black: hence this scaling.
        top, brightest = float(np.finfo(np.float32).max), np.max(np.asarray(reference, float) @ _LUMINANCE)
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
    """Return differences over their standard errors, in float64.

    0 for values that are equal up to float32's rounding; infinite for different values without error.
    """
    image, reference = np.asarray(image, float), np.asarray(reference, float)
    difference = image - reference
    equal = np.abs(difference) <= ROUNDING * np.maximum(np.abs(image), np.abs(reference))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(equal, 0, difference / np.hypot(image_error, reference_error))


def sidak_p(z) -> float:
    """Return the probability that any of z.size independent standard normals is as far from 0 as the farthest of `z`.

    Standard errors that are themselves estimated from few passes spread z more widely, so that p is too low.
    """
    from scipy.special import log_ndtr

    tails = min(math.exp(math.log(2) + log_ndtr(-np.abs(z).max())), 1.0)
    with np.errstate(divide="ignore"):
        return float(-np.expm1(np.size(z) * np.log1p(-tails)))
