"""Rough glass."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.dielectric import IndexOfRefraction
from pathjax.bsdfs.interface import Interface
from pathjax.bsdfs.ior import IOR
from pathjax.bsdfs.rough import Rough
from pathjax.compile import compute_once
from pathjax.core.math import dot, normalize, safe_divide, smaller
from pathjax.core.types import BSDFSample
from pathjax.kinds import Row


class RoughDielectric(Rough, Interface):
    """Rough interface whose facets reflect or refract once (Walter et al. 2007). `int_ior` lies on the side that the
    normal points away from.

    Paths do not move with its IOR: directions are drawn by its primal value, and the weights carry the derivative. With
    GGX this lacks an edge term: there are upright facets, so f ends abruptly at directions that move with the IOR.
    """

    int_ior = IndexOfRefraction(IOR["bk7"])
    ext_ior = IndexOfRefraction(IOR["air"])
    lobes = True

    @classmethod
    def read(cls, loader, fields, name):
        made = super().read(loader, fields, name)
        if made.values["int_ior"] == made.values["ext_ior"]:
            raise fields.error("int_ior", "must differ from ext_ior: facets between equal media turn nothing")
        return made

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """As in `BSDF`; refraction scales radiance by 1/eta^2, with eta the IOR of the far side over the near side."""
        facets, eta, side = Rough.facets(p), _eta(p, wi), _side(wi)
        wi, wo = wi * side, wo * side
        reflects = wo[2] > 0
        # The normal of facets that send wi to wo: Walter et al., equations 13 and 16.
        h = wi + wo * jnp.where(reflects, 1, eta)
        squared = dot(h, h)
        m = normalize(h)
        m = compute_once(m * jnp.where(m[2] < 0, -1, 1))
        i, o = dot(wi, m), dot(wo, m) * jnp.where(reflects, 1, -1)
        # wi and wo each see the same side of the facet as of the surface.
        possible = (i > 0) & (o > 0) & (wi[2] > 0) & (wo[2] != 0)
        i = smaller(jnp.where(possible, i, 1), 1)
        reflectance, _ = fresnel.dielectric(i, eta)
        chance = jnp.where(reflects, reflectance, 1 - reflectance)
        # (wi . m) dm/dwo, equations 14 and 17; where light is reflected, 4 (wo . m)^2 is the square of h.
        spread = safe_divide(i * o * jnp.where(reflects, 1, eta * eta), jnp.where(possible, squared, 0))
        common = compute_once(chance * facets.area(m) * spread)
        far = jnp.stack([wo[0], wo[1], jnp.where(possible, jnp.abs(wo[2]), 1)])
        scale = jnp.where(reflects, 1, 1 / (eta * eta))
        above = jnp.stack([wi[0], wi[1], jnp.where(possible, wi[2], 1)])
        value = common * facets.seen(above) * (facets.seen(far) * far[2]) * scale
        pdf = lax.stop_gradient(common * facets.drawn(above))
        return Interface.tinted(p, value, reflects), pdf

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Sample a visible normal; reflect at it with the probability R, else refract."""
        eta, side = lax.stop_gradient(_eta(p, wi)), _side(wi)
        seen = wi * side
        m = Rough.facets(p).sample(seen, u)
        i = jnp.clip(dot(seen, m), 0, 1)
        reflectance, cos_t = fresnel.dielectric(i, eta)
        reflects = u[2] < reflectance
        # 2 i m - wi, or (i / eta - cos_t) m - wi / eta.
        scale = jnp.where(reflects, 1, 1 / eta)
        wo = ((scale * i + jnp.where(reflects, i, -cos_t)) * m - scale * seen) * side
        wo = compute_once(lax.stop_gradient(wo))
        f, pdf = RoughDielectric.evaluate(p, wi, wo)
        # If wo is on the wrong side of the surface for its lobe, the pdf from `evaluate` is that of the other lobe.
        pdf = jnp.where((wo[2] * side > 0) == reflects, pdf, 0)
        weight = jnp.where(pdf > 0, safe_divide(f, pdf), 0)
        passive = jnp.where(reflects, 1, scale * scale)
        return BSDFSample(wo, weight, pdf, jnp.bool_(False), passive)


def _side(wi):
    """Return -1 below the surface, else 1: the factor that turns wi to the upper side."""
    return jnp.where(wi[2] < 0, -1, 1).astype(wi.dtype)


def _eta(p, wi):
    """Return the IOR of the far side over that of the near side."""
    ratio = fresnel.relative(p.int_ior, p.ext_ior)
    return jnp.where(wi[2] < 0, 1 / ratio, ratio)
