"""Image and Jacobian: the derivatives of every pixel in the parameters of materials and lights.

Most parameters (reflectances, radiances, roughnesses) change what paths carry, not where they go. Their derivative is
that of the weights (detached sampling) and unbiased (`tangents`, or `backward` for many scalars). The IOR of smooth
glass moves the path itself, which takes differences (`ior_difference`). Derivatives in moving geometry or cameras are
not supported.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax import emitters
from pathjax.bsdfs import dielectric
from pathjax.compile import is_symbolic_zero, is_traced, on_all_devices, register_dataclass, standard_promotion
from pathjax.core.types import Number
from pathjax.derivatives import backward, differentiated, ior, ior_difference, ior_step, rules, tangents, totals
from pathjax.derivatives.kept import kept as kept_of
from pathjax.derivatives.row_slopes import Place, RowSlopes
from pathjax.errors import InputError
from pathjax.integrators import pixel
from pathjax.integrators.options import Counts, Options
from pathjax.integrators.reconstruction import map_pixels
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.system import memory

Slopes = Mapping[str, Float[Array, "..."]]
METHODS = ("difference", "attached")
# Up to this many parameters tangents are cheaper: for 1, 2, 3 colours of the Cornell box, image and Jacobian took 1.14,
# 1.24, 1.44 images of CPU time by tangents, and 1.23, 1.24, 1.26 by a recorded sweep.
MOST_TANGENTS = 2
# Ends an error message: when a texture has a Jacobian (`takes_sweep`).
UNLESS = (
    " unless no IOR of smooth glass is named with it, and none of the textures named stands for colours and for "
    "numbers both"
)


@register_dataclass
@dataclass(frozen=True, eq=False)
class Jacobian(Mapping[str, Array]):
    """Derivatives of an image by parameter name: `J[name]` is (H, W, 3, *shape of the parameter).

    derivatives: for many scalars `RowSlopes`, which build each derivative when it is read.
    bias: for differences only: an estimate (H, W, 3) of derivative minus truth, from a second step; noisy in a single
        pixel, meant for averages.
    step: for differences only: the change of the relative IOR to either side.
    """

    derivatives: Mapping[str, jax.Array]
    bias: dict[str, jax.Array]
    step: dict[str, jax.Array]

    def __getitem__(self, name: str) -> Array:
        return self.derivatives[name]

    def __contains__(self, name: object) -> bool:
        return name in self.derivatives

    def __iter__(self) -> Iterator[str]:
        return iter(self.derivatives)

    def __len__(self) -> int:
        return len(self.derivatives)


@dataclass(frozen=True)
class Wanted:
    """What the kernel differentiates; static."""

    colors: tangents.Places  # parameters that get a tangent
    glass: tuple[int, ...]  # table rows of the dielectrics that get a difference


@agreed_by_all
@standard_promotion
def jacobian(
    scene: Scene,
    names: Sequence[str],
    spp: Number = 64,
    seed: Number = 0,
    *,
    strategy: str = "mis",
    method: str = "difference",
    step: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, "height width 3"], Jacobian]:
    """Render an image and its derivatives in named parameters, from the same paths, in one kernel.

    Pure; may be called inside `jax.jit`, and under `jax.vmap` over scenes that differ in parameters or cameras.

    Args:
        names: of parameters, as `parameters` lists them.
        spp, seed, strategy: as for `render`; the image is that of `render`, to rounding.
        method: how the IOR of smooth glass is differentiated: "difference" (central, common random numbers), or
            "attached", which follows moving points and is right only where no edge is seen through glass. The attached
            image has other branch probabilities than that of `render`, without bias.
        step: of differences, in relative IOR; None: one that moves the image by about a third of a pixel.
    Returns:
        Image and Jacobian.
    Raises:
        InputError: unknown name, method or strategy; spp, seed or step out of range; a texture named together with the
            IOR of smooth glass, or used both as colours and as scalars; a value below the least that has an effect,
            such as a roughness of 0; more derivatives than fit into memory.
    """
    if isinstance(names, str):
        raise InputError(f"names is a list of names; write [{names!r}]")
    if method not in METHODS:
        raise InputError(f"method {method!r} is unknown; use one of {', '.join(METHODS)}")
    if step is not None and not is_traced(step) and not 0 < step < 1:
        raise InputError(f"step = {step}; it must lie between 0 and 1, in units of relative IOR")
    options = Options(strategy, shared=scene.film.shared)
    options.check_counts(spp, seed)
    options.check_strategy(scene)
    wanted = {name: named.find(scene, name) for name in names}
    named.refuse_constant(scene, wanted)
    count = sum(math.prod(parameter.shape) for parameter in wanted.values())
    needed = 3 * count * math.prod(film.image_shape(scene.film)) * scene.camera.origin.dtype.itemsize
    remedy = "normal_equations keeps none of them, and neither do jax.jvp and jax.vjp of render"
    memory.check(needed, f"the derivatives of all pixels in {count} numbers", remedy)
    pixels, scene = film.pixels(scene.film), named.nameless(named.attached(scene))
    image, derivatives, bias, used = pixel_jacobians(
        scene, wanted, pixels, 0, spp, seed, options, method=method, step=step
    )
    shape = film.image_shape(scene.film)
    if isinstance(derivatives, RowSlopes):
        return image.reshape(*shape, 3), Jacobian(replace(derivatives, shape=shape), bias, used)
    image, derivatives, bias = _as_images((image, derivatives, bias), shape)
    return image, Jacobian(derivatives, bias, used)


@partial(jax.jit, static_argnums=1, donate_argnums=0)
def _as_images(of_pixels, shape):
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), of_pixels)


@standard_promotion
def pixel_jacobians(
    scene: Scene,
    wanted: dict[str, Parameter],
    pixels: Int[Array | np.ndarray, " N"],
    first_sample: Counts,
    spp: Counts,
    seed: Counts,
    options: Options,
    *,
    method: str = "difference",
    step: float | Float[Array, ""] | None = None,
    ring: int | None = None,
    **how,
) -> tuple[Float[Array, "N 3"], Slopes, Slopes, Slopes]:
    """Return the means of pixels and, by name, derivatives (N, 3, *shape), biases (N, 3) and steps ().

    Args:
        scene: without names.
        first_sample, spp, seed: each a scalar, or one per pixel.
        ring: as returned by `backward.longest_ring`; None: that of the scene.
        how: `form` and `devices` of `native_map`.
    """
    scene = on_all_devices(scene, how.get("devices"))
    attached = method == "attached"
    colors = [name for name, p in wanted.items() if attached or not p.moves_paths]
    rows = tuple(sorted({p.index[0] for p in wanted.values() if p.moves_paths}))
    glass = () if attached else rows
    if rows:
        scene = rules.differentiated_once(scene, "the IOR of smooth glass")
    if attached and rows:
        scene = choosing_by_present_iors(scene, rows)
    steps = ior_step.steps(scene, glass, step)
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    ring = ring or backward.longest_ring(scene)
    if not rows and ring <= backward.MOST_RING and takes_sweep(scene, wanted.values(), how.get("form")):
        return *_swept(wanted, options, ring, how, scene, pixels, *numbers), {}, {}
    tangents.refuse_textures(wanted, UNLESS)
    held = tangents.places(wanted[name] for name in colors)

    def of(held, first):
        here = slice(first, first + ior_difference.MOST_GLASS)
        static = Wanted(held, glass[here])
        return _jacobians(scene, pixels, *numbers, steps[here], wanted=static, options=options, **how)

    image, by_color, *by_glass = of(held, 0)
    more = [of((), first)[2:] for first in range(ior_difference.MOST_GLASS, len(glass), ior_difference.MOST_GLASS)]
    by_ior, bias = (jnp.concatenate(parts, axis=1) for parts in zip(by_glass, *more, strict=True))

    derivatives, biases, used = {}, {}, {}
    for name, parameter in wanted.items():
        if name in colors:
            derivatives[name] = _slope_of(by_color, colors.index(name), bool(parameter.shape))
        else:
            place, scale = glass.index(parameter.index[0]), ior.ratio_by(scene, parameter)
            derivatives[name], biases[name], used[name] = _of_glass(by_ior, bias, steps, place, scale)
    return image, derivatives, biases, used


# Compiled as one program each; JAX would compile every operation by itself.
@partial(jax.jit, static_argnums=2)
def _slope_of(by_color, place, of_color):
    return tangents.in_parameter(by_color[:, place], of_color)


@jax.jit
def _of_glass(by_ior, bias, steps, place, scale):
    return by_ior[:, place] * scale, bias[:, place] * scale, steps[place]


def takes_sweep(scene: Scene, parameters, form: str | None = None) -> bool:
    """Return whether a recorded sweep makes all derivatives: in textures, or in too many parameters for tangents."""
    few = len(parameters) <= MOST_TANGENTS and not any(parameter.is_texture for parameter in parameters)
    return form != "loop" and not few and has_rows(scene, parameters)


def has_rows(scene: Scene, parameters) -> bool:
    """Return whether `backward.rows` gives the derivatives in these parameters. They must move no path."""
    parameters = list(parameters)
    known = differentiated.paths(scene)
    return all(each.path in known and not differentiated.is_color_and_number(scene, each) for each in parameters)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3))
def _swept(wanted, options, ring, how, scene, pixels, *numbers):
    """Return means and, by name, derivatives. how: `form` and `devices`."""
    kept = kept_of(scene, wanted.values())
    options = replace(options, derivative=True, by_vertex=True)
    image, rows = backward.rows(scene, pixels, *numbers, kept=kept, options=options, ring=ring, **how)
    places = tuple((name, Place.of(scene, kept.of(scene, each), each)) for name, each in wanted.items())
    return image, RowSlopes(rows, places, (len(image),))


@partial(_swept.defjvp, symbolic_zeros=True)
@standard_promotion
def _swept_jvp(wanted, options, ring, how, primals, changes):
    """Second derivatives: a sweep has none of its own, so they are those of the same Jacobian made by tangents."""
    tangents.refuse_textures(wanted)
    scene, *work = primals
    leaves, tree = jax.tree.flatten(scene)
    changes = jax.tree.leaves(changes[0], is_leaf=is_symbolic_zero)
    moved = [k for k, change in enumerate(changes) if not is_symbolic_zero(change)]
    held = Wanted(tangents.places(wanted.values()), ())

    def of(moving):
        at_place = dict(enumerate(leaves)) | dict(zip(moved, moving, strict=True))
        scene = tree.unflatten(at_place.values())
        steps = ior_step.steps(scene, (), None)
        image, slopes, *_ = _jacobians(scene, *work, steps, wanted=held, options=options, **how)
        return image, slopes

    image, slopes = _swept(wanted, options, ring, how, scene, *work)
    _, (moves, by_color) = jax.jvp(of, ([leaves[k] for k in moved],), ([changes[k] for k in moved],))
    number_of = {place.rows.start: k for k, (_, place) in enumerate(slopes.places)}
    nothing = jnp.zeros_like(by_color[:, 0])
    rows = [by_color[:, number_of[row]] if row in number_of else nothing for row in range(slopes.rows.count)]
    rows = jnp.stack(rows)
    rows = jnp.pad(rows, [(0, 0), (0, 0), (0, totals.WIDTH - 3)])
    return (image, slopes), (moves, replace(slopes, rows=slopes.rows.like(rows)))


def choosing_by_present_iors(scene: Scene, rows: tuple[int, ...]) -> Scene:
    """Return the scene in which some dielectrics have branch probabilities at their present IOR, detached."""
    table = ior.table(scene)
    ratio = lax.stop_gradient(dielectric.relative_ior(table))
    chosen = jnp.isin(jnp.arange(len(ratio)), jnp.asarray(rows, jnp.int32))
    return ior.with_table(scene, dielectric.choosing_by(table, ratio, chosen))


@partial(jax.jit, static_argnames=("wanted", "options", "form", "devices"))
def _jacobians(scene, pixels, first_sample, spp, seed, steps, *, wanted, options, form=None, devices=None):
    scene = options.applied(scene)
    choice = emitters.choice(scene.emitters, options.strategy)
    options = replace(options, derivative=bool(wanted.colors), watch_moving=bool(wanted.glass))
    one_pixel = partial(_pixel_jacobian, wanted=wanted, options=options)
    work = pixels, first_sample, spp, seed
    shared = scene, choice, tangents.unit_tangents(scene, wanted.colors), steps
    return map_pixels(one_pixel, work, *shared, options=options, form=form, devices=devices)


def _pixel_jacobian(work: pixel.Work, scene, choice, unit_tangents, steps, wanted: Wanted, options: Options):
    """Return means of a pixel: radiance (3,), tangents (T, 3), differences (G, 3) and their biases (G, 3)."""

    def of(scene):
        if wanted.glass:
            return ior_difference.mean_and_differences(work, scene, choice, steps, wanted.glass, options)
        none = jnp.zeros((0, 3), scene.camera.origin.dtype)
        return pixel.mean(work, scene, choice, options=options), (none, none)

    mean, by_color, differences = tangents.by_tangent(of, scene, wanted.colors, unit_tangents)
    return mean, by_color, *differences
