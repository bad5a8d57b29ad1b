"""Images from samples that count in all pixels under the film's filter.

A sample of pixel q, at an offset d from its middle, weighs w_k = f(d_x - k_x) f(d_y - k_y) in pixel q + k. With n_q
samples of each pixel the image is

    I(p) = A(p) / W(p),    A(p) = sum_k 1/n_(p-k) sum_i w_ki L_i,    W the same without L.

So a constant stays constant, at borders too, where pixels around have no samples; and pixels with many samples weigh no
more than others. W does not depend on the scene, so I is linear in what is sampled, and derivatives go the same way.

Kernels know nothing of it: they give single samples of pixels that look through a box. The rest is sums of shifted
images, outside of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import prod

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt

from pathjax.compile import cuts, native_map, split_map
from pathjax.core import sampler
from pathjax.core.math import safe_divide
from pathjax.integrators.options import Options
from pathjax.integrators.pixel import add_compensated
from pathjax.integrators.random_numbers import camera_numbers
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.sensors.film import Film

# What `pixel.Work` is of one pixel, of each of N.
Works = tuple[Int[Array, " N"], UInt[Array, " N"], UInt[Array, " N"], UInt[Array, " N"]]
# Pixels in a row of `film.of_samples`, of R images: the first, and of each (R, n) first sample, spp, seed, and what a
# sample weighs, 1/n_q above.
Run = tuple[Int[Array, ""], UInt[Array, "R n"], UInt[Array, "R n"], UInt[Array, "R n"], Float[Array, "R n"]]

# Samples that a call of the kernel gives: so many that few lanes are idle at its end; of one pixel at most, since few
# may be asked for; and numbers of which they consist at most, where there are many derivatives.
_SAMPLES, _OF_PIXEL, _NUMBERS = 1 << 16, 16, 1 << 24


def map_pixels(
    of_pixel: Callable, work: Works, scene: Scene, *shared, options: Options, means: bool = True, **how
) -> object:
    """`native_map` of pixels; of a film that shares samples, the images that these make.

    Args:
        of_pixel: (`pixel.Work`, scene, *shared) -> pytree, the mean over samples of a pixel, or the sum.
        work: arrays (N,); where samples are shared `film.pixels` of one image or of some, one after another.
        means: whether it gives the mean. Of a film that shares samples, sums become means.
        how: `form` and `devices` of `native_map`.
    Returns:
        pytree of (N, ...); of a film that shares samples, without the pixels outside of its crop window.
    """
    if not options.shared:
        return _own_samples(of_pixel, work, scene, *shared, means=means, **how)
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct((), x.dtype), work)
    like = jax.eval_shape(of_pixel, one, _sampled(scene), *shared)
    of_samples = partial(native_map, of_pixel, **how)
    return images(of_samples, like, work, scene, *shared, options=options, devices=how.get("devices"))


def images(
    of_samples: Callable, like, work: Works, scene: Scene, *shared, options: Options, devices: int | None = None
) -> object:
    """What `map_pixels` gives of a film that shares samples. of_samples, like: of `sums`."""
    run = _whole(work, scene)
    totals, weights = sums(of_samples, like, run, scene, *shared, options=options, devices=devices)
    return jax.tree.map(lambda total: _images(scene.film, total, weights), totals)


def pulled(
    of_samples: Callable,
    zero: Float[Array, "..."],
    adjoint: Float[Array, "pixels 3"],
    work: Works,
    scene: Scene,
    *shared,
    options: Options,
    devices: int | None = None,
) -> Float[Array, "..."]:
    """The transpose of `images`: of their adjoint, the sum of what samples give of theirs.

    Args:
        of_samples: (adjoint (N, 3) of the values of samples, Works, scene, *shared) -> what is added up, like `zero`.
        work, options, devices: of `images`.
    """
    run = first_pixel, *_, scale = _whole(work, scene)
    through, channels = scene.film, adjoint.shape[-1]
    _, weights = sums(lambda *_: (), (), run, scene, options=options, devices=devices)
    like = jax.ShapeDtypeStruct((*weights.shape, channels), scale.dtype)
    (of_sums,) = jax.linear_transpose(partial(_images, through, weights=weights), like)(adjoint)
    count, of_block = _blocks(run, scene, channels, options)

    def add(number, total):
        work, there, u = of_block(number)
        of_values = gather_samples(through, first_pixel, u, jnp.where(there, scale, 0), of_sums)
        new = of_samples(of_values.reshape(-1, channels), work, _sampled(scene), *shared)
        return total + new

    return lax.fori_loop(0, count, add, zero)


def _whole(work: Works, scene: Scene) -> Run:
    """All pixels of an image or of some."""
    count = film.pixel_count(film.of_samples(scene.film))
    _, first_sample, spp, seed = (x.reshape(-1, count) for x in work)
    return jnp.int32(0), first_sample, spp, seed, 1 / jnp.maximum(spp, 1).astype(scene.camera.origin.dtype)


def _own_samples(of_pixel: Callable, work: Works, scene: Scene, *shared, means: bool, **how) -> object:
    """`map_pixels`, where no sample is shared. An accelerator takes some samples of a pixel at once."""
    pixels, first_sample, spp, seed = work
    parts = cuts(len(pixels), how.get("form"))
    if parts == 1:
        return native_map(of_pixel, work, scene, *shared, **how)
    k, each, more = jnp.arange(parts, dtype=spp.dtype)[:, None], spp // parts, spp % parts
    counts = each + (k < more).astype(spp.dtype)
    work = pixels, first_sample + each * k + jnp.minimum(k, more), counts, seed
    work = tuple(jnp.broadcast_to(x, counts.shape).ravel() for x in work)
    results = native_map(of_pixel, work, scene, *shared, **how)

    def joined(x):
        x = x.reshape(*counts.shape, *x.shape[1:])
        if not means:
            return x.sum(0)
        # A mean of no samples may be anything.
        share = (counts / jnp.maximum(spp, 1)).reshape(*counts.shape, *[1] * (x.ndim - 2)).astype(x.dtype)
        return jnp.where(share > 0, x * share, 0).sum(0)

    return jax.tree.map(joined, results)


def _images(
    through: Film, totals: Float[Array, "R m *rest"], weights: Float[Array, "R m"]
) -> Float[Array, "pixels ..."]:
    """A / W, of all pixels and the halo around them."""
    mean = safe_divide(totals, weights.reshape(*weights.shape, *[1] * (totals.ndim - 2)))
    edge = halo(through)
    mean = film.cropped(through, mean[:, edge : mean.shape[1] - edge])
    return mean.reshape(mean.shape[0] * mean.shape[1], *mean.shape[2:])


def halo(made: Film) -> int:
    """How many pixels before and after a run, row by row, its samples reach."""
    return made.reach * (film.of_samples(made).crop[2] + 1)


def sums(
    of_samples: Callable, like, run: Run, scene: Scene, *shared, options: Options, devices: int | None = None
) -> tuple[object, Float[Array, "R m"]]:
    """A and W of the samples of pixels in a row: pytree of (R, m, ...), (R, m), m = n + 2 `halo`, which begin before.

    Args:
        of_samples: (Works of N pixels with a sample each, or none; scene, *shared) -> pytree of (N, ...).
        like: that of one sample, shapes and dtypes.
        devices: of `native_map`.
    """
    first_pixel, _, spp, _, scale = run
    through = scene.film
    leaves, structure = jax.tree.flatten(like)
    sizes = [prod(leaf.shape) for leaf in leaves]
    channels, places = sum(sizes), np.cumsum(sizes, dtype=int)
    count, of_block = _blocks(run, scene, channels, options)

    def add(number, state):
        work, there, u = of_block(number)
        values = jax.tree.leaves(of_samples(work, _sampled(scene), *shared))
        none = jnp.zeros((*there.shape, 0), scale.dtype)  # where the weights alone are asked for
        values = jnp.concatenate([none, *(x.reshape(*there.shape, -1) for x in values)], -1)
        values = jnp.where(there[..., None], values, 0)
        spread = spread_samples(through, first_pixel, u, jnp.where(there, scale, 0), values, devices)
        return add_compensated(state, spread)

    zero = jnp.zeros((len(spp), channels + 1, spp.shape[1] + 2 * halo(through)), scale.dtype)
    total, _ = lax.fori_loop(0, count, add, (zero, zero))
    parts = jnp.split(jnp.moveaxis(total, 1, 2), places, axis=-1)
    parts = [part.reshape(*part.shape[:2], *leaf.shape) for part, leaf in zip(parts, leaves, strict=False)]
    return jax.tree.unflatten(structure, parts), total[:, -1]


def _sampled(scene: Scene) -> Scene:
    """The scene whose pixels look through a box."""
    return replace(scene, film=film.of_samples(scene.film))


def _blocks(run: Run, scene: Scene, channels: int, options: Options) -> tuple[Int[Array, ""], Callable]:
    """The number of calls of a kernel that all samples take, and what the call of a number is of.

    Args:
        channels: numbers that a sample consists of.
    Returns:
        count, and number -> `Works` of B samples of each pixel; (B, R, n) which of them are there; and their
        `film_numbers` (B, R, n, 2).
    """
    first_pixel, first_sample, spp, seed, _ = run
    pixels = first_pixel + jnp.arange(spp.shape[1], dtype=jnp.int32)
    block = max(min(_SAMPLES // spp.size, _NUMBERS // (spp.size * max(channels, 1)), _OF_PIXEL), 1)

    def of_block(number):
        done = jnp.uint32(block) * number.astype(jnp.uint32) + jnp.arange(block, dtype=jnp.uint32)
        done = done[:, None, None]
        numbers, there = first_sample + done, done < spp
        work = pixels, numbers, there.astype(jnp.uint32), seed
        work = tuple(jnp.broadcast_to(x, numbers.shape).ravel() for x in work)
        return work, there, film_numbers(_sampled(scene), pixels, numbers, seed, options.sampler)

    count = (jnp.max(spp) + jnp.uint32(block - 1)) // jnp.uint32(block)
    return count.astype(jnp.int32), of_block


def film_numbers(
    sampled: Scene,
    pixels: Int[Array, "#*shape"],
    numbers: UInt[Array, "*shape"],
    seed: UInt[Array, "#*shape"],
    points: str = "lattice",
) -> Float[Array, "*shape 2"]:
    """Where in their pixels the samples lie that have these numbers."""

    def one(stream, number):
        return camera_numbers(sampled, stream, number, points)[0]

    seed, pixels = jnp.broadcast_arrays(seed, pixels)
    streams = jax.vmap(sampler.pixel_stream)(seed.ravel(), pixels.ravel()).reshape(seed.shape)
    streams = jnp.broadcast_to(streams, numbers.shape)
    return jax.vmap(one)(streams.ravel(), numbers.ravel()).reshape(*numbers.shape, 2)


def spread_samples(
    through: Film,
    first_pixel: Int[Array, ""],
    u: Float[Array, "B R n 2"],
    scale: Float[Array, "B R n"],
    values: Float[Array, "B R n C"],
    devices: int | None = None,
) -> Float[Array, "R C+1 m"]:
    """Sums as `sums` gives them, the weights last, of B samples of each pixel; linear in the values."""
    edge = halo(through)
    ones = jnp.ones_like(scale)[..., None]
    weighted = jnp.concatenate([values, ones], -1) * scale[..., None]
    # Columns are pixels: those around the run, and what the last device has too many, have no samples.
    spare = 2 * edge + len(jax.devices())
    ends = (0, 0), (0, 0), (0, 0), (2 * edge, spare)
    u, weighted = (jnp.pad(jnp.moveaxis(x, -1, 2), ends) for x in (u, weighted))

    def of_run(first, size, there, u, weighted):
        def window(x):
            return lax.dynamic_slice_in_dim(x, first, size + 2 * edge, axis=-1)

        x = first_pixel - 2 * edge + first + jnp.arange(size + 2 * edge)
        spread = jax.vmap(partial(_spread, through, x))

        def add(total, sample):
            present, *sample = sample
            return lax.cond(present, lambda: total + spread(*sample), lambda: total), None

        total = jnp.zeros((*weighted.shape[1:3], size), weighted.dtype)
        return lax.scan(add, total, (there, window(u), window(weighted)))[0]

    there = (scale != 0).any((1, 2))
    return split_map(of_run, values.shape[2] + 2 * edge, there, u, weighted, devices=devices)


def _spread(
    through: Film, pixels: Int[Array, " n"], u: Float[Array, "2 n"], weighted: Float[Array, "C n"]
) -> Float[Array, "C m"]:
    """One sample of each of n pixels in a row, spread; m = n - 2 `halo`, so that all that reach a pixel are there."""
    edge, total = halo(through), 0
    by_x, by_y, weighted = lax.optimization_barrier((*_weights(through, pixels, u), weighted))
    for b, a, step in _steps(through):
        here = np.s_[..., edge - step : len(pixels) - edge - step]
        weight = by_x[a][here] * by_y[b][here]
        # What is not finite spoils no pixel in which it does not count.
        total = total + jnp.where(weight != 0, weight * weighted[here], 0)
    return total


def _weights(
    through: Film, pixels: Int[Array, " n"], u: Float[Array, "2 n"]
) -> tuple[Float[Array, "S n"], Float[Array, "S n"]]:
    """The two factors of what samples weigh in pixels -reach, ..., reach away."""
    width = film.of_samples(through).crop[2]
    steps = jnp.arange(-through.reach, through.reach + 1)[:, None]
    by_x, by_y = (through.filter.evaluate(u[axis] - 0.5 - steps.astype(u.dtype)) for axis in (0, 1))
    # What lies beyond a row's ends is in no pixel.
    x = pixels % width + steps
    return jnp.where((x >= 0) & (x < width), by_x, 0), by_y


def _steps(through: Film) -> list[tuple[int, int, int]]:
    """Of all pixels around one, the numbers of their factors of `_weights` in y and x, and how far on they are."""
    reach, width = through.reach, film.of_samples(through).crop[2]
    around = range(2 * reach + 1)
    return [(b, a, (b - reach) * width + a - reach) for b in around for a in around]


def gather_samples(
    through: Film,
    first_pixel: Int[Array, ""],
    u: Float[Array, "B R n 2"],
    scale: Float[Array, "B R n"],
    of_sums: Float[Array, "R m C"],
) -> Float[Array, "B R n C"]:
    """The transpose of `spread_samples` but for the weights: of the adjoint of sums, that of the values of samples."""
    edge, count = halo(through), u.shape[2]
    pixels, adjoint = first_pixel + jnp.arange(count), jnp.moveaxis(of_sums, -1, 1)

    def gather(u, scale, around):
        by_x, by_y, around = lax.optimization_barrier((*_weights(through, pixels, u), around))
        total = 0
        for b, a, step in _steps(through):
            weight = by_x[a] * by_y[b]
            total = total + jnp.where(weight != 0, weight * around[:, edge + step : edge + step + count], 0)
        return scale * total

    # On one device: XLA of jax 0.7 aborts where the columns are dealt to some.
    found = lax.map(lambda sample: jax.vmap(gather)(*sample, adjoint), (jnp.moveaxis(u, -1, 2), scale))
    return jnp.moveaxis(found, 2, -1)


def image_of_samples(
    through: Film, u: Float[Array, "B N 2"], values: Float[Array, "B N C"]
) -> Float[Array, "pixels C"]:
    """The image that B samples of each of all pixels make, `film_numbers` u; linear in their values."""
    total = spread_samples(through, jnp.int32(0), u[:, None], jnp.ones_like(u[:, None, :, 0]), values[:, None])
    return _images(through, jnp.moveaxis(total[:, :-1], 1, 2), total[:, -1])
