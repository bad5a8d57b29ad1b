"""The figures of the report: errors without the reference's own, efficiencies, slopes."""

from __future__ import annotations

import math
import statistics
from typing import NamedTuple

import numpy as np

from pathjax.images.metrics import RELATIVE_FLOOR, ROUNDING, rel_mse

# What rounding alone leaves; a render at or below has no noise.
NO_NOISE = ROUNDING**2


class Reference(NamedTuple):
    """The mean of independent images."""

    image: np.ndarray  # (H, W, 3) float64
    variance: np.ndarray  # (H, W, 3) estimated from the spread of those images
    spp: int

    @property
    def noise(self) -> float:
        """Its own expected relMSE."""
        return float(np.mean(self.variance / self._scale))

    @property
    def _scale(self) -> np.ndarray:
        return self.image**2 + RELATIVE_FLOOR

    def errors(self, images) -> list[float]:
        """relMSE of each image, expected to be too high by `noise`, up to higher orders of the reference's error."""
        return [rel_mse(image, self.image) for image in images]

    def bias(self, images) -> dict:
        """relMSE that the images have in common, noise of their mean and the reference's gone, and its standard error.

        An unbiased estimate, so it may be negative. Its mean is 0 where independent images have the reference's mean.
        nan of one image.
        """
        mean, variance, count = moments(images)
        if count < 2:
            return {"rel_mse": math.nan, "standard_error": math.nan}
        squares = ((mean - self.image) ** 2 - variance - self.variance) / self._scale
        pixels = squares.mean(-1).ravel()  # channels share their paths
        return {"rel_mse": float(pixels.mean()), "standard_error": standard_error(pixels)}


def moments(images) -> tuple[np.ndarray, np.ndarray, int]:
    """Mean, estimated variance of that mean (0 of one image), and count of images; Welford's, one in memory."""
    count, mean, squares = 0, 0.0, 0.0
    for image in (np.asarray(image, float) for image in images):
        count += 1
        change = image - mean
        mean = mean + change / count
        squares = squares + change * (image - mean)
    return mean, squares / max(count - 1, 1) / count, count


def reference_of(images, spp_each: int) -> Reference:
    """Reference from at least two independent images of `spp_each` samples."""
    mean, variance, count = moments(images)
    return Reference(mean, variance, count * spp_each)


def row(asked_spp: int, spp: int, seconds, errors, noise: float, paths: int, cpu_seconds=None) -> dict:
    """Time, error and efficiency of several renders that differ in their seeds.

    Args:
        seconds: that each took; cpu_seconds: of all processors, which others' work on the machine lengthens little.
        errors: relMSE of each to the reference; noise: that of the reference.
        paths: of a render of one sample a pixel.
    The error of images that are not finite is not either; the efficiency is None where there is no noise.
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
    """How images differ from exact ones: relMSE, and the largest |I - E| / sqrt(E^2 + 0.01)."""
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
    """The most efficient of the rows that answer `asked_spp`."""
    candidates = [row for row in rows if row["asked_spp"] == asked_spp and row["efficiency"]]
    return max(candidates, key=lambda row: row["efficiency"], default=None)
