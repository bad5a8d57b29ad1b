"""Reconstruct images from samples that count in all pixels under the film's filter.

A sample of pixel q, at an offset d from its middle, weighs w_k = f(d_x - k_x) f(d_y - k_y) in pixel q + k. With n_q
samples of each pixel the image is

    I(p) = A(p) / W(p),    A(p) = sum_k 1/n_(p-k) sum_i w_ki L_i,    W the same without L.

So a constant stays constant, also at borders, where some neighbours have no samples; and pixels with many samples weigh
no more than others. W does not depend on the scene, so I is linear in the samples, and derivatives are reconstructed in
the same way.

Kernels do not know about the filter: they return single samples of box-filtered pixels. The reconstruction is sums of
shifted images, outside the kernels.
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

from pathjax.compile import native_map, parts_per_item, split_map
from pathjax.core import sampler
from pathjax.core.math import safe_divide
from pathjax.integrators.options import Options
from pathjax.integrators.pixel import add_compensated
from pathjax.integrators.random_numbers import camera_numbers
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.sensors.film import Film

# `pixel.Work` of N pixels.
Works = tuple[Int[Array, " N"], UInt[Array, " N"], UInt[Array, " N"], UInt[Array, " N"]]
# A run of n pixels in the order of `film.of_samples`, of R images: the first pixel, and per pixel (R, n) the first
# sample, spp, seed, and the weight of a sample, 1/n_q above.
Run = tuple[Int[Array, ""], UInt[Array, "R n"], UInt[Array, "R n"], UInt[Array, "R n"], Float[Array, "R n"]]

# Samples per kernel call, enough that few lanes are idle at its end; most samples of one pixel in a call, since spp may
# be small; and most scalars in all samples of a call, which limits it where there are many derivatives.
_SAMPLES, _OF_PIXEL, _NUMBERS = 1 << 16, 16, 1 << 24


def map_pixels(
    of_pixel: Callable, work: Works, scene: Scene, *shared, options: Options, means: bool = True, **how
) -> object:
    """Map `of_pixel` over pixels by `native_map`; for a film that shares samples, reconstruct the images.

    Args:
        of_pixel: (`pixel.Work`, scene, *shared) -> pytree, the mean over samples of a pixel, or the sum.
        work: arrays (N,); where samples are shared, `film.pixels` of one or more images, one after another.
        means: whether `of_pixel` returns the mean. For a film that shares samples, sums become means.
        how: `form` and `devices` of `native_map`.
    Returns:
        pytree of (N, ...); for a film that shares samples, without the pixels outside its crop window.
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
    """Do `map_pixels` for a film that shares samples. of_samples, like: as for `sums`."""
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
    """Apply the transpose of `images`: pull the adjoint of the images back to samples and sum `of_samples` over them.

    Args:
        of_samples: (adjoint (N, 3) of the samples' values, Works, scene, *shared) -> summand, like `zero`.
        work, options, devices: as for `images`.
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
    """Return the run of all pixels of one or more images."""
    count = film.pixel_count(film.of_samples(scene.film))
    _, first_sample, spp, seed = (x.reshape(-1, count) for x in work)
    return jnp.int32(0), first_sample, spp, seed, 1 / jnp.maximum(spp, 1).astype(scene.camera.origin.dtype)


def _own_samples(of_pixel: Callable, work: Works, scene: Scene, *shared, means: bool, **how) -> object:
    """Do `map_pixels` where no sample is shared. Accelerators take parts of a pixel's samples in parallel."""
    pixels, first_sample, spp, seed = work
    parts = parts_per_item(len(pixels), how.get("form"))
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
        # The mean of no samples is arbitrary, perhaps NaN.
        share = (counts / jnp.maximum(spp, 1)).reshape(*counts.shape, *[1] * (x.ndim - 2)).astype(x.dtype)
        return jnp.where(share > 0, x * share, 0).sum(0)

    return jax.tree.map(joined, results)


def _images(
    through: Film, totals: Float[Array, "R m *rest"], weights: Float[Array, "R m"]
) -> Float[Array, "pixels ..."]:
    """Return A / W for the pixels of the crop window. totals, weights: of all pixels and the halo around them."""
    mean = safe_divide(totals, weights.reshape(*weights.shape, *[1] * (totals.ndim - 2)))
    edge = halo(through)
    mean = film.cropped(through, mean[:, edge : mean.shape[1] - edge])
    return mean.reshape(mean.shape[0] * mean.shape[1], *mean.shape[2:])


def halo(made: Film) -> int:
    """Return how many pixels, counted row by row, the samples of a run reach before and after it."""
    return made.reach * (film.of_samples(made).crop[2] + 1)


def sums(
    of_samples: Callable, like, run: Run, scene: Scene, *shared, options: Options, devices: int | None = None
) -> tuple[object, Float[Array, "R m"]]:
    """Return A and W of the samples of a run and its halo: pytree of (R, m, ...), (R, m), m = n + 2 `halo`.

    Args:
        of_samples: (Works of N pixels with one sample or none each, scene, *shared) -> pytree of (N, ...).
        like: pytree of one sample: shapes and dtypes.
        devices: as for `native_map`.
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
        none = jnp.zeros((*there.shape, 0), scale.dtype)  # `like` may be empty, for the weights alone
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
    """Return the scene with box-filtered pixels."""
    return replace(scene, film=film.of_samples(scene.film))


def _blocks(run: Run, scene: Scene, channels: int, options: Options) -> tuple[Int[Array, ""], Callable]:
    """Return the number of kernel calls for all samples, and a function that gives the samples of each call.

    Args:
        channels: scalars per sample.
    Returns:
        count, and index of a call -> `Works` of B samples of each pixel; (B, R, n) mask of those that exist; and their
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
    """Return the positions within their pixels of the samples with these numbers."""

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
    """Return the sums of `sums`, the weights last, for B samples of each pixel; linear in the values."""
    edge = halo(through)
    ones = jnp.ones_like(scale)[..., None]
    weighted = jnp.concatenate([values, ones], -1) * scale[..., None]
    # Columns are pixels. Those around the run, and the excess of the last device, have no samples.
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
    """Spread one sample of each pixel of a run of n to m = n - 2 `halo` pixels, whose contributions are complete."""
    edge, total = halo(through), 0
    by_x, by_y, weighted = lax.optimization_barrier((*_weights(through, pixels, u), weighted))
    for b, a, step in _steps(through):
        here = np.s_[..., edge - step : len(pixels) - edge - step]
        weight = by_x[a][here] * by_y[b][here]
        # A non-finite sample must not spoil pixels in which its weight is 0.
        total = total + jnp.where(weight != 0, weight * weighted[here], 0)
    return total


def _weights(
    through: Film, pixels: Int[Array, " n"], u: Float[Array, "2 n"]
) -> tuple[Float[Array, "S n"], Float[Array, "S n"]]:
    """Return the factors, by x and by y, of the samples' weights in pixels -reach, ..., reach away."""
    width = film.of_samples(through).crop[2]
    steps = jnp.arange(-through.reach, through.reach + 1)[:, None]
    by_x, by_y = (through.filter.evaluate(u[axis] - 0.5 - steps.astype(u.dtype)) for axis in (0, 1))
    # Beyond the ends of a row there are no pixels.
    x = pixels % width + steps
    return jnp.where((x >= 0) & (x < width), by_x, 0), by_y


def _steps(through: Film) -> list[tuple[int, int, int]]:
    """Return, per pixel around one, the indices of its factors of `_weights` in y and x, and its offset in the run."""
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
    """Apply the transpose of `spread_samples` without the weights: adjoint of the sums to adjoint of the values."""
    edge, count = halo(through), u.shape[2]
    pixels, adjoint = first_pixel + jnp.arange(count), jnp.moveaxis(of_sums, -1, 1)

    def gather(u, scale, around):
        by_x, by_y, around = lax.optimization_barrier((*_weights(through, pixels, u), around))
        total = 0
        for b, a, step in _steps(through):
            weight = by_x[a] * by_y[b]
            total = total + jnp.where(weight != 0, weight * around[:, edge + step : edge + step + count], 0)
        return scale * total

    # On one device: XLA of jax 0.7 aborts where the columns are distributed over several.
    found = lax.map(lambda sample: jax.vmap(gather)(*sample, adjoint), (jnp.moveaxis(u, -1, 2), scale))
    return jnp.moveaxis(found, 2, -1)


def image_of_samples(
    through: Film, u: Float[Array, "B N 2"], values: Float[Array, "B N C"]
) -> Float[Array, "pixels C"]:
    """Return the image of B samples of every pixel, with `film_numbers` u; linear in their values."""
    total = spread_samples(through, jnp.int32(0), u[:, None], jnp.ones_like(u[:, None, :, 0]), values[:, None])
    return _images(through, jnp.moveaxis(total[:, :-1], 1, 2), total[:, -1])
