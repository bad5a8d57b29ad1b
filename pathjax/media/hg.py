"""Scattering mostly forwards, or mostly backwards (Henyey and Greenstein 1941, ApJ 93)."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pathjax.core.math import cos_sin_turns, larger, safe_sqrt
from pathjax.kinds import Number, Row
from pathjax.media.phase import Phase

# The largest float32 below 1: at 1 all light goes straight on, and there is no density.
_MOST = float(np.nextafter(np.float32(1), np.float32(0)))


class _Between(Number):
    """A number that is neither -1 nor 1 in files."""

    def read(self, loader, fields, name, owner):
        return fields.float(name, self.default, above=-1, below=1)


class HG(Phase):
    """A lobe around the direction of light, forwards if its mean cosine g is above 0, else backwards."""

    g = _Between(0.8, bounds=(-_MOST, _MOST))

    @staticmethod
    def evaluate(p: Row, wo: Float[Array, "3"]) -> Float[Array, ""]:
        """(1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^(3/2)), cos = -wo.z, without cancellation in the base."""
        side = jnp.where(p.g < 0, -1, 1).astype(wo.dtype)
        size = side * p.g
        squared = (1 - size) * (1 - size) + 2 * size * larger(1 + side * wo[2], 0)
        # Two quotients: derivatives divide by squares of denominators, and that of a single one underflows near g = 1.
        return (1 - size) / squared * ((1 + size) / ((4 * math.pi) * jnp.sqrt(squared)))

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"]) -> Float[Array, "3"]:
        """Invert the distribution of 1 - cos, in a form in which nothing cancels, not even at g = 0.

        With s = 1 - g + 2 g u the cosine is (1 + g^2 - ((1 - g^2) / s)^2) / 2g, so
        1 - cos = (1 - g)^2 (1 - u) (1 + (1 + g) / s) / s.
        """
        g = lax.stop_gradient(p.g)
        s = 1 - g + 2 * g * u[1]
        one_minus_cos = (1 - g) * (1 - g) * (1 - u[1]) * (1 + (1 + g) / s) / s
        cos, sin = cos_sin_turns(u[0])
        r = safe_sqrt(one_minus_cos * (2 - one_minus_cos))
        return jnp.stack([r * cos, r * sin, one_minus_cos - 1])
