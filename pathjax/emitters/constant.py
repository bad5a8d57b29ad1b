"""Radiance from all directions that nothing else fills."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from pathjax.core.types import EmitterSample
from pathjax.core.warp import SPHERE_PDF, square_to_sphere


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Constant:
    radiance: jax.Array  # (3,)


def sample(table: Constant, u) -> EmitterSample:
    """Uniform over the sphere. u: (2,)."""
    d = square_to_sphere(u)
    far, pdf = jnp.full_like(d[0], jnp.inf), jnp.full_like(d[0], SPHERE_PDF)
    return EmitterSample(d, far, jnp.int32(-1), table.radiance, pdf)
