"""Scattering by particles much smaller than the wavelength (Rayleigh 1871; sampling: Frisvad 2011, JOSA A 28(12))."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.math import cos_sin_turns, safe_sqrt
from pathjax.kinds import Row
from pathjax.media.phase import Phase


class Rayleigh(Phase):
    """Scatters equally forwards and backwards, and half as much to the sides."""

    @staticmethod
    def evaluate(p: Row, wo: Float[Array, "3"]) -> Float[Array, ""]:
        return (3 / (16 * math.pi)) * (1 + wo[2] * wo[2])

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"]) -> Float[Array, "3"]:
        """Invert the distribution (4 + 3 c + c^3) / 8 of the cosine c by Cardano's formula."""
        a = 4 * u[1] - 2
        root = jnp.cbrt(jnp.abs(a) + jnp.sqrt(a * a + 1))
        z = jnp.copysign(root - 1 / root, a)
        cos, sin = cos_sin_turns(u[0])
        r = safe_sqrt((1 - z) * (1 + z))
        return jnp.stack([r * cos, r * sin, z])
