"""Fresnel reflectance of unpolarised light. Cosines are incident; `eta` is the transmitted over the incident IOR."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.math import larger, safe_sqrt, smaller


def dielectric(cos_i: Float[Array, ""], eta: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Exact reflectance and the cosine of refraction.

    Args:
        cos_i: in [0, 1].
        eta: > 0, IOR of the far side over that of the near side.
    Returns:
        R, in [0, 1]; cos_t >= 0, 0 under total internal reflection, where R = 1.
    Derivatives are finite: at and beyond the critical angle they are those of the constant 1.
    """
    eta = within(eta)
    refracts, cos_t = _refraction(cos_i, eta)
    share = 1 / jnp.where(refracts, cos_i + eta * cos_t, 1)
    r_s = ((eta - 1) * share) * ((eta + 1) * share)
    # Times cos(i + t) / cos(i - t): by products of these no square overflows, as by their squares.
    sin2, across = (1 - cos_i) * (1 + cos_i), eta * cos_i * cos_t
    r_p = r_s * ((across - sin2) / jnp.where(refracts, across + sin2, 1))
    return jnp.where(refracts, smaller((r_s * r_s + r_p * r_p) / 2, jnp.ones_like(cos_t)), 1), cos_t


def schlick(cos_i: Float[Array, ""], eta: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Schlick's approximation of `dielectric` (1994, Computer Graphics Forum 13(3)); exact are normal incidence, total
    internal reflection and the cosine of refraction.

    The angle is that on the thinner side, so that light going back sees the same reflectance. Wrong most at grazing
    angles: by 0.036 at 85 degrees and IOR 1.5; even equal media reflect, (1 - cos)^5.
    """
    eta = within(eta)
    refracts, cos_t = _refraction(cos_i, eta)
    r0 = ((eta - 1) / (eta + 1)) ** 2
    missing = 1 - jnp.where(eta < 1, cos_t, cos_i)
    return jnp.where(refracts, r0 + (1 - r0) * missing**5, 1), cos_t


def relative(int_ior: Float[Array, ""], ext_ior: Float[Array, ""]) -> Float[Array, ""]:
    """IOR inside over that outside, `within` bounds."""
    return within(int_ior / ext_ior)


def within(eta: Float[Array, ""]) -> Float[Array, ""]:
    """A ratio of IORs as one whose powers are floats: beyond the reciprocal of a rounding hardly any light passes."""
    rounding = float(jnp.finfo(eta.dtype).eps)
    return larger(smaller(eta, 1 / rounding), rounding)


def _refraction(cos_i, eta):
    """Whether light refracts, and the cosine if so."""
    # With the contrast taken out, nothing cancels: equal media reflect 0 at any angle, with derivative 0.
    cos2_t = (cos_i * cos_i + (eta - 1) * (eta + 1)) / (eta * eta)
    refracts = cos2_t >= jnp.finfo(cos2_t.dtype).tiny  # so that its square root may be squared
    return refracts, safe_sqrt(jnp.where(refracts, cos2_t, 0))


def diffuse(eta: Float[Array, ""]) -> Float[Array, ""]:
    """Share of isotropic light that passes an interface, by fits of d'Eon and Irving (2011) for eta > 1, and of Egan
    and Hilgeman (1973) below, where some is reflected totally. Both are wrong by less than 0.002.

    The second one strays below 1/2. There it follows from the first: of isotropic light, what passes one way is
    eta^2 times what passes the other way.
    """
    thin, x = eta < 1, jnp.where(eta < 1, eta, 1 / eta)
    enters = 0.080683 + x * (3.4793 + x * (-6.75335 + x * (7.80989 + x * (-4.98554 + x * 1.36881))))
    leaves = jnp.where(x > 0.5, 0.3319 - 0.0636 / x + x * (x * 1.4399 - 0.7099), enters * x * x)
    return jnp.where(thin, leaves, enters)


@jax.custom_jvp
def conductor(cos_i: Float[Array, ""], eta: Float[Array, "3"], k: Float[Array, "3"]) -> Float[Array, "3"]:
    """Reflectance of a metal of complex IOR eta + i k, per channel (Born and Wolf; PBRT 4 ed., 9.3.6).

    With a + i b = sqrt((eta + i k)^2 - sin^2), of one polarisation 4 a cos / |a + i b + cos|^2 is not reflected, and of
    the other (a^2 + b^2 + sin^2) / |(a + i b) cos + sin^2|^2 times that: sums of positive terms, so that it keeps its
    digits where nearly all is reflected.

    For cos_i in [0, 1] and eta, k in [0, 1e6]; the result lies in [0, 1].
    Derivatives are right to rounding, at eta = 0 and k = 0 too, but for points where they are infinite and 0 stands:
    the critical angle of a medium that does not absorb.
    """
    cos2, sin2 = cos_i * cos_i, (1 - cos_i) * (1 + cos_i)
    right, y, modulus, large = _half_root(cos_i, eta, k)
    # All are multiplied by `scale`, which leaves one division.
    scale, a = jnp.where(right, 1, 2 * large), jnp.where(right, large, y)
    a_cos = 2 * a * cos_i
    d_s = scale * (modulus + cos2) + a_cos
    d_p = scale * (modulus * cos2 + sin2 * sin2) + a_cos * sin2
    passes, whole = a_cos * (d_p + scale * (modulus + sin2)), d_s * d_p
    # All is reflected where the angle is so grazing that a product leaves the range of the floats.
    usable = whole >= jnp.finfo(whole.dtype).tiny
    return 1 - jnp.where(usable, passes / jnp.where(usable, whole, 1), 0)


@conductor.defjvp
def _conductor_jvp(primals, tangents):
    # Other roundings: the square of that product, by which its derivative divides, leaves the range of float32, and
    # where little is reflected the differences of nearly equal numbers have no digits of their derivatives.
    return conductor(*primals), jax.jvp(_conductor_to_differentiate, primals, tangents)[1]


def _conductor_to_differentiate(cos_i, eta, k):
    """`conductor` where little is reflected, by squares of differences."""
    cos2, sin2 = cos_i * cos_i, (1 - cos_i) * (1 + cos_i)
    right, y, _, large = _half_root(cos_i, eta, k)
    small = _ratio(y, 2 * large)
    a, b = jnp.where(right, large, small), jnp.where(right, small, large)
    b2 = b * b
    s, p = a + cos_i, a * cos_i + sin2
    d_s, d_p = s * s + b2, p * p + b2 * cos2
    passes = 4 * a * cos_i
    little = 2 * passes > d_s
    # cos - a of cos^2 - a^2, which is exact where they are nearly equal.
    s, p = ((eta - 1) * (eta + 1) - k * k + b2) / jnp.where(little, s, 1), a * cos_i - sin2
    of_s = _ratio(jnp.where(little, s * s + b2, passes), d_s)
    of_p = _ratio(jnp.where(little, p * p + b2 * cos2, a * a + b2 + sin2), d_p)
    share = of_s * (1 + of_p) / 2
    return jnp.where(little, share, 1 - share)


def _half_root(cos_i, eta, k):
    """Parts of sqrt(x + i y), a + i b above: whether x >= 0, y, |x + i y|, and the larger of a, if so, and b."""
    # Nothing cancels, be (eta + i k)^2 near 0 or near 1.
    near_0, near_1 = (eta - k) * (eta + k) - (1 - cos_i) * (1 + cos_i), (eta - 1) * (eta + 1) - k * k + cos_i * cos_i
    x, y = jnp.where(eta < 0.5, near_0, near_1), 2 * eta * k
    size = jnp.where(x >= 0, x, -x)
    squared = x * x + y * y
    modulus = jnp.where(squared < jnp.finfo(squared.dtype).tiny, size, safe_sqrt(squared))
    return x >= 0, y, modulus, safe_sqrt((modulus + size) / 2)


def _ratio(a, b):
    """a / b, and 0 with derivative 0 where the square of b, by which derivatives divide, is 0."""
    usable = b * b > 0
    return jnp.where(usable, a / jnp.where(usable, b, 1), 0)
