"""The lobes of Burley's principled bsdfs, as in Mitsuba.

Burley 2012, "Physically based shading at Disney"; Burley 2015, "Extending the Disney BRDF to a BSDF with integrated
subsurface scattering" (both SIGGRAPH courses). Values are f |cos theta_o|; `cos_d` is the cosine between
a direction and the half vector.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs.microfacet import GGX
from pathjax.core.math import cos_sin_turns, dot, larger, luminance, normalize, safe_divide, safe_sqrt

Number = Float[Array, ""]
Color = Float[Array, "3"]

# Mitsuba's least alpha of the main lobe.
MIN_ALPHA = 1e-3
# The clear coat: reflectance at normal incidence, alpha of its masking, alphas of its facets at gloss 0 and 1.
COAT_R0, COAT_MASKED, COAT_ALPHA = 0.04, 0.25, (0.1, 0.001)


def facets(roughness: Number, anisotropic: Number | None) -> GGX:
    """Return the facets of the main lobe: alpha = roughness^2, by `anisotropic` larger along x (2012, 5.4)."""
    alpha = roughness * roughness
    aspect = 1.0 if anisotropic is None else safe_sqrt(1 - 0.9 * anisotropic)
    return GGX(larger(alpha / aspect, MIN_ALPHA), larger(alpha * aspect, MIN_ALPHA))


def schlick_weight(cos: Number) -> Number:
    """Return (1 - cos)^5 (Schlick 1994)."""
    missing = jnp.clip(1 - cos, 0, 1)
    squared = missing * missing
    return squared * squared * missing


def schlick(r0: Color | Number | float, cos: Number) -> Color | Number:
    """Return a reflectance that is r0 at normal incidence and 1 at grazing angles."""
    return r0 + (1 - r0) * schlick_weight(cos)


def tint(color: Color) -> Color:
    """Return the colour scaled to luminance 1; white for black."""
    light = luminance(color)
    return jnp.where(light > 0, color / jnp.where(light > 0, light, 1), 1)


def towards(share: Number | None, color: Color) -> Color | float:
    """Interpolate from white to the tint of a colour by `share`; None: white."""
    return 1.0 if share is None else 1 + share * (tint(color) - 1)


def diffuse(roughness: Number, flatness: Number | None, cos_i: Number, cos_o: Number, cos_d: Number) -> Number:
    """Return the lobe of a white base, which at grazing angles is darker or, by roughness, brighter (2012, 5.3).

    `flatness` blends it with subsurface scattering (2015, after Hanrahan and Krueger 1993)."""
    at_i, at_o = schlick_weight(cos_i), schlick_weight(cos_o)
    back = 2 * roughness * cos_d * cos_d
    value = (1 - at_i / 2) * (1 - at_o / 2) + back * (at_i + at_o + at_i * at_o * (back - 1))
    if flatness is not None:
        grazing = back / 2 - 1
        through = (1 + grazing * at_i) * (1 + grazing * at_o)
        flat = 1.25 * (through * (safe_divide(1.0, cos_i + cos_o) - 0.5) + 0.5)
        value = value + flatness * (flat - value)
    return value * cos_o / math.pi


def sheen(cos_o: Number, cos_d: Number) -> Number:
    """Return the white lobe at grazing angles (2012, 5.5)."""
    return schlick_weight(cos_d) * cos_o


# ---- clear coat (2012, 5.6): facets of Berry's distribution, "GTR1", whose tails are long ---------------------------


def coat(gloss: Number | float, wi: Float[Array, "3"], wo: Float[Array, "3"], m: Float[Array, "3"]) -> Number:
    """Return the lobe of a full clear coat."""
    masked = GGX(*[jnp.asarray(COAT_MASKED, wi.dtype)] * 2)
    seen = masked.seen(wi) * wi[2] * masked.seen(wo) * wo[2]
    return schlick(COAT_R0, dot(wi, m)) * coat_area(gloss, m) * seen * wo[2] / 4


def coat_area(gloss: Number | float, m: Float[Array, "3"]) -> Number:
    """Return D(m) [1/sr]."""
    a2 = _squared(gloss)
    return (a2 - 1) / (math.pi * jnp.log(a2) * (m[0] * m[0] + m[1] * m[1] + a2 * m[2] * m[2]))


def coat_sample(gloss: Number | float, u: Float[Array, "2"]) -> Float[Array, "3"]:
    """Sample a normal with the density D(m) m.z."""
    a2 = _squared(gloss)
    # 1 - a2^(1 - u) without cancellation.
    cos2 = -jnp.expm1((1 - u[1]) * jnp.log(a2)) / (1 - a2)
    cos, sin = cos_sin_turns(u[0])
    r = safe_sqrt(1 - cos2)
    return normalize(jnp.stack([r * cos, r * sin, safe_sqrt(cos2)]))


def _squared(gloss):
    rough, glossy = COAT_ALPHA
    alpha = rough + (glossy - rough) * gloss
    return alpha * alpha
