"""How much light passes a rough coat: of each coat a short series, made by quadrature on the host.

Of light that meets a rough interface at the cosine mu, T(mu) = E[(1 - F(m . wi)) G1(wo)] is refracted, the mean being
that over the normals m that wi sees (Walter et al. 2007). What comes from below as from a diffuse surface is reflected
by the share 2 integral R(mu) mu dmu, R(mu) = E[F(m . wi) G1(wo)] being that of the interface from inside.

T is a sum of Chebyshev polynomials, right to 0.001, and to 0.01 at grazing angles where alpha is below 0.05. Its terms
are made for one alpha and one relative IOR eta, and are linear in them with the right derivatives, for kernels.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pathjax.bsdfs.microfacet import MIN_ALPHA
from pathjax.compile import is_traced
from pathjax.core.math import larger, smaller

TERMS = 12
# Constant, factor of alpha and factor of eta: of the terms of T, and of the share that is reflected inside.
SHAPE = (3, TERMS + 1)
# Points of the quadrature, in slopes of facets and in their azimuth, by which T and R are right to some 1e-4.
POINTS = 48
# Relative step of differences: over less, the points at the edges of what is seen and what is reflected totally make
# noise of some percent.
STEP = 0.03
# Mitsuba's cosines, of which the mean of R(mu) mu stands for its integral: too low by 1/64 or so.
COSINES_INSIDE = np.maximum(np.arange(64) / 63, 1e-6)
# The roots of the polynomial behind the last: where T is computed.
_ANGLES = np.pi * (np.arange(TERMS) + 0.5) / TERMS
_TO_TERMS = np.cos(np.outer(np.arange(TERMS), _ANGLES)) * np.where(np.arange(TERMS) == 0, 1, 2)[:, None] / TERMS


def coats(
    distribution: str, alpha: Float[Array | np.ndarray, " R"], eta: Float[Array | np.ndarray, " R"]
) -> Float[Array | np.ndarray, "R values terms_and_share"]:
    """What `SHAPE` says of each row, detached; eta: IOR of the coat over that outside."""
    shape = jax.ShapeDtypeStruct((*alpha.shape, *SHAPE), alpha.dtype)

    def on_host(alpha, eta):
        rows = zip(np.ravel(alpha).astype(float), np.ravel(eta).astype(float), strict=True)
        made = [_coat(distribution, max(alpha, MIN_ALPHA), eta) for alpha, eta in rows]
        return np.reshape(made, (*np.shape(alpha), *SHAPE)).astype(shape.dtype)

    if is_traced(alpha) or is_traced(eta):
        return jax.pure_callback(on_host, shape, *lax.stop_gradient((alpha, eta)), vmap_method="broadcast_all")
    return on_host(alpha, eta)


def at(coat: Float[Array, "values terms_and_share"], alpha: Float[Array, ""], eta: Float[Array, ""]):
    """The terms of T, for `passes`, and the share that is reflected inside, of a coat made for this alpha and eta."""
    terms = coat[0] + coat[1] * alpha + coat[2] * eta
    return terms[:TERMS], terms[TERMS]


def passes(terms: Float[Array, " terms"], mu: Float[Array, ""]) -> Float[Array, ""]:
    """T(mu) for mu >= 0: Clenshaw's sum of the series, in a variable that grows fastest at grazing angles."""
    z = (3 * mu - 1) / (mu + 1)
    ahead = behind = jnp.zeros_like(z)
    for k in range(TERMS - 1, 0, -1):
        ahead, behind = 2 * z * ahead - behind + terms[k], ahead
    return smaller(larger(z * ahead - behind + terms[0], 0), 1)


# ---- quadrature -----------------------------------------------------------------------------------------------------


def _coat(distribution, alpha, eta):
    def of(alpha, eta):
        z = np.cos(_ANGLES)
        T = _mean(distribution, alpha, (1 + z) / (3 - z), eta, inside=False)
        R = _mean(distribution, alpha, COSINES_INSIDE, 1 / eta, inside=True)
        return np.append(_TO_TERMS @ T, 2 * np.mean(R * COSINES_INSIDE))

    up, down = 1 + STEP, 1 - STEP
    by_alpha = (of(alpha * up, eta) - of(alpha * down, eta)) / (2 * STEP * alpha)
    by_eta = (of(alpha, eta * up) - of(alpha, eta * down)) / (2 * STEP * eta)
    return np.stack([of(alpha, eta) - by_alpha * alpha - by_eta * eta, by_alpha, by_eta])


def _mean(distribution, alpha, mu, eta, inside):
    """T (N,) from outside, or R from inside, at cosines mu (N,): the mean over slopes of facets, of those that wi sees.

    A facet's normal is (-x, -y, 1) over its length; wi sees the area max(wi . (-x, -y, 1), 0) of it.
    """
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    # Steep facets are rare in GGX, yet seen from afar: in this variable what is seen of them stays smooth.
    rest = ((1 - nodes) / 2) ** 2
    r = np.sqrt(-np.log(rest) if distribution == "beckmann" else 1 / rest - 1)
    weights = weights * (1 - nodes) / 2
    azimuth = (np.arange(POINTS) + 0.5) * np.pi / POINTS
    x, y = alpha * r[:, None] * np.cos(azimuth), alpha * r[:, None] * np.sin(azimuth)
    z = 1 / np.sqrt(1 + x * x + y * y)
    mu = mu[:, None, None]
    area = np.maximum(mu + np.sqrt(1 - mu * mu) * x, 0)
    cos_i = np.clip(area * z, 1e-9, 1)  # of no area: any but 0
    F, cos_t = _fresnel(cos_i, eta)
    cos_o = 2 * cos_i * z - mu if inside else mu / eta - z * (cos_i / eta - cos_t)
    value = area * (F if inside else 1 - F) * _seen(distribution, alpha, np.clip(cos_o, 0, 1))
    return np.einsum("nij,i->n", value, weights) / np.einsum("nij,i->n", area, weights)


def _fresnel(cos_i, eta):
    """`fresnel.dielectric`."""
    cos2_t = 1 - (1 - cos_i * cos_i) / eta**2
    cos_t = np.sqrt(np.maximum(cos2_t, 0))
    s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return np.where(cos2_t > 0, (s * s + p * p) / 2, 1), cos_t


def _seen(distribution, alpha, cos):
    """G1 of `microfacet`."""
    slope = alpha * np.sqrt(1 - cos * cos)
    if distribution == "ggx":
        return 2 * cos / (cos + np.sqrt(cos * cos + slope * slope))
    a = np.minimum(cos / np.maximum(slope, 1e-9), 1.6)
    return np.where(a < 1.6, a * (3.535 + 2.181 * a) / (1 + a * (2.276 + 2.577 * a)), 1)
