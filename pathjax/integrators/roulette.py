"""Russian roulette: paths of little throughput end early, and those that go on make up for them."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import compute_once
from pathjax.core.math import larger, safe_divide, smaller
from pathjax.scene.scene import Scene

# Roulette never spares a path for certain, so that every path ends even between perfect mirrors; and never ends one for
# certain, so that what is black keeps its derivative.
MIN_SURVIVAL, MAX_SURVIVAL = 0.05, 0.95


def survival(
    scene: Scene, depth: Int[Array, ""], throughput: Float[Array, "3"], passive: Float[Array, ""] | None
) -> Float[Array, ""]:
    """Probability with which a path goes on: its largest throughput, detached; 1 before the scene's rr_depth.

    Args:
        depth, throughput: behind the vertex.
        passive: factor of it by which refraction scaled radiance, and which says nothing of how much light is left:
            with it, paths in glass would end too soon. None: there is no glass.
    """
    left = lax.stop_gradient(largest(throughput))
    if passive is not None:
        left = safe_divide(left, passive)
    return compute_once(jnp.where(depth >= scene.rr_depth, bounded(left), 1))


def bounded(survival: Float[Array, ""]) -> Float[Array, ""]:
    """The same within its bounds; the least of them for NaN."""
    least, most = (jnp.full_like(survival, x) for x in (MIN_SURVIVAL, MAX_SURVIVAL))
    return larger(smaller(survival, most), least)


def largest(rgb: Float[Array, "3"]) -> Float[Array, ""]:
    """Largest of three numbers."""
    return larger(larger(rgb[0], rgb[1]), rgb[2])
