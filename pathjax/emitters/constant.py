"""The same radiance from all directions in which nothing is hit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.math import luminance
from pathjax.core.warp import SPHERE_PDF, square_to_sphere
from pathjax.emitters.emitter import Background
from pathjax.kinds import Color, Row, Unused


class Constant(Background):
    radiance = Color(1.0, bounds=(0, math.inf), textured=False, radiance=True)
    left_to_bsdfs = True
    unused: ClassVar[Mapping[str, Unused]] = {"to_world": Unused("transform")}

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        return luminance(p.radiance)

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"], u_part: Float[Array, ""]) -> Float[Array, "3"]:
        return square_to_sphere(u)

    @staticmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        return p.radiance

    @staticmethod
    def density(p: Row, d: Float[Array, "3"]) -> Float[Array, ""]:
        return jnp.full_like(d[0], SPHERE_PDF)
