"""The phase function that is the same in all directions."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.warp import SPHERE_PDF, square_to_sphere
from pathjax.kinds import Row
from pathjax.media.phase import Phase


class Isotropic(Phase):
    """Scatters uniformly over all directions."""

    @staticmethod
    def evaluate(p: Row, wo: Float[Array, "3"]) -> Float[Array, ""]:
        return jnp.full_like(wo[2], SPHERE_PDF)

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"]) -> Float[Array, "3"]:
        return square_to_sphere(u)
