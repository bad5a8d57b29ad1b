"""A point light with the same intensity in all directions."""

from __future__ import annotations

import math

from jaxtyping import Array, Float

from pathjax.core.math import dot, luminance, safe_divide, safe_sqrt
from pathjax.emitters.emitter import DiracEmitter
from pathjax.kinds import Color, Position, Row

# Share of the way to the light at which shadow rays end, as in Mitsuba: a surface at the light does not hide it.
REACH = 1 - 2**-10


class Point(DiracEmitter):
    intensity = Color(1.0, bounds=(0, math.inf), textured=False, radiance=True)  # W / sr
    position = Position()

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        return 4 * luminance(p.intensity)

    @staticmethod
    def sample(p: Row, ref: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        """As in `DiracEmitter`; at the light itself no light arrives."""
        to_light = p.position - ref
        squared = dot(to_light, to_light)
        distance = safe_sqrt(squared)
        return to_light * safe_divide(1, distance), distance * REACH, p.intensity * safe_divide(1, squared)
