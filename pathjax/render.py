"""From a scene to an image."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from pathjax import emitters, film
from pathjax.camera import sample_ray
from pathjax.core import sampler
from pathjax.errors import InputError
from pathjax.integrators import path
from pathjax.runtime import native_map
from pathjax.scene import Scene


def render(scene: Scene, spp: int = 64, seed: int = 0, strategy: str = "mis"):
    """Image of a scene: (H, W, 3), linear RGB, unbiased up to the scene's max_depth.

    Pure; may be called inside `jax.jit`. The same scene structure, image size and strategy compile once: other
    parameters, cameras, spp and seeds reuse the kernel.

    Args:
        spp: samples per pixel, at least 1.
        seed: other seeds give independent images; the same seed gives the same image, bit for bit, on any number of
            CPU devices.
        strategy: "mis", or "light" or "bsdf" for experiments.
    Raises:
        InputError: unknown strategy, spp or seed out of range.
    A sample that is not finite leaves its pixel not finite, and the others untouched.
    """
    pixels = jnp.arange(film.pixel_count(scene.film), dtype=jnp.int32)
    image = render_pixels(scene, pixels, 0, spp, seed, strategy)
    return image.reshape(*film.image_shape(scene.film), 3)


def render_pixels(scene: Scene, pixels, first_sample, spp, seed, strategy: str = "mis", **how):
    """Means over the samples first_sample, ..., first_sample + spp - 1 of some pixels: (N,) int32 -> (N, 3).

    how: `form` and `devices` of `runtime.native_map`.
    """
    if strategy not in path.STRATEGIES:
        raise InputError(f"strategy {strategy!r} is unknown; use one of {', '.join(path.STRATEGIES)}")
    for name, value, least in (("spp", spp, 1), ("seed", seed, 0)):
        if isinstance(value, int) and not least <= value < 2**31:
            raise InputError(f"{name} = {value}; it must lie in [{least}, 2^31)")
    arguments = (jnp.asarray(x, jnp.uint32) for x in (first_sample, spp, seed))
    return _render_pixels(replace(scene, about=None), pixels, *arguments, strategy=strategy, **how)


@partial(jax.jit, static_argnames=("strategy", "form", "devices"))
def _render_pixels(scene, pixels, first_sample, spp, seed, *, strategy, form=None, devices=None):
    choice = emitters.choice(scene.emitters, strategy)
    pixel_mean = partial(_pixel_mean, strategy=strategy)
    return native_map(pixel_mean, pixels, scene, choice, first_sample, spp, seed, form=form, devices=devices)


def _pixel_mean(pixel, scene, choice, first_sample, spp, seed, strategy):
    """(3,) mean of a pixel's samples."""
    stream = sampler.pixel_stream(seed, pixel)

    def add_sample(i, state):
        total, lost = state
        u_film, u_lens, numbers = path.sample_numbers(scene, stream, first_sample + i.astype(jnp.uint32))
        position, weight = film.sample_position(scene.film, pixel, u_film)
        ray = sample_ray(scene.camera, position, u_lens)
        L = weight * path.radiance(scene, choice, ray, numbers, strategy)
        # Compensated (Kahan): a million samples keep their digits.
        term = L - lost
        new = total + term
        return new, (new - total) - term

    zero = jnp.zeros((3,), scene.camera.origin.dtype)
    total, _ = lax.fori_loop(0, spp.astype(jnp.int32), add_sample, (zero, zero))
    return total / spp.astype(total.dtype)
