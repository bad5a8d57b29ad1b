"""One pixel: a sample of its radiance, from the film to the light, and the mean of many."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from pathjax import film
from pathjax.camera import sample_ray
from pathjax.core import sampler
from pathjax.integrators import path


def sample(scene, choice, pixel, stream, number, strategy, **how):
    """Weighted radiance (3,) of one sample, and the dielectrics that its path met, as `path.Path.glass` has them.

    Args:
        choice: of `emitters.choice`; pixel: () int32; stream: its `sampler.pixel_stream`; number: () uint32.
        how: `derivative` and `watch_glass` of `path.trace`.
    """
    u_film, u_lens, numbers = path.sample_numbers(scene, stream, number)
    position, weight = film.sample_position(scene.film, pixel, u_film)
    ray = sample_ray(scene.camera, position, u_lens)
    ended = path.trace(scene, choice, ray, numbers, strategy, **how)
    return weight * ended.L, ended.glass


def numbers(pixels, first_sample, spp, seed):
    """What to sample of each pixel: (N,) uint32 each, of numbers or arrays (N,)."""
    return tuple(jnp.broadcast_to(jnp.asarray(x, jnp.uint32), pixels.shape) for x in (first_sample, spp, seed))


def mean(work, scene, choice, strategy):
    """(3,) mean of a pixel's samples. work: the pixel () int32, and its `numbers`."""
    pixel, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel)

    def add(i, state):
        number = first_sample + i.astype(jnp.uint32)
        return add_compensated(state, sample(scene, choice, pixel, stream, number, strategy)[0])

    zero = jnp.zeros((3,), scene.camera.origin.dtype)
    total, _ = lax.fori_loop(0, spp.astype(jnp.int32), add, (zero, zero))
    return total / spp.astype(total.dtype)


def add_compensated(state, term):
    """Kahan's sum: a million samples keep their digits. state: total and what its last rounding lost."""
    total, lost = state
    term = term - lost
    new = total + term
    return new, (new - total) - term
