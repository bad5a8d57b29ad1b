"""Fresnel reflectance of unpolarised light. Cosines are of the incident direction; `eta` is transmitted over incident IOR."""

from __future__ import annotations

import jax.numpy as jnp

from pathjax.core.math import safe_sqrt


def dielectric(cos_i, eta):
    """Exact reflectance and the cosine of refraction.

    Args:
        cos_i: () in [0, 1].
        eta: () > 0, IOR of the far side over that of the near side.
    Returns:
        R (), in [0, 1]; cos_t () >= 0, 0 under total internal reflection, where R = 1.
    Derivatives are finite everywhere: at and beyond the critical angle they are those of the constant 1.
    """
    sin2_t = (1 - cos_i) * (1 + cos_i) / (eta * eta)
    cos2_t = 1 - sin2_t
    cos_t = safe_sqrt(cos2_t)
    # Both numerators vanish at grazing incidence on equal media; the denominators only at cos_i = cos_t = 0.
    s_sum, p_sum = cos_i + eta * cos_t, eta * cos_i + cos_t
    inside = (cos2_t > 0) & (s_sum > 0) & (p_sum > 0)
    r_s = (cos_i - eta * cos_t) / jnp.where(inside, s_sum, 1)
    r_p = (eta * cos_i - cos_t) / jnp.where(inside, p_sum, 1)
    return jnp.where(inside, (r_s * r_s + r_p * r_p) / 2, 1), cos_t


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
    return (r_s + r_p) / 2


def _ratio(a, b):
    positive = b > 0
    return jnp.where(positive, a / jnp.where(positive, b, 1), 1)
