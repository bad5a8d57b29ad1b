"""Small pytrees that pass between the parts of the renderer. All of them describe one ray or one path.

Integers are int32, reals are the scene's dtype (float32 unless the scene was built in float64).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Ray(NamedTuple):
    o: jax.Array  # (3,) origin
    d: jax.Array  # (3,) unit direction
    t_max: jax.Array  # () hits beyond are not looked for
    exclude: jax.Array  # () int32 primitive that the ray starts on; -1: none


class Hit(NamedTuple):
    t: jax.Array  # () distance; inf: a miss
    primitive: jax.Array  # () int32, counted over all kinds of shape; -1: a miss
    shape: jax.Array  # () int32, place of the shape in the scene file; -1: a miss


class Frame(NamedTuple):
    s: jax.Array  # (3,)
    t: jax.Array  # (3,)
    n: jax.Array  # (3,) the normal; right-handed, orthonormal


class Surface(NamedTuple):
    """What a ray sees where it hits; Mitsuba's `si`."""

    p: jax.Array  # (3,) the point
    n: jax.Array  # (3,) unit geometric normal
    margin: jax.Array  # () how far along n the rounding error of p may reach
    shading_n: jax.Array  # (3,) unit shading normal
    uv: jax.Array  # (2,)


class BSDFSample(NamedTuple):
    wo: jax.Array  # (3,) unit, local frame
    weight: jax.Array  # (3,) f |cos theta_o| / pdf
    pdf: jax.Array  # () 1/sr; of a Dirac lobe: its discrete probability
    delta: jax.Array  # () bool, a Dirac lobe
    passive: jax.Array  # () factor of the weight that says nothing of how much light is left: roulette disregards it


class EmitterSample(NamedTuple):
    d: jax.Array  # (3,) unit, from the shaded point
    distance: jax.Array  # () to the light; inf: a background
    primitive: jax.Array  # () int32 primitive of the light, which does not shadow itself; -1: it has none
    Le: jax.Array  # (3,) radiance towards the shaded point, W m^-2 sr^-1; of a Dirac light: irradiance across d
    pdf: jax.Array  # () 1/sr, the choice of the light included; of a Dirac light: that alone; 0: no sample
    delta: jax.Array | None  # () bool, a Dirac light, which nothing else finds; None: the scene has none

    @property
    def density(self):
        """() 1/sr, for multiple importance sampling; inf of a Dirac light."""
        return self.pdf if self.delta is None else jnp.where(self.delta, jnp.inf, self.pdf)
