"""Cubics with negative lobes, which sharpen edges (Mitchell and Netravali 1988)."""

from __future__ import annotations

from dataclasses import dataclass

import jax

from pathjax.compile import register_dataclass
from pathjax.sensors.filters.tabulated import Tabulated


@register_dataclass
@dataclass(frozen=True)
class Mitchell(Tabulated):
    B: jax.Array | float = 1 / 3  # () how much it blurs
    C: jax.Array | float = 1 / 3  # () how much it rings
    radius: jax.Array | float = 2.0  # () pixels

    @classmethod
    def read(cls, loader, fields) -> Mitchell:
        B, C = (fields.float(name, 1 / 3, at_least=-10, at_most=10) for name in "BC")
        return cls(B, C)

    def height(self, x, xp):
        x, B, C = xp.abs(x), self.B, self.C
        near = ((12 - 9 * B - 6 * C) * x + (-18 + 12 * B + 6 * C)) * x * x + (6 - 2 * B)
        far = (((-B - 6 * C) * x + (6 * B + 30 * C)) * x + (-12 * B - 48 * C)) * x + (8 * B + 24 * C)
        return xp.where(x < 1, near, far)


@register_dataclass
@dataclass(frozen=True)
class CatmullRom(Mitchell):
    """The cubic that interpolates."""

    B: jax.Array | float = 0.0
    C: jax.Array | float = 0.5

    @classmethod
    def read(cls, loader, fields) -> CatmullRom:
        return cls()
