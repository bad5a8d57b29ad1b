"""Small pytrees that pass between the parts of the renderer. All of them describe one ray or one path.

Integers are int32, reals are the scene's dtype (float32 unless the scene was built in float64).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer

# Also one that is traced: numbers of samples and seeds may be arguments of a kernel.
Number = int | Integer[Array, ""]


class Ray(NamedTuple):
    o: Float[Array, "3"]  # origin
    d: Float[Array, "3"]  # unit direction
    t_max: Float[Array, ""]  # hits beyond are not looked for
    exclude: Int[Array, ""]  # primitive that the ray starts on; -1: none


class Hit(NamedTuple):
    t: Float[Array, ""]  # distance; inf: a miss
    primitive: Int[Array, ""]  # counted over all kinds of shape; -1: a miss
    shape: Int[Array, ""]  # place of the shape in the scene file; -1: a miss


class Frame(NamedTuple):
    s: Float[Array, "3"]
    t: Float[Array, "3"]
    n: Float[Array, "3"]  # the normal; right-handed, orthonormal


class Surface(NamedTuple):
    """What a ray sees where it hits; Mitsuba's `si`."""

    p: Float[Array, "3"]  # the point
    n: Float[Array, "3"]  # unit geometric normal
    margin: Float[Array, ""]  # how far along n the rounding error of p may reach
    shading_n: Float[Array, "3"]  # unit shading normal
    uv: Float[Array, "2"]
    tangent: Float[Array, "3"] | None = None  # unit, the way u grows, across shading_n; None: no bsdf of the scene asks
    attributes: dict[str, Float[Array, "3"]] | None = None  # of the mesh, by name; None: no texture of the scene asks
    # How p moves with u and with v, along the surface; 0 where that is not known. None: no bsdf of the scene asks.
    along: tuple[Float[Array, "3"], Float[Array, "3"]] | None = None
    # Number of the first corner of a triangle among all, and the shares of its three. None: no derivative asks.
    corners: tuple[Int[Array, ""], Float[Array, "3"]] | None = None


class BSDFSample(NamedTuple):
    wo: Float[Array, "3"]  # unit, local frame
    weight: Float[Array, "3"]  # f |cos theta_o| / pdf
    pdf: Float[Array, ""]  # 1/sr; of a Dirac lobe: its discrete probability
    delta: Bool[Array, ""]  # a Dirac lobe
    passive: Float[Array, ""]  # factor of the weight that tells nothing of the light left: roulette disregards it


class EmitterSample(NamedTuple):
    d: Float[Array, "3"]  # unit, from the shaded point
    distance: Float[Array, ""]  # to the light; inf: a background
    primitive: Int[Array, ""]  # primitive of the light, which does not shadow itself; -1: it has none
    Le: Float[Array, "3"]  # radiance towards the shaded point, W m^-2 sr^-1; of a Dirac light: irradiance across d
    pdf: Float[Array, ""]  # 1/sr, the choice of the light included; of a Dirac light: that alone; 0: no sample
    delta: Bool[Array, ""] | None  # a Dirac light, which nothing else finds; None: the scene has none

    @property
    def density(self) -> Float[Array, ""]:
        """1/sr, for multiple importance sampling; inf of a Dirac light."""
        return self.pdf if self.delta is None else jnp.where(self.delta, jnp.inf, self.pdf)
