"""From a scene to an image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from pathjax import emitters, film, gradient, named
from pathjax.errors import InputError
from pathjax.integrators import path, pixel
from pathjax.named import Parameter
from pathjax.runtime import native_map
from pathjax.scene import Scene


def render(scene: Scene, spp: int = 64, seed: int = 0, strategy: str = "mis"):
    """Image of a scene: (H, W, 3), linear RGB, unbiased up to the scene's max_depth.

    Pure; may be called inside `jax.jit`, under `jax.vmap` over scenes that differ in parameters or cameras, and be
    differentiated in what `parameters` lists, forwards or backwards: the derivative is that of `jacobian`, which says
    how, and for the IOR of smooth glass how far, it may be trusted. The same scene structure, image size and strategy
    compile once: other parameters, cameras, spp and seeds reuse the kernel.

    Args:
        spp: samples per pixel, at least 1.
        seed: other seeds give independent images; the same seed gives the same image, bit for bit, on any number of
            CPU devices.
        strategy: "mis", or "light" or "bsdf" for experiments.
    Raises:
        InputError: unknown strategy, spp or seed out of range; differentiation in anything but named parameters.
    A sample that is not finite leaves its pixel not finite, and the others untouched.
    """
    pixels = jnp.arange(film.pixel_count(scene.film), dtype=jnp.int32)
    image = render_pixels(scene, pixels, 0, spp, seed, strategy)
    return image.reshape(*film.image_shape(scene.film), 3)


def render_pixels(scene: Scene, pixels, first_sample, spp, seed, strategy: str = "mis", **how):
    """Means over the samples first_sample, ..., first_sample + spp - 1 of some pixels: (N,) int32 -> (N, 3).

    first_sample, spp, seed: each one number, or (N,) of the pixels.
    how: `form` and `devices` of `runtime.native_map`.
    """
    path.check_sampling(strategy, spp, seed)
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    static = _Static(differentiable(scene), strategy, tuple(how.items()))
    return _means(static, replace(scene, about=None), pixels, *numbers)


@dataclass(frozen=True)
class _Static:
    wanted: tuple[tuple[str, Parameter], ...]  # parameters in which a derivative may be wanted
    strategy: str
    how: tuple[tuple[str, object], ...]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _means(static: _Static, scene, pixels, first_sample, spp, seed):
    return _render_pixels(scene, pixels, first_sample, spp, seed, strategy=static.strategy, **dict(static.how))


@partial(_means.defjvp, symbolic_zeros=True)
def _means_jvp(static: _Static, primals, tangents):
    """Tangent J @ d(parameters): linear, so that it also transposes."""
    scene, *arguments = primals
    scene_tangent, *_ = tangents
    wanted = differentiated(static.wanted, scene_tangent)
    image, derivatives, _, _ = gradient.pixel_jacobians(
        scene, wanted, *arguments, strategy=static.strategy, method="difference", step=None, **dict(static.how)
    )
    tangent = jnp.zeros_like(image)
    for name, parameter in wanted.items():
        change = named.get(scene_tangent, parameter.path)[parameter.index]
        tangent = tangent + (derivatives[name] @ change if parameter.shape else derivatives[name] * change)
    return image, tangent


def differentiable(scene: Scene):
    """Parameters that may be traced, by name."""
    if scene.about is None:
        return ()
    parameters = scene.about.parameters
    names = frozenset().union(*(named.traced_in(scene, path) for path in {p.path for p in parameters.values()}))
    return tuple((name, parameters[name]) for name in parameters if name in names)


def differentiated(candidates, scene_tangent):
    """Parameters by name whose tangents may be other than zero."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(scene_tangent, is_leaf=lambda x: isinstance(x, SymbolicZero))
    wanted = {}
    for keys, leaf in leaves:
        if isinstance(leaf, SymbolicZero):
            continue
        place = tuple(key.name if isinstance(key, jax.tree_util.GetAttrKey) else key.idx for key in keys)
        held = {name: parameter for name, parameter in candidates if parameter.path == place}
        if not held:
            raise InputError(
                f"a derivative in scene.{'.'.join(map(str, place))} was asked for, and pathjax does not differentiate "
                "in it; set named parameters by with_parameters and differentiate in their values (`pathjax info` "
                "lists them)"
            )
        wanted |= held
    return wanted


@partial(jax.jit, static_argnames=("strategy", "form", "devices"))
def _render_pixels(scene, pixels, first_sample, spp, seed, *, strategy, form=None, devices=None):
    choice = emitters.choice(scene.emitters, strategy)
    pixel_mean = partial(pixel.mean, strategy=strategy)
    work = pixels, first_sample, spp, seed
    return native_map(pixel_mean, work, scene, choice, form=form, devices=devices)
