"""Estimate one pixel: the mean of its samples, from the film to the light."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Integer, UInt

from pathjax.compile import compute_once, persistent_loop, unset
from pathjax.core import sampler
from pathjax.core.types import Ray
from pathjax.emitters import Choice
from pathjax.integrators import path
from pathjax.integrators.options import Counts, Options
from pathjax.integrators.random_numbers import bounce_numbers, camera_numbers
from pathjax.scene.scene import Scene
from pathjax.sensors import film

# The pixel and its `numbers`: first sample, spp, seed.
Work = tuple[Int[Array, ""], sampler.Word, sampler.Word, sampler.Word]


def numbers(
    pixels: Integer[Array | np.ndarray, " N"], first_sample: Counts, spp: Counts, seed: Counts
) -> tuple[UInt[Array | np.ndarray, " N"], ...]:
    """Broadcast first sample, spp and seed, each one for all pixels or one per pixel, to (N,) uint32."""

    def of_each(x):
        module = jnp if isinstance(x, jax.Array) else np  # NumPy compiles nothing
        return module.broadcast_to(module.asarray(x, np.uint32), pixels.shape)

    return tuple(map(of_each, (first_sample, spp, seed)))


def camera_ray(
    scene: Scene, pixel: Int[Array, ""], stream: sampler.Word, number: sampler.Word, points: str = "lattice"
) -> tuple[Ray, Float[Array, ""]]:
    """Return the camera ray of one sample, and the sample's weight.

    stream: the pixel's `sampler.pixel_stream`; points: one of `options.SAMPLERS`.
    """
    u_film, u_lens = compute_once(camera_numbers(scene, stream, number, points))
    position, weight = film.sample_position(scene.film, pixel, u_film)
    if scene.camera.gain != 1:
        weight = scene.camera.gain * weight
    return compute_once((scene.camera.sample_ray(position, u_lens), weight))


def camera_path(
    scene: Scene, pixel: Int[Array, ""], stream: sampler.Word, number: sampler.Word, options: Options
) -> tuple[path.Path, Float[Array, ""]]:
    """Return the path of one sample at the camera, and the sample's weight; arguments as for `camera_ray`."""
    ray, weight = camera_ray(scene, pixel, stream, number, options.sampler)
    return path.start(scene, ray, options), weight


def no_path(scene: Scene, options: Options) -> tuple[path.Path, Float[Array, ""]]:
    """Return a placeholder for a `camera_path`: not alive, the rest `unset`, so that lanes need not write it."""
    nothing = jax.eval_shape(lambda x: camera_path(scene, jnp.int32(0), x, x, options), jnp.uint32(0))
    now, weight = unset(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), nothing))
    return now._replace(alive=jnp.bool_(False)), weight


def mean(work: Work, scene: Scene, choice: Choice | None, control=None, *, options: Options) -> Float[Array, "3"]:
    """Return the mean of a pixel's samples; 0 if it has none.

    choice, control: as for `path.extend`.
    """

    def add(sums, _, now, weight):
        value = compute_once(weight * now.L)
        return lax.cond(now.alive, lambda: sums, lambda: add_compensated(sums, value))

    zero = jnp.zeros((3,), scene.camera.origin.dtype)
    total, _ = over_vertices(work, scene, choice, add, (zero, zero), options, control)
    _, _, spp, _ = work
    return total / jnp.maximum(spp, 1).astype(total.dtype)


def over_vertices(work: Work, scene: Scene, choice: Choice | None, add: Callable, sums, options: Options, control=None):
    """Sum over all vertices of a pixel's samples, in one loop, so that no lane waits for the longest path of another.

    Args:
        add: (sums, Path before the vertex, Path after it, weight of the sample) -> sums.
        choice, control: as for `path.extend`.
    """
    pixel, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel)

    def step(state):
        number, now, weight, sums = state
        before, weight = begun(scene, pixel, stream, number, now, weight, options)
        u = bounce_numbers(scene, stream, number, path.vertices(before), options.sampler)
        now = path.extend(scene, choice, before, u, options, control)
        sums = add(sums, before, now, weight)
        return number + jnp.where(now.alive, 0, 1).astype(number.dtype), now, weight, sums

    state = first_sample, *no_path(scene, options), sums
    return persistent_loop(lambda state: state[0] != first_sample + spp, step, state)[-1]


def begun(
    scene: Scene,
    pixel: Int[Array, ""],
    stream: sampler.Word,
    number: sampler.Word,
    now: path.Path,
    weight: Float[Array, ""],
    options: Options,
) -> tuple[path.Path, Float[Array, ""]]:
    """Return path and weight unchanged while the path is alive; else those of `camera_path` for the sample `number`."""

    def begin():
        return camera_path(scene, pixel, stream, number, options)

    return compute_once(lax.cond(now.alive, lambda: (now, weight), begin))


def add_compensated(state, term):
    """Add a term by Kahan summation: a million samples keep their digits. state: total and its last rounding error."""
    total, lost = state
    term = term - lost
    new = total + term
    return new, (new - total) - term
