"""Image and Jacobian: how every pixel changes with the parameters of materials and lights.

Colours (reflectances, radiances, a metal's eta and k) change what paths carry, not where they go: the derivative is
that of the weights (detached sampling), unbiased. Light does not change its channel on the way, so one tangent stands
for the three channels of a colour.

The IOR of smooth glass moves the path itself, and what is seen through glass has edges, which no derivative of a moving
point knows. So it is a central difference of two paths that share all random numbers and the probabilities of their
choices. Its bias falls with the square of the step and is estimated beside it. No general derivative exists here for
moving geometry or cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from pathjax import emitters
from pathjax.bsdfs import dielectric
from pathjax.compile.runtime import native_map, usual_promotion
from pathjax.core import sampler
from pathjax.core.math import at
from pathjax.derivatives import ior_step
from pathjax.derivatives.ior_step import dielectrics
from pathjax.errors import InputError
from pathjax.integrators import path, pixel
from pathjax.kinds import Table
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene
from pathjax.sensors import film

METHODS = ("difference", "attached")
# One path in so many is also traced at twice the step, to estimate the bias.
RICHARDSON_EVERY = 16
# Dielectrics of one kernel: the four shifts of each are bits of an int32.
MOST_GLASS = 7


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Jacobian(Mapping):
    """Derivatives of an image by the names of parameters: `J[name]` is (H, W, 3, *shape of the parameter).

    bias: for derivatives that are differences, an estimate (H, W, 3) of derivative minus truth from a second step. It
        is noisy in a single pixel, and meant for averages.
    step: for the same, the change of the relative IOR to either side.
    """

    derivatives: dict[str, jax.Array]
    bias: dict[str, jax.Array]
    step: dict[str, jax.Array]

    def __getitem__(self, name):
        return self.derivatives[name]

    def __iter__(self):
        return iter(self.derivatives)

    def __len__(self):
        return len(self.derivatives)


@dataclass(frozen=True)
class Wanted:
    """What the kernel differentiates; static."""

    colors: tuple[tuple[tuple, tuple], ...]  # path and index of each entry that gets a tangent
    glass: tuple[int, ...]  # rows of the dielectrics that get a difference


@usual_promotion
def jacobian(scene: Scene, names, spp: int = 64, seed: int = 0, *, strategy="mis", method="difference", step=None):
    """Render an image and its derivatives in named parameters, from the same paths, in one kernel.

    Pure. It may be called inside `jax.jit`, and under `jax.vmap` over scenes that differ in parameters or cameras.

    Args:
        names: of parameters, as `parameters` lists them.
        spp: samples per pixel.
        seed: of `render`, whose image is the same, to rounding.
        strategy: of `render`.
        method: how the IOR of smooth glass is differentiated: "difference" (central, common random numbers), or
            "attached", which follows points that move and is right only where no edge is seen through glass. With
            "attached" the image chooses its branches in another way than `render`, without bias.
        step: of differences, in relative IOR; None: one that moves the image by about a third of a pixel.
    Returns:
        The image (H, W, 3), and a Jacobian.
    Raises:
        InputError: a name, the method or the strategy is unknown; spp, seed or step is out of range.
    """
    if isinstance(names, str):
        raise InputError(f"names is a list of names; write [{names!r}]")
    if method not in METHODS:
        raise InputError(f"method {method!r} is unknown; use one of {', '.join(METHODS)}")
    if step is not None and not isinstance(step, jax.core.Tracer) and not 0 < step < 1:
        raise InputError(f"step = {step}; it must lie between 0 and 1, in units of relative IOR")
    path.check_sampling(strategy, spp, seed)
    wanted = {name: named.find(scene, name) for name in names}
    pixels = jnp.arange(film.pixel_count(scene.film), dtype=jnp.int32)
    image, derivatives, bias, used = pixel_jacobians(
        scene, wanted, pixels, 0, spp, seed, strategy=strategy, method=method, step=step
    )
    shape = (*film.image_shape(scene.film), 3)

    def as_image(x):
        return x.reshape(*shape, *x.shape[2:])

    return as_image(image), Jacobian(*jax.tree.map(as_image, (derivatives, bias)), used)


@usual_promotion
def pixel_jacobians(
    scene: Scene, wanted: dict[str, Parameter], pixels, first_sample, spp, seed, *, strategy, method, step, **how
):
    """Means (N, 3), and by name: derivatives (N, 3, *shape), biases (N, 3), steps ().

    first_sample, spp, seed: each one number, or (N,) of the pixels.
    how: `form` and `devices` of `runtime.native_map`.
    """
    attached = method == "attached"
    colors = [name for name, p in wanted.items() if attached or not is_glass(p)]
    rows = sorted({p.index[0] for p in wanted.values() if is_glass(p)})
    glass = () if attached else tuple(rows)
    scene = replace(scene, about=None)
    if rows:
        scene = _differentiated_once(scene)
    if attached and rows:
        scene = _choosing_by(scene, rows)
    steps = ior_step.steps(scene, glass, step)
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    places = tuple((wanted[name].path, wanted[name].index) for name in colors)

    def of(places, first):
        static = Wanted(places, glass[first : first + MOST_GLASS])
        some = steps[first : first + MOST_GLASS]
        return _jacobians(scene, pixels, *numbers, some, wanted=static, strategy=strategy, **how)

    image, by_color, *by_glass = of(places, 0)
    more = [of((), first)[2:] for first in range(MOST_GLASS, len(glass), MOST_GLASS)]
    by_ior, bias = (jnp.concatenate(parts, axis=1) for parts in zip(by_glass, *more, strict=True))

    derivatives, biases, used = {}, {}, {}
    for name, parameter in wanted.items():
        if name in colors:
            d = by_color[:, colors.index(name)]
            # Light keeps its channel, so the derivative in a colour is diagonal.
            derivatives[name] = d[..., None] * jnp.eye(3, dtype=d.dtype) if parameter.shape else d
        else:
            place = glass.index(parameter.index[0])
            scale = ratio_by(scene, parameter)
            derivatives[name], biases[name] = by_ior[:, place] * scale, bias[:, place] * scale
            used[name] = steps[place]
    return image, derivatives, biases, used


@jax.custom_jvp
def _differentiated_once(scene):
    return scene


@partial(_differentiated_once.defjvp, symbolic_zeros=True)
def _refuse(primals, tangents):
    raise InputError("second derivatives are not supported where the IOR of smooth glass is differentiated")


def is_glass(parameter: Parameter) -> bool:
    return parameter.moves_paths


def ior_at(scene: Scene, name: str, ratio):
    """Value () of the parameter `name`, an IOR, at which int_ior / ext_ior of its glass is `ratio`."""
    parameter = named.find(scene, name)
    _, table = dielectrics(scene)
    row = parameter.index[0]
    return dielectric.ior_at(table, row, parameter.field, ratio)


def _with_dielectrics(scene: Scene, table: Table) -> Scene:
    return named.put(scene, ("materials", "tables", dielectrics(scene)[0]), table)


def _choosing_by(scene: Scene, rows) -> Scene:
    """The scene whose dielectrics of some rows choose their branches by the IOR that they have now."""
    _, table = dielectrics(scene)
    rows = jnp.asarray(rows, jnp.int32)
    ratio = lax.stop_gradient(dielectric.relative_ior(table))
    return _with_dielectrics(scene, table.with_column("choose_by", jnp.zeros_like(ratio).at[rows].set(ratio[rows])))


def ratio_by(scene: Scene, parameter: Parameter):
    """Derivative of the relative IOR int_ior / ext_ior in one of the two."""
    _, table = dielectrics(scene)
    row = parameter.index[0]
    return dielectric.relative_ior_by(table, row, parameter.field)


@partial(jax.jit, static_argnames=("wanted", "strategy", "form", "devices"))
def _jacobians(scene, pixels, first_sample, spp, seed, steps, *, wanted, strategy, form=None, devices=None):
    choice = emitters.choice(scene.emitters, strategy)
    one_pixel = partial(_pixel_jacobian, wanted=wanted, strategy=strategy)
    work = pixels, first_sample, spp, seed
    shared = scene, choice, unit_tangents(scene, wanted.colors), steps
    return native_map(one_pixel, work, *shared, form=form, devices=devices)


def _tables(colors):
    """Paths of the tables that hold the entries, each once."""
    return list(dict.fromkeys(table_path for table_path, _ in colors))


def unit_tangents(scene, colors):
    """A unit change of all channels of each entry: for every table (entries, *shape of the table)."""
    tangents = []
    for table_path in _tables(colors):
        table = named.get(scene, table_path)
        tangent = jnp.zeros((len(colors), *table.shape), table.dtype)
        for place, (its_path, index) in enumerate(colors):
            if its_path == table_path:
                tangent = tangent.at[(place, *index)].set(1)
        tangents.append(tangent)
    return tangents


def _pixel_jacobian(work, scene, choice, tangents, steps, wanted, strategy):
    """Means of a pixel: radiance (3,), tangents (T, 3), differences (G, 3) and their biases (G, 3).

    work: the pixel () int32, and its `pixel.numbers`.
    """
    derivative = bool(wanted.colors)

    def of(scene):
        if not wanted.glass:
            none = jnp.zeros((0, 3), scene.camera.origin.dtype)
            return pixel.mean(work, scene, choice, strategy=strategy, derivative=derivative), (none, none)
        return _mean_and_differences(work, scene, choice, steps, wanted.glass, strategy, derivative)

    mean, by_color, differences = by_tangent(of, scene, wanted.colors, tangents)
    return mean, by_color, *differences


def by_tangent(of, scene, colors, tangents):
    """A value of the scene, its derivatives (T, *shape), and what comes with it: `of(scene)` is value and company.

    tangents: `unit_tangents` of the colors.
    """
    places = _tables(colors)
    tables = [named.get(scene, place) for place in places]

    def varied(tables):
        changed = scene
        for place, table in zip(places, tables, strict=True):
            changed = named.put(changed, place, table)
        return of(changed)

    def push(tangents):
        return jax.jvp(varied, (tables,), (tangents,), has_aux=True)

    if not colors:
        value, company = of(scene)
        return value, jnp.zeros((0, *value.shape), value.dtype), company
    return jax.vmap(push, out_axes=(None, 0, None))(tangents)


def _mean_and_differences(work, scene, choice, steps, rows, strategy, derivative):
    """Mean of a pixel (3,), and of its central differences in the IOR of some dielectrics (G, 3), with biases (G, 3).

    A sample is a path at the IORs of the scene, then four for each of the dielectrics that it met: at + h, - h, and now
    and then at + 2 h, - 2 h. A path that never met a glass is the same at every IOR of it.
    """
    pixel_number, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel_number)
    _, table = dielectrics(scene)
    ratios = dielectric.relative_ior(table)
    rows = jnp.asarray(rows, jnp.int32)
    shifts = jnp.arange(4 * len(rows), dtype=jnp.int32)  # dielectric 4 k, 4 k + 1, ...

    begin = partial(pixel.camera_path, scene, pixel_number, stream, watch_glass=True)

    def shifted(shift):
        """The scene at a shift, choosing its branches by the IORs that it has; as it is where shift < 0."""
        place, k = jnp.maximum(shift, 0) // 4, shift % 4
        row, h = at(rows, place), at(steps, place)
        moves = (jnp.arange(len(ratios)) == row) & (shift >= 0)
        change = jnp.where(k % 2 == 0, h, -h) * (1 + k // 2).astype(h.dtype)
        moved = dielectric.with_relative_ior(table, ratios + change, moves)
        return _with_dielectrics(scene, dielectric.choosing_by(moved, ratios, moves))

    def twice(number):
        return sampler.combine(stream, number) % RICHARDSON_EVERY == 0

    def step(state):
        number, shift, todo, now, weight, plus, sums = state
        now, weight = lax.cond(now.alive, lambda: (now, weight), lambda: begin(number))
        now, weight = lax.optimization_barrier((now, weight))
        u = path.bounce_numbers(scene, stream, number, now.depth)
        now = path.extend(shifted(shift), choice, now, u, strategy, derivative)

        def end():
            place, k = jnp.maximum(shift, 0) // 4, shift % 4
            value, place, k, again = lax.optimization_barrier((weight * now.L, place, k, twice(number)))
            # The sample itself, or the second of a pair, whose first was kept.
            mean, by_ior, bias = sums
            mean = pixel.add_compensated(mean, jnp.where(shift < 0, value, 0))
            width = 2 * at(steps, place) * (1 + k // 2).astype(value.dtype)
            quotient = lax.optimization_barrier((plus - value) / width)
            mine = ((jnp.arange(len(rows)) == place) & (shift >= 0) & (k % 2 == 1))[:, None]
            by_ior = pixel.add_compensated(by_ior, jnp.where(mine & (k == 1), quotient, 0))
            doubled = (RICHARDSON_EVERY / 3) * jnp.where(k == 1, -quotient, quotient)
            bias = pixel.add_compensated(bias, jnp.where(mine & again, doubled, 0))
            # Shifts of this sample that are still to do are the bits of `todo`.
            touched = (jnp.right_shift(now.glass, rows % 31) & 1) == 1
            touched = jnp.broadcast_to(touched[:, None], (len(rows), 4)).reshape(shifts.shape)  # for each shift
            wanted = touched & ((shifts % 4 < 2) | again)
            bits = jnp.sum(jnp.where(wanted, jnp.left_shift(jnp.int32(1), shifts), 0), dtype=jnp.int32)
            left = jnp.where(shift < 0, bits, todo)
            next_shift = jnp.where(left == 0, -1, lax.population_count(~left & (left - 1)))
            next_number = number + (left == 0).astype(number.dtype)
            return next_number, next_shift, left & (left - 1), now, weight, value, (mean, by_ior, bias)

        return lax.cond(now.alive, lambda: (number, shift, todo, now, weight, plus, sums), end)

    zero = jnp.zeros((3,), scene.camera.origin.dtype)
    zeros = jnp.zeros((len(rows), 3), zero.dtype)
    base = jnp.int32(-1)
    nothing = pixel.no_path(scene, watch_glass=True)
    start = first_sample, base, jnp.int32(0), *nothing, zero, tuple((z, z) for z in (zero, zeros, zeros))
    *_, sums = lax.while_loop(lambda state: state[0] != first_sample + spp, step, start)
    mean, by_ior, bias = (total / spp.astype(zero.dtype) for total, _ in sums)
    return mean, (by_ior, bias)
