"""From a scene to an image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from pathjax import bsdfs, emitters
from pathjax.compile.runtime import native_map, usual_promotion
from pathjax.derivatives import gradient
from pathjax.errors import InputError
from pathjax.integrators import path, pixel
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene
from pathjax.sensors import film


@usual_promotion
def render(
    scene: Scene,
    spp: int = 64,
    seed: int = 0,
    strategy: str = "mis",
    *,
    fresnel: str = "exact",
    split_depth: int = 0,
    sampler: str = "lattice",
    control=None,
):
    """Render a scene: (H, W, 3), linear RGB, unbiased up to the scene's max_depth (except with `fresnel="schlick"`).

    Pure. It may be called inside `jax.jit`, under `jax.vmap` over scenes that differ in parameters or cameras, and be
    differentiated in what `parameters` lists, forwards or backwards. The derivative is that of `jacobian`, which says
    how far it may be trusted. A kernel is compiled once for each scene structure, image size and set of the choices
    below; other parameters, cameras, spp and seeds reuse it. A sample that is not finite leaves its pixel not finite,
    and the others untouched.

    Args:
        spp: samples per pixel, at least 1.
        seed: other seeds give independent images; the same seed gives the same image, bit for bit, on any number of
            CPU devices.
        strategy: "mis", or "light" or "bsdf" for experiments.
        fresnel: reflectance of dielectrics, "exact", or "schlick", whose approximation biases the image. This and what
            follows are for experiments; the defaults compile nothing of them.
        split_depth: number of dielectrics, counted along a path, at which both branches are followed instead of one by
            chance; 0 to 8. A sample may then be 2^split_depth paths.
        sampler: random numbers, "lattice", or "independent" of each other, or "subpixel": independent, but with a
            quarter of the samples in each of 2 x 2 strata of the pixel's filter; spp is then a multiple of 4.
        control: a `transport.Control`, made by `Operator.control`, into which paths end instead of into darkness. The
            mean stays, whatever light it holds. It seldom pays: see `pathjax help transport`.
    Raises:
        InputError: a choice is unknown, or spp, seed or split_depth is out of range; differentiation in anything but
            named parameters, or with another sampler, split_depth or control than the default.
    """
    pixels = jnp.arange(film.pixel_count(scene.film), dtype=jnp.int32)
    choices = {"fresnel": fresnel, "split_depth": split_depth, "sampler": sampler, "control": control}
    image = render_pixels(scene, pixels, 0, spp, seed, strategy, **choices)
    return image.reshape(*film.image_shape(scene.film), 3)


@usual_promotion
def render_pixels(
    scene: Scene,
    pixels,
    first_sample,
    spp,
    seed,
    strategy: str = "mis",
    *,
    fresnel: str = "exact",
    split_depth: int = 0,
    sampler: str = "lattice",
    control=None,
    **how,
):
    """Means over the samples first_sample, ..., first_sample + spp - 1 of some pixels: (N,) int32 -> (N, 3).

    first_sample, spp, seed: each one number, or (N,) of the pixels.
    strategy, fresnel, split_depth, sampler, control: of `render`.
    how: `form` and `devices` of `runtime.native_map`.
    """
    path.check_sampling(strategy, spp, seed, fresnel, split_depth, sampler)
    if control is not None:
        from pathjax.transport import Control  # imports lineax, a quarter of a second

        if not isinstance(control, Control):
            raise InputError(
                f"control = {control!r}; give a transport.Control: op = transport.operator(scene); "
                "control = op.control(op.solve().L)"
            )
        control.check(scene.geometry)
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    static = _Static(differentiable(scene), strategy, split_depth, sampler, tuple(how.items()))
    materials = bsdfs.with_fresnel(scene.materials, fresnel)
    return _means(static, replace(scene, materials=materials, about=None), control, pixels, *numbers)


@dataclass(frozen=True)
class _Static:
    wanted: tuple[tuple[str, Parameter], ...]  # parameters in which a derivative may be wanted
    strategy: str
    split_depth: int
    sampler: str
    how: tuple[tuple[str, object], ...]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _means(static: _Static, scene, control, pixels, first_sample, spp, seed):
    how = {"strategy": static.strategy, "split_depth": static.split_depth, "sampler": static.sampler}
    return pixel_means(scene, pixels, first_sample, spp, seed, control, **how, **dict(static.how))


@partial(_means.defjvp, symbolic_zeros=True)
@usual_promotion
def _means_jvp(static: _Static, primals, tangents):
    """Tangent J @ d(parameters): linear, so that it also transposes."""
    if static.split_depth or static.sampler != "lattice":
        raise InputError(
            f"derivatives are not made with split_depth={static.split_depth} and sampler={static.sampler!r}; "
            "differentiate with split_depth=0 and sampler='lattice', whose image has the same expectation"
        )
    scene, control, *arguments = primals
    if control is not None:
        raise InputError("derivatives are not made with a control; without one the image has the same expectation")
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


@partial(jax.jit, static_argnames=("strategy", "split_depth", "sampler", "form", "devices"))
def pixel_means(
    scene,
    pixels,
    first_sample,
    spp,
    seed,
    control=None,
    *,
    strategy,
    split_depth=0,
    sampler="lattice",
    form=None,
    devices=None,
):
    """What `render_pixels` gives, without its checks and derivatives; arguments as there, spp and seed (N,) uint32."""
    choice = emitters.choice(scene.emitters, strategy)
    pixel_mean = partial(pixel.mean, strategy=strategy, split_depth=split_depth, points=sampler)
    work = pixels, first_sample, spp, seed
    return native_map(pixel_mean, work, scene, choice, control, form=form, devices=devices)
