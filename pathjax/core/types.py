"""Small pytrees that pass between the parts of the renderer. Each describes one ray or one path.

Integers are int32, reals have the scene's dtype (float32 unless the scene was built in float64).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer

# May be traced: sample counts and seeds can be arguments of a kernel.
Number = int | Integer[Array, ""]


class Ray(NamedTuple):
    o: Float[Array, "3"]  # origin
    d: Float[Array, "3"]  # unit direction
    t_max: Float[Array, ""]  # hits beyond it are ignored
    exclude: Int[Array, ""]  # primitive that the ray starts on; -1: none


class Hit(NamedTuple):
    t: Float[Array, ""]  # distance; inf: a miss
    primitive: Int[Array, ""]  # index over all kinds of shape; -1: a miss
    shape: Int[Array, ""]  # index of the shape in the scene file; -1: a miss


class Frame(NamedTuple):
    s: Float[Array, "3"]
    t: Float[Array, "3"]
    n: Float[Array, "3"]  # the normal; right-handed, orthonormal


class Surface(NamedTuple):
    """The surface where a ray hits; Mitsuba's `si`."""

    p: Float[Array, "3"]  # the point
    n: Float[Array, "3"]  # unit geometric normal
    margin: Float[Array, ""]  # bound of the rounding error of p along n
    shading_n: Float[Array, "3"]  # unit shading normal
    uv: Float[Array, "2"]
    tangent: Float[Array, "3"] | None = None  # unit, direction of growing u, normal to shading_n; None: no bsdf uses it
    attributes: dict[str, Float[Array, "3"]] | None = None  # of the mesh, by name; None: no texture uses them
    # Derivatives of p in u and v, along the surface; 0 where unknown. None: no bsdf of the scene uses them.
    along: tuple[Float[Array, "3"], Float[Array, "3"]] | None = None
    # Index of a triangle's first corner among all corners, and the three barycentric weights. None: not needed.
    corners: tuple[Int[Array, ""], Float[Array, "3"]] | None = None


class BSDFSample(NamedTuple):
    wo: Float[Array, "3"]  # unit, local frame
    weight: Float[Array, "3"]  # f |cos theta_o| / pdf
    pdf: Float[Array, ""]  # 1/sr; for a Dirac lobe its discrete probability
    delta: Bool[Array, ""]  # whether the lobe is Dirac
    passive: Float[Array, ""]  # factor of the weight that does not change how much light is left: roulette ignores it


class EmitterSample(NamedTuple):
    d: Float[Array, "3"]  # unit, from the shaded point
    distance: Float[Array, ""]  # to the light; inf: a background
    primitive: Int[Array, ""]  # primitive of the light, which does not shadow itself; -1: it has none
    Le: Float[Array, "3"]  # radiance towards the shaded point, W m^-2 sr^-1; of a Dirac light: irradiance across d
    pdf: Float[Array, ""]  # 1/sr, with the probability of the light; of a Dirac light that probability; 0: no sample
    delta: Bool[Array, ""] | None  # whether it is a Dirac light, found only by light samples; None: the scene has none

    @property
    def density(self) -> Float[Array, ""]:
        """Density in 1/sr for multiple importance sampling; inf for a Dirac light."""
        return self.pdf if self.delta is None else jnp.where(self.delta, jnp.inf, self.pdf)
