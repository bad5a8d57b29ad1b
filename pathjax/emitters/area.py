"""Surfaces that emit from their front, at each point with the same radiance in all directions."""

from __future__ import annotations

import math

from jaxtyping import Array, Float

from pathjax.core.math import luminance
from pathjax.emitters.emitter import SurfaceEmitter
from pathjax.kinds import Color, Row


class Area(SurfaceEmitter):
    radiance = Color(1.0, bounds=(0, math.inf), radiance=True)
    even = True

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        return luminance(p.radiance)

    @staticmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        return p.radiance
