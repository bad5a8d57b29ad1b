"""One pixel, term by term: what each power of T in L = Le + T Le + T^2 Le + ... adds to it."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from pathjax.integrators.pixel import over_vertices


def sums(work, scene, choice, strategy, depth, derivative=False):
    """(depth, 3) sums over a pixel's samples, the paths of `pixel.mean`: row k is T^k Le.

    Args:
        work: the pixel () int32, and its `pixel.numbers`. Sums are plain, so for some thousand samples at most.
        depth: number of terms, max_depth of the scene; derivative: of `path.extend`.
    """
    rows = jnp.arange(depth)[:, None]

    def add(sums, k, now, weight):
        emission, light = lax.optimization_barrier((weight * now.L.emission, weight * now.L.light))
        return sums + jnp.where(rows == k, emission, jnp.where(rows == k + 1, light, 0))

    zeros = jnp.zeros((depth, 3), scene.camera.origin.dtype)
    extend = {"strategy": strategy, "derivative": derivative}
    return over_vertices(work, scene, choice, add, zeros, {"by_vertex": True}, extend)
