"""How much light passes a rough coat: a short series per coat, computed by quadrature on the host.

At the cosine mu of incidence, a rough interface refracts the share T(mu) = E[(1 - F(m . wi)) G1(wo)] of light, a mean
over the visible normals m (Walter et al. 2007). It reflects the share 2 integral R(mu) mu dmu of diffuse light from
below, where R(mu) = E[F(m . wi) G1(wo)] is the reflectance from inside.

T is a sum of Chebyshev polynomials in a variable that varies fastest where T does: at grazing angles or, where eta is
below 1, around the cosine above which light is not reflected totally. Its error is 0.003; 0.01 where alpha is below
0.05 or eta below 1; and 0.02 where alpha is below 0.01, except at the very edge of total reflection. The terms are
computed for one alpha and one relative IOR eta, and are linear in both with the right derivatives, for kernels.
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
# Constants, factors of alpha and factors of eta, each for the share reflected inside and the terms of T; then the four
# numbers of `_place`.
SHAPE = (3 * (1 + TERMS) + 4,)
# Width in the cosine over which the variable is about linear. Without total reflection it is REACH + alpha, since T of
# rougher coats is smoother at grazing angles; else REACH_OF_EDGE alpha eta, around the edge of total reflection. That
# edge has no width for a smooth coat, and a square root follows it: LEAST_EDGE, the least alpha here, widens both.
REACH, REACH_OF_EDGE, LEAST_EDGE = 0.5, 2, 0.01
# Points of the quadrature in the slopes of facets, and in their azimuth; the errors of T and R are about 1e-4.
POINTS = 48
# Relative step of finite differences. With a smaller one, points of the quadrature at the edges of visibility and of
# total reflection cause noise of some percent.
STEP = 0.03
# Mitsuba's cosines: it takes the mean of R(mu) mu over them for the integral, which is too low by about 1/64.
COSINES_INSIDE = np.maximum(np.arange(64) / 63, 1e-6)
# Angles of the roots of the first polynomial left out, where T is computed.
_ANGLES = np.pi * (np.arange(TERMS) + 0.5) / TERMS
_TO_TERMS = np.cos(np.outer(np.arange(TERMS), _ANGLES)) * np.where(np.arange(TERMS) == 0, 1, 2)[:, None] / TERMS


def coats(
    distribution: str, alpha: Float[Array | np.ndarray, " R"], eta: Float[Array | np.ndarray, " R"]
) -> Float[Array | np.ndarray, "R numbers"]:
    """Return the numbers of `SHAPE` for each row, detached. eta: IOR of the coat over that outside."""
    shape = jax.ShapeDtypeStruct((*alpha.shape, *SHAPE), alpha.dtype)

    def on_host(alpha, eta):
        rows = zip(np.ravel(alpha).astype(float), np.ravel(eta).astype(float), strict=True)
        made = [_coat(distribution, max(alpha, MIN_ALPHA), eta) for alpha, eta in rows]
        return np.reshape(made, (*np.shape(alpha), *SHAPE)).astype(shape.dtype)

    if is_traced(alpha) or is_traced(eta):
        return jax.pure_callback(on_host, shape, *lax.stop_gradient((alpha, eta)), vmap_method="broadcast_all")
    return on_host(alpha, eta)


def at(coat: Float[Array, " numbers"], alpha: Float[Array, ""], eta: Float[Array, ""]):
    """Return T, for `passes`, and the share reflected inside, for a coat computed at this alpha and eta."""
    k = TERMS + 1
    share_and_terms = coat[:k] + coat[k : 2 * k] * alpha + coat[2 * k : 3 * k] * eta
    return (share_and_terms[1:], coat[3 * k :]), share_and_terms[0]


def passes(T: tuple[Float[Array, " terms"], Float[Array, "4"]], mu: Float[Array, ""]) -> Float[Array, ""]:
    """Return T(mu) for mu >= 0, by Clenshaw's summation of the series."""
    terms, (edge, squared, scale, shift) = T
    z = scale * ((mu - edge) * lax.rsqrt((mu - edge) * (mu - edge) + squared)) + shift
    ahead = behind = jnp.zeros_like(z)
    for k in range(TERMS - 1, 0, -1):
        ahead, behind = 2 * z * ahead - behind + terms[k], ahead
    return smaller(larger(z * ahead - behind + terms[0], 0), 1)


# ---- quadrature -----------------------------------------------------------------------------------------------------


def _coat(distribution, alpha, eta):
    place, cosines = _place(alpha, eta)

    def of(alpha, eta):
        T = _mean(distribution, alpha, cosines, eta, inside=False)
        R = _mean(distribution, alpha, COSINES_INSIDE, 1 / eta, inside=True)
        return np.append(2 * np.mean(R * COSINES_INSIDE), _TO_TERMS @ T)

    up, down = 1 + STEP, 1 - STEP
    by_alpha = (of(alpha * up, eta) - of(alpha * down, eta)) / (2 * STEP * alpha)
    by_eta = (of(alpha, eta * up) - of(alpha, eta * down)) / (2 * STEP * eta)
    return np.concatenate([of(alpha, eta) - by_alpha * alpha - by_eta * eta, by_alpha, by_eta, place])


def _place(alpha, eta):
    """Return the four numbers by which `passes` maps a cosine to the variable z in [-1, 1], in which T is a polynomial;
    and the cosines at the roots.
    """
    edge = np.sqrt(max(1 - eta * eta, 0))  # a smooth coat reflects smaller cosines totally
    width = REACH_OF_EDGE * max(alpha, LEAST_EDGE) * eta if eta < 1 else REACH + alpha
    low, high = (x / np.hypot(x, width) for x in (-edge, 1 - edge))
    scale = 2 / (high - low)
    shift = -1 - scale * low
    x = (np.cos(_ANGLES) - shift) / scale
    return [edge, width * width, scale, shift], np.clip(edge + width * x / np.sqrt(1 - x * x), 0, 1)


def _mean(distribution, alpha, mu, eta, inside):
    """Return T (N,) from outside, or R from inside, at cosines mu (N,): means over the slopes of visible facets.

    A facet's normal is (-x, -y, 1), normalised; wi sees the area max(wi . (-x, -y, 1), 0) of it.
    """
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    # Steep facets are rare in GGX, but widely visible; in this variable their visible area stays smooth.
    rest = ((1 - nodes) / 2) ** 2
    r = np.sqrt(-np.log(rest) if distribution == "beckmann" else 1 / rest - 1)
    weights = weights * (1 - nodes) / 2
    azimuth = (np.arange(POINTS) + 0.5) * np.pi / POINTS
    x, y = alpha * r[:, None] * np.cos(azimuth), alpha * r[:, None] * np.sin(azimuth)
    z = 1 / np.sqrt(1 + x * x + y * y)
    mu = mu[:, None, None]
    area = np.maximum(mu + np.sqrt(1 - mu * mu) * x, 0)
    cos_i = np.clip(area * z, 1e-9, 1)  # where the area is 0: any value but 0
    F, cos_t = _fresnel(cos_i, eta)
    cos_o = 2 * cos_i * z - mu if inside else mu / eta - z * (cos_i / eta - cos_t)
    value = area * (F if inside else 1 - F) * _seen(distribution, alpha, np.clip(cos_o, 0, 1))
    return np.einsum("nij,i->n", value, weights) / np.einsum("nij,i->n", area, weights)


def _fresnel(cos_i, eta):
    """`fresnel.dielectric` in NumPy."""
    cos2_t = 1 - (1 - cos_i * cos_i) / eta**2
    cos_t = np.sqrt(np.maximum(cos2_t, 0))
    s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return np.where(cos2_t > 0, (s * s + p * p) / 2, 1), cos_t


def _seen(distribution, alpha, cos):
    """G1 of `microfacet` in NumPy."""
    slope = alpha * np.sqrt(1 - cos * cos)
    if distribution == "ggx":
        return 2 * cos / (cos + np.sqrt(cos * cos + slope * slope))
    a = np.minimum(cos / np.maximum(slope, 1e-9), 1.6)
    return np.where(a < 1.6, a * (3.535 + 2.181 * a) / (1 + a * (2.276 + 2.577 * a)), 1)
