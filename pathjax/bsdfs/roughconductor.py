"""Rough metals."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs.conductor import Conductor
from pathjax.bsdfs.microfacet import mirrored
from pathjax.bsdfs.rough import Rough
from pathjax.compile import compute_once
from pathjax.core.math import dot, safe_divide, smaller
from pathjax.core.types import BSDFSample
from pathjax.kinds import Row


class RoughConductor(Rough, Conductor):
    """Rough one-sided metal; its facets reflect once (Walter et al. 2007; Heitz 2014)."""

    delta = False

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        facets = Rough.facets(p)
        share, m = compute_once(facets.reflected(wi, wo))
        f = Conductor.reflectance(p, smaller(dot(wi, m), 1)) * share
        return f, facets.detached().reflected_pdf(wi, wo)

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Mirror wi at a sampled visible normal."""
        wo = compute_once(mirrored(wi, Rough.facets(p).detached().sample(wi, u)))
        f, pdf = RoughConductor.evaluate(p, wi, wo)
        return BSDFSample(wo, safe_divide(f, pdf), pdf, jnp.bool_(False), jnp.ones_like(pdf))
