"""Mitsuba's Gaussian: cut off at four standard deviations, and lowered so that it ends at 0."""

from __future__ import annotations

from dataclasses import dataclass

import jax

from pathjax.compile import register_dataclass
from pathjax.sensors.filters.tabulated import Tabulated


@register_dataclass
@dataclass(frozen=True)
class Gaussian(Tabulated):
    stddev: jax.Array | float = 0.5  # () pixels
    radius: jax.Array | float = 2.0  # ()

    @classmethod
    def read(cls, loader, fields) -> Gaussian:
        stddev = fields.float("stddev", 0.5, above=0, below=25)
        return cls(stddev, 4 * stddev)

    def height(self, x, xp):
        lowest = xp.exp(-(self.radius**2) / (2 * self.stddev**2))
        return xp.maximum(xp.exp(-(x**2) / (2 * self.stddev**2)) - lowest, 0)
