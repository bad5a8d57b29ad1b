"""Burley's principled bsdf for surfaces too thin to refract: leaves, paper, panes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pathjax.bsdfs import burley, fresnel
from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.ior import LEAST_IOR
from pathjax.bsdfs.microfacet import mirrored
from pathjax.bsdfs.principled import Share, mean, within_shares
from pathjax.core.math import dot, normalize, safe_divide, smaller
from pathjax.core.types import BSDFSample
from pathjax.core.warp import chosen, square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Color, Number, Row, Unused


class PrincipledThin(BSDF):
    """The same on both sides (Burley 2015, 5.3). The share `diff_trans` / 2 of light at the base shines through."""

    base_color = Color(0.5)
    roughness = Number(0.5, bounds=(0, 1), textured=True)
    anisotropic = Share()
    spec_trans = Share()
    eta = Number(1.5, bounds=(LEAST_IOR, math.inf), textured=True)
    spec_tint = Share()
    sheen = Share()
    sheen_tint = Share()
    flatness = Share()
    diff_trans = Share(bounds=(0, 2))
    smooth = transmissive = sided = lobes = True
    unused: ClassVar[Mapping[str, Unused]] = {
        f"{side}_{way}_sampling_rate": Unused("float", "lobes are drawn by the light that they carry")
        for side in ("specular", "diffuse")
        for way in ("reflectance", "transmittance")
    }

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        return _evaluate(Look.of(p), wi, wo)

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Sample the facets or the base, reflecting or transmitting."""
        look, side = Look.of(p), _side(wi)
        seen, u = wi * side, jnp.stack([u[2], u[0], u[1]])
        from_base, u = chosen(u, look.chance_of_base(seen))
        through, u = chosen(u, jnp.where(from_base, look.chance_through_base, look.chance_through_facets(seen)))
        wo, lost = square_to_cosine_hemisphere(u[1:]), jnp.bool_(False)
        if look.spec_trans is not None:
            m = look.facets(through).detached().sample(seen, u[1:])
            wo = jnp.where(from_base, wo, mirrored(seen, m))
            lost = ~from_base & through & ~_leaves(wo, m)
        lost = lost | (wo[2] <= 0)
        wo = lax.stop_gradient(jnp.stack([wo[0], wo[1], jnp.where(through, -wo[2], wo[2])]) * side)
        f, pdf = _evaluate(look, wi, wo)
        one, pdf = jnp.ones_like(pdf), jnp.where(lost, 0, pdf)
        return BSDFSample(wo, jnp.where(lost, 0, f * safe_divide(one, pdf)), pdf, jnp.bool_(False), one)


class Look(NamedTuple):
    """Parameters at a point, each looked up once; None where no row of the table has it. Chances are detached."""

    base_color: Float[Array, "3"]
    roughness: Float[Array, ""]
    anisotropic: Float[Array, ""] | None
    spec_trans: Float[Array, ""] | None
    eta: Float[Array, ""]
    spec_tint: Float[Array, ""] | None
    sheen: Float[Array, ""] | None
    sheen_tint: Float[Array, ""] | None
    flatness: Float[Array, ""] | None
    diff_trans: Float[Array, ""] | None

    @classmethod
    def of(cls, p: Row) -> Look:
        return cls(*(getattr(p, name) for name in cls._fields))._replace(eta=fresnel.within(p.eta))

    @property
    def base(self) -> Float[Array, ""] | float:
        """Share of the base; the facets have the rest."""
        return 1.0 if self.spec_trans is None else 1 - self.spec_trans

    @property
    def through(self) -> Float[Array, ""] | float:
        """Share of the base's light that shines through."""
        return 0.0 if self.diff_trans is None else self.diff_trans / 2

    def facets(self, through: Bool[Array, ""]) -> burley.GGX:
        """Return the facets. For light through both interfaces roughness grows with the IOR (Burley 2015, 5.3)."""
        spread = jnp.where(through, 0.65 * self.eta - 0.35, 1)
        return burley.facets(spread * self.roughness, self.anisotropic)

    def reflectance(self, cos: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Return the reflectance of the facets, and the share that they transmit."""
        exact, cos_t = fresnel.dielectric(cos, self.eta)
        total = exact
        if self.spec_tint is not None:
            r0 = ((self.eta - 1) / (self.eta + 1)) ** 2 * burley.tint(self.base_color)
            tinted = burley.schlick(r0, jnp.where(self.eta < 1, cos_t, cos))
            total = exact + self.spec_tint * (tinted - exact)
        return jnp.broadcast_to(total, (3,)), 1 - exact

    def chance_of_base(self, wi: Float[Array, "3"]) -> Float[Array, ""]:
        if self.spec_trans is None:
            return jnp.ones_like(wi[2])
        reflected, passed = self.reflectance(jnp.clip(wi[2], 0, 1))
        share = within_shares(self.spec_trans)
        facets = share * (mean(reflected) + passed * mean(self.base_color))
        base = (1 - share) * mean(self.base_color)
        return lax.stop_gradient(base / (base + facets))

    @property
    def chance_through_base(self) -> Float[Array, ""]:
        if self.diff_trans is None:
            return jnp.zeros_like(self.roughness)
        return lax.stop_gradient(within_shares(self.through))

    def chance_through_facets(self, wi: Float[Array, "3"]) -> Float[Array, ""]:
        reflected, passed = self.reflectance(jnp.clip(wi[2], 0, 1))
        passed = passed * mean(self.base_color)
        return lax.stop_gradient(passed / (passed + mean(reflected)))


def _side(wi):
    return jnp.where(wi[2] < 0, -1, 1).astype(wi.dtype)


def _leaves(wo, m):
    """Return whether wo, once on the far side, is also beyond the facet; else it is lost, as in Mitsuba."""
    return wo[0] * m[0] + wo[1] * m[1] < wo[2] * m[2]


def _evaluate(look: Look, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    side = _side(wi)
    wi, wo = wi * side, wo * side
    through = wo[2] < 0
    possible = (wi[2] > 0) & (wo[2] != 0)
    wi, back = (jnp.stack([w[0], w[1], jnp.where(possible, jnp.abs(w[2]), 1)]) for w in (wi, wo))
    m = normalize(wi + back)
    cos_d = smaller(dot(wi, m), 1)

    # The base: reflected light, with sheen, and transmitted light.
    returns = look.base_color * burley.diffuse(look.roughness, look.flatness, wi[2], back[2], cos_d)
    if look.sheen is not None:
        fuzz = look.sheen * burley.sheen(back[2], cos_d)
        returns = returns + fuzz * burley.towards(look.sheen_tint, look.base_color)
    f, chance = (1 - look.through) * returns, 1.0
    if look.diff_trans is not None:
        f = jnp.where(through, look.through * look.base_color * (back[2] / math.pi), f)
        chance = jnp.where(through, look.chance_through_base, 1 - look.chance_through_base)
    base = look.chance_of_base(wi)
    f, pdf = look.base * f, base * chance * square_to_cosine_hemisphere_pdf(back)
    if look.diff_trans is None:
        f, pdf = jnp.where(through, 0, f), jnp.where(through, 0, pdf)

    # Facets also mirror the light that they transmit, to the far side.
    if look.spec_trans is not None:
        facets, (reflected, passed) = look.facets(through), look.reflectance(cos_d)
        value, _ = facets.reflected(wi, back)
        chance = look.chance_through_facets(wi)
        drawn = (1 - base) * jnp.where(through, chance, 1 - chance) * facets.reflected_pdf(wi, back)
        seen = ~through | _leaves(back, m)
        color = jnp.where(through, passed * look.base_color, reflected)
        f = f + jnp.where(seen, look.spec_trans * color * value, 0)
        pdf = pdf + jnp.where(seen, drawn, 0)
    return jnp.where(possible, f, 0), lax.stop_gradient(jnp.where(possible, pdf, 0))
