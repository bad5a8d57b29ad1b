"""Fresnel reflectance of unpolarised light. Cosines are incident; `eta` is the transmitted over the incident IOR."""

from __future__ import annotations

import jax.numpy as jnp

from pathjax.core.math import larger, safe_sqrt, smaller


def dielectric(cos_i, eta):
    """Exact reflectance and the cosine of refraction.

    Args:
        cos_i: () in [0, 1].
        eta: () > 0, IOR of the far side over that of the near side.
    Returns:
        R (), in [0, 1]; cos_t () >= 0, 0 under total internal reflection, where R = 1.
    Derivatives are finite everywhere: at and beyond the critical angle they are those of the constant 1.
    """
    contrast, refracts, cos_t = _refraction(cos_i, eta)
    s, p = cos_i + eta * cos_t, eta * cos_i + cos_t
    r_s = contrast / jnp.where(refracts, s * s, 1)
    r_p = contrast * ((eta * eta + 1) * cos_i * cos_i - 1) / jnp.where(refracts, eta * eta * p * p, 1)
    return jnp.where(refracts, smaller((r_s * r_s + r_p * r_p) / 2, jnp.ones_like(cos_t)), 1), cos_t


def schlick(cos_i, eta):
    """Schlick's approximation of `dielectric` (1994, Computer Graphics Forum 13(3)); exact are normal incidence, total
    internal reflection and the cosine of refraction.

    The angle is that on the thinner side, so that light going back sees the same reflectance. Wrong most at grazing
    angles: by 0.036 at 85 degrees and IOR 1.5; even equal media reflect, (1 - cos)^5.
    """
    _, refracts, cos_t = _refraction(cos_i, eta)
    r0 = ((eta - 1) / (eta + 1)) ** 2
    missing = 1 - jnp.where(eta < 1, cos_t, cos_i)
    return jnp.where(refracts, r0 + (1 - r0) * missing**5, 1), cos_t


def _refraction(cos_i, eta):
    """eta^2 - 1, whether light refracts, and the cosine if so."""
    # With the contrast taken out, nothing cancels: equal media reflect 0 at any angle, with derivative 0.
    contrast = (eta - 1) * (eta + 1)
    cos2_t = (cos_i * cos_i + contrast) / (eta * eta)
    refracts = cos2_t > 0
    return contrast, refracts, safe_sqrt(cos2_t)


def conductor(cos_i, eta, k):
    """Reflectance of a metal of complex IOR eta + i k, per channel (Born and Wolf; PBRT 4 ed., 9.3.6).

    Args:
        cos_i: () in [0, 1]; eta, k: (3,).
    Returns:
        (3,).
    """
    cos2, sin2 = cos_i * cos_i, (1 - cos_i) * (1 + cos_i)
    t0 = eta * eta - k * k - sin2
    a2_b2 = safe_sqrt(t0 * t0 + 4 * eta * eta * k * k)
    a = safe_sqrt((a2_b2 + t0) / 2)
    t1, t2 = a2_b2 + cos2, 2 * cos_i * a
    r_s = _ratio(t1 - t2, t1 + t2)
    t3, t4 = cos2 * a2_b2 + sin2 * sin2, t2 * sin2
    r_p = r_s * _ratio(t3 - t4, t3 + t4)
    return larger((r_s + r_p) / 2, jnp.zeros_like(r_s))


def _ratio(a, b):
    positive = b > 0
    return jnp.where(positive, a / jnp.where(positive, b, 1), 1)
