"""Lanczos's window of the sinc: sharp, with lobes that ring at edges."""

from __future__ import annotations

from dataclasses import dataclass

import jax

from pathjax.compile import register_dataclass
from pathjax.sensors.filters.tabulated import Tabulated


@register_dataclass
@dataclass(frozen=True)
class Lanczos(Tabulated):
    radius: jax.Array | float = 3.0  # () pixels, as many as lobes

    @classmethod
    def read(cls, loader, fields) -> Lanczos:
        return cls(float(fields.integer("lobes", 3, at_least=1, at_most=100)))

    def height(self, x, xp):
        return xp.sinc(x) * xp.sinc(x / self.radius)
