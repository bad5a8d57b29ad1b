"""Plastic as the sum of its lobes: Mitsuba's polarised plastic for unpolarised light."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.dielectric import IndexOfRefraction
from pathjax.bsdfs.ior import IOR
from pathjax.bsdfs.microfacet import mirrored
from pathjax.bsdfs.plastic import chance_of_coat, reflectance
from pathjax.bsdfs.rough import Rough
from pathjax.core.math import dot, safe_divide
from pathjax.core.types import BSDFSample
from pathjax.core.warp import chosen, square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Color, Row


class PPlastic(Rough):
    """One-sided: rough reflection plus a diffuse base, which light enters and leaves once through a smooth interface.

    Light that the interface reflects back to the base is lost. (Baek et al. 2018, "Simultaneous acquisition of
    polarimetric SVBRDF and normals".)
    """

    diffuse_reflectance = Color(0.5)
    specular_reflectance = Color(1.0)
    int_ior = IndexOfRefraction(IOR["polypropylene"])
    ext_ior = IndexOfRefraction(IOR["air"])

    @classmethod
    def read(cls, loader, fields, name):
        made = super().read(loader, fields, name)
        if made.values["int_ior"] == made.values["ext_ior"]:
            raise fields.error("int_ior", "must differ from ext_ior: between equal media nothing is reflected")
        return made

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        eta, facets, cosine = p.int_ior / p.ext_ior, Rough.facets(p), square_to_cosine_hemisphere_pdf(wo)
        mirrors_in, mirrors_out = reflectance(wi, eta), reflectance(wo, eta)
        share, m = facets.reflected(wi, wo)
        mirrors, _ = fresnel.dielectric(jnp.clip(dot(wi, m), 0, 1), eta)
        base = p.diffuse_reflectance * ((1 - mirrors_in) * (1 - mirrors_out) * cosine)
        chance = chance_of_coat(p, mirrors_in)
        pdf = chance * facets.detached().reflected_pdf(wi, wo) + (1 - chance) * cosine
        return base + p.specular_reflectance * (mirrors * share), pdf

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Mirror wi at a visible normal by about the coat's share of the light, else sample the cosine distribution."""
        on_coat, u = chosen(u, chance_of_coat(p, reflectance(wi, p.int_ior / p.ext_ior)))
        m = Rough.facets(p).detached().sample(wi, u)
        wo = jnp.where(on_coat, mirrored(wi, m), square_to_cosine_hemisphere(u))
        f, pdf = PPlastic.evaluate(p, wi, wo)
        return BSDFSample(wo, f * safe_divide(1.0, pdf), pdf, jnp.bool_(False), jnp.ones_like(pdf))
