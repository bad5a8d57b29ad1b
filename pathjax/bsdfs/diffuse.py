"""Lambertian reflection."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs.bsdf import BSDF
from pathjax.core.types import BSDFSample
from pathjax.core.warp import square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Color, Row


class Diffuse(BSDF):
    """One-sided Lambertian reflector."""

    reflectance = Color(0.5)
    smooth = True

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        return p.reflectance * (jnp.maximum(wo[2], 0) / math.pi), square_to_cosine_hemisphere_pdf(wo)

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Sample `wo` from the cosine distribution; the weight is the albedo."""
        wo = square_to_cosine_hemisphere(u)
        one = jnp.ones_like(wo[2])
        return BSDFSample(wo, p.reflectance, square_to_cosine_hemisphere_pdf(wo), jnp.bool_(False), one)
