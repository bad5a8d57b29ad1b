"""Figures of the report: errors less that of the reference, efficiencies, slopes."""

from __future__ import annotations

import math
import statistics
from typing import NamedTuple

import numpy as np

from pathjax.images.metrics import RELATIVE_FLOOR, ROUNDING, rel_mse

# relMSE of rounding alone; a render with no more has no noise.
NO_NOISE = ROUNDING**2


class Reference(NamedTuple):
    """The mean of independent images."""

    image: np.ndarray  # (H, W, 3) float64
    variance: np.ndarray  # (H, W, 3) estimated from the spread of those images
    spp: int

    @property
    def noise(self) -> float:
        """Expected relMSE of the reference itself."""
        return float(np.mean(self.variance / self._scale))

    @property
    def _scale(self) -> np.ndarray:
        return self.image**2 + RELATIVE_FLOOR

    def errors(self, images) -> list[float]:
        """Return the relMSE of each image, biased up by `noise`, to leading order in the reference's error."""
        return [rel_mse(image, self.image) for image in images]

    def bias(self, images) -> dict:
        """Return the relMSE common to all images, less the noise of their mean and the reference; its standard error.

        The estimate is unbiased, so it may be negative. Its mean is 0 if independent images have the reference's mean.
        nan for a single image.
        """
        mean, variance, count = moments(images)
        if count < 2:
            return {"rel_mse": math.nan, "standard_error": math.nan}
        squares = ((mean - self.image) ** 2 - variance - self.variance) / self._scale
        pixels = squares.mean(-1).ravel()  # channels share their paths
        return {"rel_mse": float(pixels.mean()), "standard_error": standard_error(pixels)}


def moments(images) -> tuple[np.ndarray, np.ndarray, int]:
    """Return mean, estimated variance of the mean (0 for one image) and count of images, by Welford's algorithm.

    Only one image is in memory at a time.
    """
    count, mean, squares = 0, 0.0, 0.0
    for image in (np.asarray(image, float) for image in images):
        count += 1
        change = image - mean
        mean = mean + change / count
        squares = squares + change * (image - mean)
    return mean, squares / max(count - 1, 1) / count, count


def reference_of(images, spp_each: int) -> Reference:
    """Compute a reference from at least two independent images of `spp_each` samples."""
    mean, variance, count = moments(images)
    return Reference(mean, variance, count * spp_each)


def row(asked_spp: int, spp: int, seconds, errors, noise: float, paths: int, cpu_seconds=None) -> dict:
    """Return time, error and efficiency of several renders with different seeds.

    Args:
        seconds: time of each render.
        cpu_seconds: CPU time of each over all processors, which other load on the machine lengthens little.
        errors: relMSE of each render to the reference; noise: relMSE of the reference.
        paths: number of paths of a render with one sample per pixel.
    The error of non-finite images is not finite; the efficiency is None without noise.
    """
    run, measured = statistics.median(seconds), statistics.fmean(errors)
    error = measured - noise
    noisy = math.isfinite(error) and measured > NO_NOISE
    return {
        "asked_spp": asked_spp,
        "spp": spp,
        "seconds": list(seconds),
        "run_seconds": run,
        "cpu_seconds": cpu_seconds and statistics.median(cpu_seconds),
        "mpaths_per_second": paths * spp / run / 1e6,
        "rel_mse": error,
        "rel_mse_standard_error": standard_error(errors),
        "rel_mse_to_reference": measured,
        "reference_too_noisy": noisy and error < noise,
        "efficiency": 1 / (error * run) if noisy and error > 0 else None,
    }


def deviation(image, exact) -> dict:
    """Return the deviation of images from exact ones: relMSE, and the largest |I - E| / sqrt(E^2 + 0.01)."""
    image, exact = np.asarray(image, float), np.asarray(exact, float)
    relative = np.abs(image - exact) / np.sqrt(exact**2 + RELATIVE_FLOOR)
    return {"rel_mse": rel_mse(image, exact), "largest_deviation": float(relative.max())}


def standard_error(values) -> float:
    """Return the standard error of the mean; nan for fewer than two values."""
    return float(np.std(values, ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan


def slope(x, y) -> float | None:
    """Return the slope of log y over log x, by least squares; None without two different x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0]) if len(set(x)) > 1 else None


def slopes(rows) -> dict:
    """Return the slopes of the RMS error in samples (-0.5 if independent) and in seconds, over rows that have noise."""
    noisy = [row for row in rows if row["efficiency"]]
    rms = [math.sqrt(row["rel_mse"]) for row in noisy]
    return {"spp": slope([row["spp"] for row in noisy], rms), "seconds": slope([r["run_seconds"] for r in noisy], rms)}


def best(rows, asked_spp: int) -> dict | None:
    """Return the most efficient row with this `asked_spp`; None if none has noise."""
    candidates = [row for row in rows if row["asked_spp"] == asked_spp and row["efficiency"]]
    return max(candidates, key=lambda row: row["efficiency"], default=None)
