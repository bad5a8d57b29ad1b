"""One pixel, term by term: what each power of T in L = Le + T Le + T^2 Le + ... adds to it."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from pathjax.core import sampler
from pathjax.integrators import path
from pathjax.integrators.pixel import camera_path, no_path


def sums(work, scene, choice, strategy, depth, derivative=False):
    """(depth, 3) sums over a pixel's samples, the paths of `pixel.mean`: row k is T^k Le.

    Args:
        work: the pixel () int32, and its `pixel.numbers`. Sums are plain, so for some thousand samples at most.
        depth: number of terms, max_depth of the scene; derivative: of `path.extend`.
    """
    pixel, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel)
    rows = jnp.arange(depth)[:, None]

    def step(state):
        number, now, weight, sums = state
        now, weight = lax.cond(
            now.alive, lambda: (now, weight), lambda: camera_path(scene, pixel, stream, number, by_vertex=True)
        )
        now, weight = lax.optimization_barrier((now, weight))
        k = now.depth
        now = path.extend(scene, choice, now, path.bounce_numbers(scene, stream, number, k), strategy, derivative)
        emission, light = lax.optimization_barrier((weight * now.L.emission, weight * now.L.light))
        sums = sums + jnp.where(rows == k, emission, jnp.where(rows == k + 1, light, 0))
        return number + jnp.where(now.alive, 0, 1).astype(number.dtype), now, weight, sums

    zeros = jnp.zeros((depth, 3), scene.camera.origin.dtype)
    start = first_sample, *no_path(scene, by_vertex=True), zeros
    *_, sums = lax.while_loop(lambda state: state[0] != first_sample + spp, step, start)
    return sums
