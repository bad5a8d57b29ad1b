"""Rough plastic: a diffuse base under a rough coat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs import coat, fresnel
from pathjax.bsdfs.microfacet import DISTRIBUTIONS, mirrored
from pathjax.bsdfs.plastic import Plastic, base, chance_of_coat
from pathjax.bsdfs.rough import Rough, Roughness
from pathjax.core.math import dot, safe_divide
from pathjax.core.types import BSDFSample
from pathjax.core.warp import chosen, square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Choice, PerRow, Row, Unused


class RoughPlastic(Plastic):
    """`Plastic` with a coat of facets, which reflect or refract once (Walter et al. 2007)."""

    alpha = Roughness(0.1)
    distribution = Choice("beckmann", options=tuple(DISTRIBUTIONS))
    coat = PerRow()  # from `coat.coats`
    delta = False
    unused: ClassVar[Mapping[str, Unused]] = Rough.unused

    @classmethod
    def derived(cls, table, changed=()):
        alpha, inside, outside = (table.column(name).values for name in ("alpha", "int_ior", "ext_ior"))
        return table.with_column("coat", coat.coats(dict(table.settings)["distribution"], alpha, inside / outside))

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        eta, facets, cosine = _eta(p), _facets(p), square_to_cosine_hemisphere_pdf(wo)
        T, returns = coat.at(p.coat, p.alpha, eta)
        passes_in, passes_out = (coat.passes(T, jnp.clip(w[2], 0, 1)) for w in (wi, wo))
        share, m = facets.reflected(wi, wo)
        mirrors, _ = fresnel.dielectric(jnp.clip(dot(wi, m), 0, 1), eta)
        f = base(p, eta, 1 - returns) * (passes_in * passes_out * cosine) + p.specular_reflectance * (mirrors * share)
        chance = chance_of_coat(p, 1 - passes_in)
        return f, chance * facets.detached().reflected_pdf(wi, wo) + (1 - chance) * cosine

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Mirror wi at a visible normal by about the coat's share of the light, else sample the cosine distribution."""
        T, _ = coat.at(p.coat, p.alpha, _eta(p))
        on_coat, u = chosen(u, chance_of_coat(p, 1 - coat.passes(T, jnp.clip(wi[2], 0, 1))))
        m = _facets(p).detached().sample(wi, u)
        wo = jnp.where(on_coat, mirrored(wi, m), square_to_cosine_hemisphere(u))
        f, pdf = RoughPlastic.evaluate(p, wi, wo)
        return BSDFSample(wo, f * safe_divide(1.0, pdf), pdf, jnp.bool_(False), jnp.ones_like(pdf))


def _eta(p: Row):
    return fresnel.relative(p.int_ior, p.ext_ior)


def _facets(p: Row):
    return DISTRIBUTIONS[p.distribution].of(p.alpha, p.alpha)
