"""One pixel, term by term: what each power of T in L = Le + T Le + T^2 Le + ... adds to it."""

from __future__ import annotations

import jax.numpy as jnp

from pathjax.compile import compute_once
from pathjax.integrators.options import Options
from pathjax.integrators.pixel import over_vertices


def sums(work, scene, choice, depth, options: Options):
    """(depth, 3) sums over a pixel's samples, the paths of `pixel.mean`: row k is T^k Le.

    Args:
        work: the pixel () int32, and its `pixel.numbers`. Sums are plain, so for some thousand samples at most.
        depth: number of terms, max_depth of the scene.
        options: by vertex.
    """
    rows = jnp.arange(depth)[:, None]

    def add(sums, k, now, weight):
        emission, light = compute_once((weight * now.L.emission, weight * now.L.light))
        return sums + jnp.where(rows == k, emission, jnp.where(rows == k + 1, light, 0))

    return over_vertices(work, scene, choice, add, jnp.zeros((depth, 3), scene.camera.origin.dtype), options)
