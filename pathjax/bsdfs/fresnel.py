"""Fresnel reflectance of unpolarised light. Cosines are incident; `eta` is the IOR of the far over the near side."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.math import larger, safe_sqrt, smaller


def dielectric(cos_i: Float[Array, ""], eta: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the exact reflectance and the cosine of refraction.

    Args:
        cos_i: in [0, 1].
        eta: > 0, IOR of the far side over that of the near side.
    Returns:
        R, in [0, 1]; cos_t >= 0, 0 under total internal reflection, where R = 1.
    Gradient: finite; at and beyond the critical angle that of the constant 1.
    """
    eta = within(eta)
    refracts, cos_t = _refraction(cos_i, eta)
    share = 1 / jnp.where(refracts, cos_i + eta * cos_t, 1)
    r_s = ((eta - 1) * share) * ((eta + 1) * share)
    # Times cos(i + t) / cos(i - t), in a form in which nothing overflows; the usual one, of squares, does.
    sin2, across = (1 - cos_i) * (1 + cos_i), eta * cos_i * cos_t
    r_p = r_s * ((across - sin2) / jnp.where(refracts, across + sin2, 1))
    return jnp.where(refracts, smaller((r_s * r_s + r_p * r_p) / 2, jnp.ones_like(cos_t)), 1), cos_t


def schlick(cos_i: Float[Array, ""], eta: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return Schlick's approximation of `dielectric` (1994, Computer Graphics Forum 13(3)).

    Normal incidence, total internal reflection and the cosine of refraction are exact. The angle is that on the
    optically thinner side, so that light in the reverse direction sees the same reflectance. The error is largest at
    grazing angles: 0.036 at 85 degrees and IOR 1.5; even equal media reflect (1 - cos)^5.
    """
    eta = within(eta)
    refracts, cos_t = _refraction(cos_i, eta)
    r0 = ((eta - 1) / (eta + 1)) ** 2
    missing = 1 - jnp.where(eta < 1, cos_t, cos_i)
    return jnp.where(refracts, r0 + (1 - r0) * missing**5, 1), cos_t


def relative(int_ior: Float[Array, ""], ext_ior: Float[Array, ""]) -> Float[Array, ""]:
    """Return the IOR inside over that outside, `within` bounds."""
    return within(int_ior / ext_ior)


def within(eta: Float[Array, ""]) -> Float[Array, ""]:
    """Clamp a ratio of IORs to [eps, 1 / eps], so that its powers do not overflow; beyond, hardly any light passes."""
    rounding = float(jnp.finfo(eta.dtype).eps)
    return larger(smaller(eta, 1 / rounding), rounding)


def _refraction(cos_i, eta):
    """Return whether light refracts, and the cosine of refraction, else 0."""
    # With eta - 1 as a factor, nothing cancels: equal media reflect 0 at any angle, with derivative 0.
    cos2_t = (cos_i * cos_i + (eta - 1) * (eta + 1)) / (eta * eta)
    refracts = cos2_t >= jnp.finfo(cos2_t.dtype).tiny  # so that its square root may be squared
    return refracts, safe_sqrt(jnp.where(refracts, cos2_t, 0))


def diffuse(eta: Float[Array, ""]) -> Float[Array, ""]:
    """Return the share of isotropic light that passes an interface.

    It follows fits of d'Eon and Irving (2011) for eta > 1, and of Egan and Hilgeman (1973) below 1, where some light is
    reflected totally. The errors are below 0.002. The second fit fails below 1/2. There the share follows from the
    first one: the share of isotropic light that passes one way is eta^2 times the share that passes the other way.
    """
    thin, x = eta < 1, jnp.where(eta < 1, eta, 1 / eta)
    enters = 0.080683 + x * (3.4793 + x * (-6.75335 + x * (7.80989 + x * (-4.98554 + x * 1.36881))))
    leaves = jnp.where(x > 0.5, 0.3319 - 0.0636 / x + x * (x * 1.4399 - 0.7099), enters * x * x)
    return jnp.where(thin, leaves, enters)


@jax.custom_jvp
def conductor(cos_i: Float[Array, ""], eta: Float[Array, "3"], k: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the reflectance of a metal of complex IOR eta + i k, per channel (Born and Wolf; PBRT 4 ed., 9.3.6).

    With a + i b = sqrt((eta + i k)^2 - sin^2), the share that is not reflected is 4 a cos / |a + i b + cos|^2 in one
    polarisation, and (a^2 + b^2 + sin^2) / |(a + i b) cos + sin^2|^2 times that in the other. These are sums of
    positive terms, accurate where nearly all light is reflected.

    cos_i lies in [0, 1], eta and k in [0, 1e6]; the result lies in [0, 1].
    Gradient: right to rounding, also at eta = 0 and k = 0, except at the critical angle of a medium that does not
    absorb, where it is infinite and 0 is returned.
    """
    cos2, sin2 = cos_i * cos_i, (1 - cos_i) * (1 + cos_i)
    right, y, modulus, large = _half_root(cos_i, eta, k)
    # All terms are multiplied by `scale`, so that there is only one division.
    scale, a = jnp.where(right, 1, 2 * large), jnp.where(right, large, y)
    a_cos = 2 * a * cos_i
    d_s = scale * (modulus + cos2) + a_cos
    d_p = scale * (modulus * cos2 + sin2 * sin2) + a_cos * sin2
    passes, whole = a_cos * (d_p + scale * (modulus + sin2)), d_s * d_p
    # At angles so grazing that the product underflows, all light is reflected.
    usable = whole >= jnp.finfo(whole.dtype).tiny
    return 1 - jnp.where(usable, passes / jnp.where(usable, whole, 1), 0)


@conductor.defjvp
def _conductor_jvp(primals, tangents):
    # Differentiates another form. The derivative of the one above divides by the square of `whole`, which leaves the
    # range of float32; and where little is reflected, differences of nearly equal numbers lose their derivatives.
    return conductor(*primals), jax.jvp(_conductor_to_differentiate, primals, tangents)[1]


def _conductor_to_differentiate(cos_i, eta, k):
    """Compute `conductor` in a form to differentiate: where little is reflected, by squares of differences."""
    cos2, sin2 = cos_i * cos_i, (1 - cos_i) * (1 + cos_i)
    right, y, _, large = _half_root(cos_i, eta, k)
    small = _ratio(y, 2 * large)
    a, b = jnp.where(right, large, small), jnp.where(right, small, large)
    b2 = b * b
    s, p = a + cos_i, a * cos_i + sin2
    d_s, d_p = s * s + b2, p * p + b2 * cos2
    passes = 4 * a * cos_i
    little = 2 * passes > d_s
    # a - cos from a^2 - cos^2, which is exact where they are nearly equal.
    s, p = ((eta - 1) * (eta + 1) - k * k + b2) / jnp.where(little, s, 1), a * cos_i - sin2
    of_s = _ratio(jnp.where(little, s * s + b2, passes), d_s)
    of_p = _ratio(jnp.where(little, p * p + b2 * cos2, a * a + b2 + sin2), d_p)
    share = of_s * (1 + of_p) / 2
    return jnp.where(little, share, 1 - share)


def _half_root(cos_i, eta, k):
    """Return, for a + i b = sqrt(x + i y): whether x >= 0, y, |x + i y|, and the larger of a (if x >= 0) and b."""
    # Two forms, so that nothing cancels for (eta + i k)^2 near 0 or near 1.
    near_0, near_1 = (eta - k) * (eta + k) - (1 - cos_i) * (1 + cos_i), (eta - 1) * (eta + 1) - k * k + cos_i * cos_i
    x, y = jnp.where(eta < 0.5, near_0, near_1), 2 * eta * k
    size = jnp.where(x >= 0, x, -x)
    squared = x * x + y * y
    modulus = jnp.where(squared < jnp.finfo(squared.dtype).tiny, size, safe_sqrt(squared))
    return x >= 0, y, modulus, safe_sqrt((modulus + size) / 2)


def _ratio(a, b):
    """Return a / b; 0, with derivative 0, where the square of b, by which derivatives divide, is 0."""
    usable = b * b > 0
    return jnp.where(usable, a / jnp.where(usable, b, 1), 0)
