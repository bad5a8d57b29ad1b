"""One pixel: the mean of its samples, from the film to the light."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.core import sampler
from pathjax.integrators import path
from pathjax.sensors import film


def numbers(pixels, first_sample, spp, seed):
    """What to sample of each pixel: (N,) uint32 each, of numbers or arrays (N,)."""
    return tuple(jnp.broadcast_to(jnp.asarray(x, jnp.uint32), pixels.shape) for x in (first_sample, spp, seed))


def camera_path(scene, pixel, stream, number, points="lattice", **how):
    """Path of one sample at the camera, and the sample's weight ().

    Args:
        pixel: () int32; stream: () uint32, its `sampler.pixel_stream`; number: () uint32; points: of `path.SAMPLERS`.
        how: of `path.start`.
    """
    u_film, u_lens = lax.optimization_barrier(path.camera_numbers(scene, stream, number, points))
    position, weight = film.sample_position(scene.film, pixel, u_film)
    ray = scene.camera.sample_ray(position, u_lens)
    return lax.optimization_barrier((path.start(scene, ray, **how), weight))


def no_path(scene, **how):
    """What stands where a `camera_path` is to be put."""
    nothing = jax.eval_shape(lambda x: camera_path(scene, jnp.int32(0), x, x, **how), jnp.uint32(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), nothing)


def mean(work, scene, choice, control=None, *, strategy, derivative=False, split_depth=0, points="lattice"):
    """(3,) mean of a pixel's samples; 0 of none.

    Args:
        work: the pixel () int32, and its `numbers`.
        derivative, control: of `path.extend`; split_depth: of `path.start`; points: of `path.SAMPLERS`.
    """

    def add(sums, depth, now, weight):
        value = lax.optimization_barrier(weight * now.L)
        return lax.cond(now.alive, lambda: sums, lambda: add_compensated(sums, value))

    zero = jnp.zeros((3,), scene.camera.origin.dtype)
    start = {"points": points, "split_depth": split_depth, "controlled": control is not None}
    extend = {"strategy": strategy, "derivative": derivative, "control": control}
    total, _ = over_vertices(work, scene, choice, add, (zero, zero), start, extend)
    _, _, spp, _ = work
    return total / jnp.maximum(spp, 1).astype(total.dtype)


def over_vertices(work, scene, choice, add, sums, start, extend):
    """Sums over all vertices of a pixel's samples: one loop, so that no lane waits for the longest path of another.

    Args:
        work: the pixel () int32, and its `numbers`.
        add: (sums, depth () int32 of the path before the vertex, Path after it, weight () of the sample) -> sums.
        start, extend: keywords of `camera_path` and of `path.extend`.
    """
    pixel, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel)
    points = start.get("points", "lattice")

    def step(state):
        number, now, weight, sums = state
        now, weight = lax.cond(
            now.alive, lambda: (now, weight), lambda: camera_path(scene, pixel, stream, number, **start)
        )
        now, weight = lax.optimization_barrier((now, weight))
        depth = now.depth
        now = path.extend(scene, choice, now, path.bounce_numbers(scene, stream, number, depth, points), **extend)
        sums = add(sums, depth, now, weight)
        return number + jnp.where(now.alive, 0, 1).astype(number.dtype), now, weight, sums

    state = first_sample, *no_path(scene, **start), sums
    return lax.while_loop(lambda state: state[0] != first_sample + spp, step, state)[-1]


def add_compensated(state, term):
    """Kahan's sum: a million samples keep their digits. state: total and what its last rounding lost."""
    total, lost = state
    term = term - lost
    new = total + term
    return new, (new - total) - term
