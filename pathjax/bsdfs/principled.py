"""Burley's principled bsdf: opaque, or with a clear part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pathjax.bsdfs import burley, fresnel
from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.ior import LEAST_IOR
from pathjax.bsdfs.microfacet import mirrored
from pathjax.core.math import dot, larger, normalize, safe_divide, safe_sqrt, smaller
from pathjax.core.types import BSDFSample
from pathjax.core.warp import chosen, square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Color, Number, Row, Unused

# Least reflectance by which a lobe is chosen: a black one may still have a derivative.
LEAST_REFLECTANCE = 0.01
# Facets between equal media do not deflect light, so transmitted light has no density. These are Mitsuba's least
# `specular` of clear bsdfs, and their IOR where it is 1.
LEAST_CLEAR_SPECULAR, LEAST_CLEAR_IOR = 1e-3, 1.001


@dataclass(frozen=True)
class Share(Number):
    """A share in [0, 1]. At 0, the default, it is no parameter, and its effect is left out of the program."""

    bounds: tuple[float, float] = (0, 1)
    textured: bool = True

    def read(self, loader, fields, name, owner):
        value = super().read(loader, fields, name, owner)
        return None if isinstance(value, float | int) and value == 0 else value


RATES = {
    f"{lobe}_sampling_rate": Unused("float", "lobes are drawn by the light that they carry")
    for lobe in ("main_specular", "clearcoat", "diffuse_reflectance")
}


class Principled(BSDF):
    """One-sided: a blend of a metal and a diffuse base under a rough coat, with sheen and a second, clear coat."""

    base_color = Color(0.5)
    roughness = Number(0.5, bounds=(0, 1), textured=True)
    anisotropic = Share()
    metallic = Share()
    spec_trans = Share()
    eta = Number(None, bounds=(LEAST_IOR, math.inf))
    specular = Number(None, bounds=(0, 1))  # instead of eta
    spec_tint = Share()
    sheen = Share()
    sheen_tint = Share()
    flatness = Share()
    clearcoat = Share()
    clearcoat_gloss = Share()
    smooth = True
    unused: ClassVar[Mapping[str, Unused]] = RATES

    @classmethod
    def read(cls, loader, fields, name):
        if fields.has("eta") and fields.has("specular"):
            raise fields.error("specular", "cannot stand beside eta; give one or the other")
        values = super().read(loader, fields, name).values
        # Tints and glosses of absent lobes are no parameters.
        without = {"sheen": ("sheen_tint",), "clearcoat": ("clearcoat_gloss",)}
        unasked = {part: None for whole, parts in without.items() if values[whole] is None for part in parts}
        return (cls if values["spec_trans"] is None else ClearPrincipled).instance(name, **{**values, **unasked})

    @classmethod
    def instance(cls, name="", **values):
        if values.get("eta") is None and values.get("specular") is None:
            values["specular"] = 0.5
        return super().instance(name, **values)

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        return _evaluate(_look(p), wi, wo)

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        return _sample(_look(p), wi, u)


class ClearPrincipled(Principled):
    """A principled bsdf whose non-metallic part is glass by the share `spec_trans`: an interface, with `eta` inside.

    From inside, only the glass is seen. The derivative in `eta` lacks an edge term, as in `RoughDielectric` with GGX.
    """

    transmissive = sided = lobes = True


# ---- shared by both -------------------------------------------------------------------------------------------------


class Look(NamedTuple):
    """Parameters at a point, each looked up once; None where no row of the table has it."""

    base_color: Float[Array, "3"]
    roughness: Float[Array, ""]
    anisotropic: Float[Array, ""] | None
    metallic: Float[Array, ""] | None
    spec_trans: Float[Array, ""] | None
    spec_tint: Float[Array, ""] | None
    sheen: Float[Array, ""] | None
    sheen_tint: Float[Array, ""] | None
    flatness: Float[Array, ""] | None
    clearcoat: Float[Array, ""] | None
    clearcoat_gloss: Float[Array, ""] | None
    eta: Float[Array, ""]

    @property
    def dielectric(self) -> Float[Array, ""] | float:
        """Share of the non-metallic part."""
        return 1.0 if self.metallic is None else 1 - self.metallic

    @property
    def clear(self) -> Float[Array, ""] | float:
        """Share of glass."""
        return 0.0 if self.spec_trans is None else self.dielectric * self.spec_trans

    @property
    def opaque(self) -> Float[Array, ""] | float:
        """Share of the part with a diffuse base."""
        return self.dielectric if self.spec_trans is None else self.dielectric * (1 - self.spec_trans)

    def mixed(self) -> Look:
        """Return the look by which lobes are chosen. Each has a chance, since one of share 0 may have a derivative."""
        shares = {name: getattr(self, name) for name in ("metallic", "spec_trans", "clearcoat")}
        return self._replace(**{name: within_shares(share) for name, share in shares.items() if share is not None})


def within_shares(share: Float[Array, ""]) -> Float[Array, ""]:
    """Clamp a share () away from 0 and 1, so that each of two lobes has a chance."""
    return jnp.clip(share, LEAST_REFLECTANCE, 1 - LEAST_REFLECTANCE)


def _look(p: Row) -> Look:
    values = {name: getattr(p, name) for name in Look._fields if name != "eta"}
    eta, specular, clear = p.eta, p.specular, values["spec_trans"] is not None
    if eta is not None and clear:
        eta = jnp.where(jnp.abs(eta - 1) < LEAST_CLEAR_IOR - 1, LEAST_CLEAR_IOR, eta)
    if specular is not None:
        # R0 = 0.08 specular. Rows with an eta of their own have specular 0, the others eta 0.
        specular = larger(specular, LEAST_CLEAR_SPECULAR) if clear else specular
        of_specular = 2 / (1 - safe_sqrt(0.08 * specular)) - 1
        eta = of_specular if eta is None else jnp.where(p.eta > 0, eta, of_specular)
    return Look(**values, eta=fresnel.within(eta))


def _reflectance(look: Look, cos: Float[Array, ""], inside: Bool[Array, ""] | None):
    """Return the reflectance of the facets (3,), that of their glass alone, and the cosine behind them.

    (Burley 2012, 2015.) inside: None: never.
    """
    eta = look.eta if inside is None else jnp.where(inside, 1 / look.eta, look.eta)
    exact, cos_t = fresnel.dielectric(cos, eta)
    total = exact if look.spec_tint is None else exact * (1 - look.spec_tint)
    grazing = jnp.where(eta < 1, cos_t, cos)
    if look.spec_tint is not None:
        r0 = ((eta - 1) / (eta + 1)) ** 2
        total = total + look.spec_tint * burley.schlick(r0 * burley.tint(look.base_color), grazing)
    total = look.dielectric * total
    if look.metallic is not None:
        total = total + look.metallic * burley.schlick(look.base_color, grazing)
    if inside is not None:
        total = jnp.where(inside, look.clear * exact, total)
    return jnp.broadcast_to(total, (3,)), exact, cos_t


def mean(color: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the mean of the channels for chances, at least LEAST_REFLECTANCE."""
    return larger(jnp.mean(color), LEAST_REFLECTANCE)


class Chances(NamedTuple):
    """Probabilities of the lobes, by about the light that they carry; detached."""

    base: Float[Array, ""]
    coat: Float[Array, ""] | None  # given that it is not the base; the facets have the rest

    @classmethod
    def of(cls, look: Look, cos: Float[Array, ""], inside: Bool[Array, ""] | None) -> Chances:
        reflectance, exact, _ = _reflectance(look, cos, inside)
        look = look.mixed()
        facets = mean(reflectance) + look.clear * (1 - exact)
        outside = 1.0 if inside is None else jnp.where(inside, 0.0, 1.0)
        coat = None if look.clearcoat is None else outside * look.clearcoat * burley.schlick(burley.COAT_R0, cos) * cos
        rest = facets if coat is None else facets + coat
        base = outside * look.opaque * mean(look.base_color)
        return lax.stop_gradient(cls(base / (base + rest), None if coat is None else coat / rest))


def _refracts(look: Look, reflectance: Float[Array, "3"], exact: Float[Array, ""]) -> Float[Array, ""]:
    """Return the probability that facets transmit instead of reflecting, detached."""
    through = look.mixed().clear * (1 - exact) * mean(safe_sqrt(look.base_color))
    reflected = larger(jnp.mean(reflectance), LEAST_REFLECTANCE * exact)
    return lax.stop_gradient(safe_divide(through, through + reflected))


def _side(look: Look, wi: Float[Array, "3"]):
    """Return whether wi is inside (None: never), wi turned to the upper side, and the sign that turns it."""
    if look.spec_trans is None:
        return None, wi, 1
    side = jnp.where(wi[2] < 0, -1, 1).astype(wi.dtype)
    return wi[2] < 0, wi * side, side


def _evaluate(look: Look, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    inside, wi, side = _side(look, wi)
    wo = wo * side
    reflects = wo[2] > 0
    # IOR of the side of wo over that of wi; facets that send wi to wo have the normal m (Walter et al. 2007).
    eta = 1.0 if inside is None else jnp.where(reflects, 1, jnp.where(inside, 1 / look.eta, look.eta))
    h = wi + eta * wo
    m = normalize(h) * jnp.where(h[2] < 0, -1, 1)
    cos_i, cos_o = dot(wi, m), dot(wo, m) * jnp.where(reflects, 1, -1)
    possible = (cos_i > 0) & (cos_o > 0) & (wi[2] > 0) & (reflects if inside is None else wo[2] != 0)
    cos_i = smaller(jnp.where(possible, cos_i, 1), 1)
    wi, far = (jnp.stack([w[0], w[1], jnp.where(possible, jnp.abs(w[2]), 1)]) for w in (wi, wo))

    # Facets: D times (wi . m) dm/dwo, which is D/4 where they reflect.
    spread = cos_i * cos_o * eta * eta / jnp.where(possible, dot(h, h), 1)
    facets = burley.facets(look.roughness, look.anisotropic)
    drawn = facets.area(m) * spread * facets.seen(wi)
    reflectance, exact, _ = _reflectance(look, cos_i, inside)
    color, chance = reflectance, 1.0
    if inside is not None:
        # Radiance is scaled by 1/eta^2 on refraction.
        through, refracts = safe_sqrt(look.base_color) * (look.clear * (1 - exact)), _refracts(look, reflectance, exact)
        color = jnp.where(reflects, reflectance, through / (eta * eta))
        chance = jnp.where(reflects, 1 - refracts, refracts)
    f = color * (drawn * facets.seen(far) * far[2])
    chances = Chances.of(look, smaller(wi[2], 1), inside)
    of_facets = (1 - chances.base) * chance
    pdf = of_facets * drawn if chances.coat is None else of_facets * (1 - chances.coat) * drawn

    # The base, with sheen and clear coat.
    above = possible if inside is None else possible & reflects & ~inside
    base = look.opaque * burley.diffuse(look.roughness, look.flatness, wi[2], far[2], cos_i) * look.base_color
    if look.sheen is not None:
        fuzz = look.dielectric * look.sheen * burley.sheen(far[2], cos_i)
        base = base + fuzz * burley.towards(look.sheen_tint, look.base_color)
    cosine = chances.base * square_to_cosine_hemisphere_pdf(far)
    if look.clearcoat is not None:
        gloss = 0.0 if look.clearcoat_gloss is None else look.clearcoat_gloss
        base = base + look.clearcoat * burley.coat(gloss, wi, far, m)
        coat = burley.coat_area(gloss, m) * m[2] / (4 * cos_i)
        cosine = cosine + (1 - chances.base) * chances.coat * coat
    f, pdf = f + jnp.where(above, base, 0), pdf + jnp.where(above, cosine, 0)
    return jnp.where(possible, f, 0), lax.stop_gradient(jnp.where(possible, pdf, 0))


def _sample(look: Look, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
    """Sample one of the lobes. The first number chooses it; if there are only two, it is used again for wo."""
    inside, seen, side = _side(look, wi)
    u = u if inside is None else jnp.stack([u[2], u[0], u[1]])
    chances = Chances.of(look, jnp.clip(seen[2], 0, 1), inside)
    from_base, u = chosen(u, chances.base)
    diffuse = square_to_cosine_hemisphere(u[-2:])
    from_coat = jnp.bool_(False)
    if chances.coat is not None:
        from_coat, u = chosen(u, chances.coat)
    m = burley.facets(look.roughness, look.anisotropic).sample(seen, u[-2:])
    if chances.coat is not None:
        gloss = 0.0 if look.clearcoat_gloss is None else look.clearcoat_gloss
        m = jnp.where(from_coat, burley.coat_sample(gloss, u[-2:]), m)
    wo, refracted, passive = mirrored(seen, m), jnp.bool_(False), jnp.ones_like(seen[2])
    if inside is not None:
        cos_i, eta = jnp.clip(dot(seen, m), 0, 1), jnp.where(inside, 1 / look.eta, look.eta)
        reflectance, exact, cos_t = _reflectance(look, cos_i, inside)
        refracted = ~from_base & ~from_coat & (u[0] < _refracts(look, reflectance, exact))
        wo = jnp.where(refracted, (cos_i / eta - cos_t) * m - seen / eta, wo)
        passive = jnp.where(refracted, 1 / (eta * eta), 1)
    wo = lax.stop_gradient(jnp.where(from_base, diffuse, wo) * side)
    f, pdf = _evaluate(look, wi, wo)
    # If wo is on the wrong side of the surface for its lobe, the pdf from `_evaluate` is that of another lobe.
    pdf = jnp.where((wo[2] * side > 0) == ~refracted, pdf, 0)
    weight = jnp.where(pdf > 0, f * safe_divide(1.0, pdf), 0)
    return BSDFSample(wo, weight, pdf, jnp.bool_(False), lax.stop_gradient(passive))
