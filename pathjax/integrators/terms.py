"""One pixel, term by term: the contribution of each power of T in L = Le + T Le + T^2 Le + ..."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.compile import compute_once
from pathjax.emitters import Choice
from pathjax.integrators.options import Options
from pathjax.integrators.pixel import Work, over_vertices
from pathjax.scene.scene import Scene


def sums(work: Work, scene: Scene, choice: Choice | None, depth: int, options: Options) -> Float[Array, "{depth} 3"]:
    """Return sums over a pixel's samples, with the paths of `pixel.mean`: row k is T^k Le.

    The sums are not compensated: use at most a few thousand samples. depth: the scene's max_depth; options: by_vertex.
    """
    rows = jnp.arange(depth)[:, None]

    def add(sums, before, now, weight):
        k, scale = before.depth, weight * before.throughput
        emission, light = compute_once((scale * now.L.emission, scale * now.L.light))
        beyond = k + 1 if now.L.passed is None else k + 1 + now.L.passed
        return sums + jnp.where(rows == k, emission, jnp.where(rows == beyond, light, 0))

    return over_vertices(work, scene, choice, add, jnp.zeros((depth, 3), scene.camera.origin.dtype), options)
