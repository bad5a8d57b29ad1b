"""Smooth plastic: a diffuse base under a clear coat, a smooth interface."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.dielectric import IndexOfRefraction
from pathjax.bsdfs.ior import IOR
from pathjax.core.math import larger, safe_divide
from pathjax.core.types import BSDFSample
from pathjax.core.warp import chosen, square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Color, Flag, Row

# Least reflectance by which a lobe is chosen: a black one may still have a derivative.
LEAST_REFLECTANCE = 0.01


class Plastic(BSDF):
    """One-sided. The coat reflects in the mirror direction; light that enters the base leaves it through the coat.

    Light that the coat reflects back to the base is reflected there again, any number of times. With `nonlinear` the
    colour of the base counts each time, which saturates it; else it counts once.
    """

    diffuse_reflectance = Color(0.5)
    specular_reflectance = Color(1.0)
    int_ior = IndexOfRefraction(IOR["polypropylene"])
    ext_ior = IndexOfRefraction(IOR["air"])
    nonlinear = Flag()
    smooth = delta = True

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        eta = fresnel.relative(p.int_ior, p.ext_ior)
        passes_in, passes_out = 1 - reflectance(wi, eta), 1 - reflectance(wo, eta)
        cosine = square_to_cosine_hemisphere_pdf(wo)
        f = base(p, eta, fresnel.diffuse(1 / eta)) * (passes_in * passes_out * cosine)
        return f, (1 - chance_of_coat(p, 1 - passes_in)) * cosine

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Sample the mirror direction by about the coat's share of the light, else the cosine distribution."""
        mirrors = reflectance(wi, fresnel.relative(p.int_ior, p.ext_ior))
        chance = chance_of_coat(p, mirrors)
        coat, u = chosen(u, chance)
        diffuse = square_to_cosine_hemisphere(u)
        f, pdf = Plastic.evaluate(p, wi, diffuse)
        one = jnp.ones_like(pdf)
        wo = jnp.where(coat, jnp.stack([-wi[0], -wi[1], wi[2]]), diffuse)
        weight = jnp.where(coat, p.specular_reflectance * safe_divide(mirrors, chance), f * safe_divide(one, pdf))
        return BSDFSample(wo, weight, jnp.where(coat, chance, pdf), coat, one)


def reflectance(w: Float[Array, "3"], eta: Float[Array, ""]) -> Float[Array, ""]:
    """Return the reflectance of the coat from outside."""
    return fresnel.dielectric(jnp.clip(w[2], 0, 1), eta)[0]


def base(p: Row, eta: Float[Array, ""], leaves: Float[Array, ""]) -> Float[Array, "3"]:
    """Return the albedo of the base, with all reflections between it and the coat, over eta^2.

    The division is because radiance spreads where it leaves the coat.

    leaves: share of diffuse light that the coat does not send back to the base.
    """
    albedo, nonlinear = p.diffuse_reflectance, p.nonlinear
    if nonlinear is not None:
        leaves = leaves + (1 - leaves) * jnp.where(nonlinear, 1 - albedo, 0)
    return albedo / (leaves * (eta * eta))


def chance_of_coat(p: Row, mirrors: Float[Array, ""]) -> Float[Array, ""]:
    """Return the probability of sampling the coat, detached.

    mirrors: reflectance of the coat for light from `wi`.
    """
    specular, diffuse = (
        larger(jnp.mean(color), LEAST_REFLECTANCE) for color in (p.specular_reflectance, p.diffuse_reflectance)
    )
    coat = mirrors * specular
    return lax.stop_gradient(coat / (coat + (1 - mirrors) * diffuse))
