"""A light infinitely far away, in one direction."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.math import luminance
from pathjax.emitters.emitter import DiracEmitter
from pathjax.kinds import Color, Direction, Row


class Directional(DiracEmitter):
    irradiance = Color(1.0, bounds=(0, math.inf), textured=False, radiance=True)  # of a surface that faces it, W / m^2
    direction = Direction()  # in which the light travels
    distant = True

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        return luminance(p.irradiance) / math.pi

    @staticmethod
    def sample(p: Row, ref: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        return -p.direction, jnp.full_like(ref[0], jnp.inf), p.irradiance
