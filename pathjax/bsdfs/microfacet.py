"""Microfacet distributions of rough surfaces: density, visibility and sampling of the normals of facets.

A distribution gives the area of facets by their normal m, D(m), and the share of them visible from a direction v,
G1(v). Its two roughnesses are along x and y of the local frame. Directions are unit; `v`, `wi` and all normals lie on
the side of +z. Masking and shadowing are independent, G = G1(wi) G1(wo), as in Mitsuba. (Walter et al. 2007,
"Microfacet models for refraction through rough surfaces", EGSR; Heitz 2014, JCGT 3(2).)

Densities are those of visible normals, D(m) G1(wi) (m . wi) / wi.z, and of reflections at them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pathjax.compile import compute_once
from pathjax.core.math import cos_sin_turns, dot, larger, normalize, safe_sqrt, smaller

# Mitsuba's least alpha; smaller values count as this one.
MIN_ALPHA = 1e-4


@dataclass(frozen=True)
class Distribution(ABC):
    """Normals of a rough surface. Built from the parameters at a point, never stored."""

    alpha_u: Float[Array, ""]  # along x; sqrt(2) times the root mean square slope of the facets, where finite
    alpha_v: Float[Array, ""]  # along y

    @classmethod
    def of(cls, alpha_u: Float[Array, ""], alpha_v: Float[Array, ""]) -> Distribution:
        """Return a distribution whose roughnesses are at least MIN_ALPHA."""
        return cls(larger(alpha_u, MIN_ALPHA), larger(alpha_v, MIN_ALPHA))

    def detached(self) -> Distribution:
        """Return the distribution without derivatives, for sampling."""
        return type(self)(lax.stop_gradient(self.alpha_u), lax.stop_gradient(self.alpha_v))

    @abstractmethod
    def area(self, m: Float[Array, "3"]) -> Float[Array, ""]:
        """Return D(m) [1/sr]; the integral of D(m) m.z is 1. It is 0 below the horizon."""

    @abstractmethod
    def seen(self, v: Float[Array, "3"]) -> Float[Array, ""]:
        """Return G1(v) / v.z for v.z >= 0, which is finite at grazing angles too; at v.z = 0 it is the limit."""

    @abstractmethod
    def sample(self, wi: Float[Array, "3"], u: Float[Array, "2"]) -> Float[Array, "3"]:
        """Sample a visible normal, m . wi > 0 up to rounding, with the density `pdf`. u: in [0, 1)."""

    def pdf(self, wi: Float[Array, "3"], m: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the density [1/sr] of normals in `sample`."""
        return self.area(m) * self.drawn(wi) * larger(dot(wi, m), 0)

    def drawn(self, wi: Float[Array, "3"]) -> Float[Array, ""]:
        """Return 1 / integral of D(m) max(m . wi, 0): the value of `seen` that matches `sample` exactly."""
        return self.seen(wi)

    # ---- reflection ---------------------------------------------------------------------------------------------

    def reflected(self, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, "3"]]:
        """Return f |cos theta_o| of perfectly reflecting facets, and the normal of those that reflect wi to wo.

        f is 0 where either direction lies below the horizon.
        """
        m = normalize(wi + wo)
        above = (wi[2] > 0) & (wo[2] > 0)
        value = self.area(m) * self.seen(wi) * (self.seen(above_horizon(wo)) * wo[2]) / 4
        return jnp.where(above, value, 0), m

    def reflected_pdf(self, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the density [1/sr] of wi mirrored at normals of `sample`; 0 if wi or wo is below the horizon."""
        m = normalize(wi + wo)
        return jnp.where((wi[2] > 0) & (wo[2] > 0), self.area(m) * self.drawn(wi) / 4, 0)

    # ---- stretching to roughness 1 ------------------------------------------------------------------------------

    def _slope(self, v: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the value whose ratio to v.z decides G1(v): alpha sin(theta) where alpha_u = alpha_v."""
        x, y = self.alpha_u * v[0], self.alpha_v * v[1]
        return safe_sqrt(x * x + y * y)

    def _stretched(self, wi: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return wi relative to a stretched surface of roughness 1."""
        return normalize(jnp.stack([self.alpha_u * wi[0], self.alpha_v * wi[1], wi[2]]))

    def _unstretched(self, x: Float[Array, ""], y: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the normal of this surface, given one of any length of a surface of roughness 1."""
        return normalize(jnp.stack([self.alpha_u * x, self.alpha_v * y, larger(z, 0)]))


class GGX(Distribution):
    """Facets with the normals of an ellipsoid (Trowbridge and Reitz 1975; Walter et al. 2007)."""

    def area(self, m):
        x, y, z = m[0] / self.alpha_u, m[1] / self.alpha_v, m[2]
        squared = jnp.where(z > 0, x * x + y * y + z * z, 1)
        return jnp.where(z > 0, 1 / (math.pi * self.alpha_u * self.alpha_v * (squared * squared)), 0)

    def seen(self, v):
        x, y, z = self.alpha_u * v[0], self.alpha_v * v[1], v[2]
        return 2 / (z + safe_sqrt(x * x + y * y + z * z))

    def sample(self, wi, u):
        """Sample halfway to a point of the spherical cap that reflections cover (Dupuy and Benyoub 2023, CGF 42(8))."""
        w = self._stretched(wi)
        # The point's z is (1 - u1) (1 + w.z) - w.z; in this form neither 1 - z^2 nor z + w.z cancels.
        height = 1 + w[2]
        r = safe_sqrt(u[1] * height * (2 - u[1] * height))
        cos, sin = cos_sin_turns(u[0])
        return self._unstretched(r * cos + w[0], r * sin + w[1], (1 - u[1]) * height)


class Beckmann(Distribution):
    """Facets whose slopes are normally distributed (Beckmann and Spizzichino 1963)."""

    def area(self, m):
        # Normals so near the horizon that z^4 underflows have density 0.
        z = larger(m[2], float(jnp.finfo(m.dtype).tiny) ** 0.25)
        x, y, z2 = m[0] / self.alpha_u, m[1] / self.alpha_v, z * z
        value = jnp.exp(-(x * x + y * y) / z2) / (z2 * z2) / (math.pi * self.alpha_u * self.alpha_v)
        return jnp.where(m[2] > 0, value, 0)

    def seen(self, v):
        """Use the rational approximation of Walter et al., as Mitsuba does; it is within 0.35 % of `drawn`."""
        slope, z = self._slope(v), v[2]
        steep = z >= 1.6 * slope
        a = jnp.where(steep, 0, z / jnp.where(slope > 0, slope, 1))
        low = (3.535 + 2.181 * a) / (jnp.where(steep, 1, slope) * (1 + a * (2.276 + 2.577 * a)))
        return jnp.where(steep, 1 / jnp.where(steep, z, 1), low)

    def drawn(self, wi):
        """Exact: Heitz 2014, equation 78, whose terms are all positive."""
        slope, z = self._slope(wi), wi[2]
        steep = z >= 9 * slope  # erfc(9) is below the rounding of float64
        a = jnp.where(steep, 0, z / jnp.where(slope > 0, slope, 1))
        near = z * (1 + lax.erf(a)) / 2 + slope * jnp.exp(-a * a) / (2 * math.sqrt(math.pi))
        return 1 / jnp.where(steep, z, near)

    def sample(self, wi, u):
        """Sample the slopes along and across wi (Heitz and d'Eon 2014, CGF 33(4)).

        The slope s along wi has the density exp(-s^2) max(cos - s sin, 0). In terms of y = erf(s), as in Jakob 2014
        ("An improved visible normal sampling routine for the Beckmann distribution"), two steps of Newton's method
        invert its integral within 2e-5. They start between the exact inverse for normal incidence and nearly that for
        grazing incidence.
        """
        w = self._stretched(wi)
        cos, sin = smaller(w[2], 1), safe_sqrt(w[0] * w[0] + w[1] * w[1])
        tip = float(1 - jnp.finfo(cos.dtype).eps / 2)
        cot = jnp.where(sin > 0, cos / jnp.where(sin > 0, sin, 1), 9)
        most = smaller(lax.erf(cot), tip)

        def integral(y, slope):
            return cos * (1 + y) + sin * jnp.exp(-slope * slope) / math.sqrt(math.pi)

        target = u[0] * integral(most, cot)
        mixed = cos * cos * cos
        y = (1 + most) * (mixed * u[0] + (1 - mixed) * (1 - safe_sqrt(1 - u[0]))) - 1
        for _ in range(2):
            y = jnp.clip(y, -tip, most)
            slope = lax.erf_inv(y)
            growth = larger(cos - slope * sin, float(jnp.finfo(cos.dtype).tiny))
            y = compute_once(y - (integral(y, slope) - target) / growth)
        along = lax.erf_inv(jnp.clip(y, -tip, most))
        across = lax.erf_inv(jnp.clip(2 * u[1] - 1, -tip, tip))
        # Azimuth of wi; arbitrary at normal incidence.
        x = jnp.where(sin > 0, w[0] / jnp.where(sin > 0, sin, 1), 1)
        y = jnp.where(sin > 0, w[1] / jnp.where(sin > 0, sin, 1), 0)
        return self._unstretched(-(x * along - y * across), -(y * along + x * across), jnp.ones_like(cos))


DISTRIBUTIONS: dict[str, type[Distribution]] = {"beckmann": Beckmann, "ggx": GGX}


def above_horizon(v: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return v, with z = 1 where it lies below the horizon, for formulas that divide by v.z."""
    return jnp.stack([v[0], v[1], jnp.where(v[2] > 0, v[2], 1)])


def mirrored(wi: Float[Array, "3"], m: Float[Array, "3"]) -> Float[Array, "3"]:
    """Mirror wi at the normal m."""
    return 2 * dot(wi, m) * m - wi
