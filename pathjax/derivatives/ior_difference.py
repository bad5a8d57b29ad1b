"""Derivatives in the IOR of smooth glass: central differences with common random numbers.

The IOR moves the path itself, and the derivative of a moving point misses the edges that are seen through glass. So a
pixel's paths are traced again with the IOR a step h higher and lower, with the same random numbers, and with branch
probabilities at the scene's own IOR, so that no choice flips by itself:

    (I(eta + h) - I(eta - h)) / (2 h) = dI/d(eta) + bias,        bias = h^2 I'''/6 + O(h^4)

A few paths at twice the step estimate the bias: (difference at 2 h - difference at h) / 3 (Richardson).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pathjax.bsdfs import dielectric
from pathjax.compile import compute_once, persistent_loop
from pathjax.core import sampler
from pathjax.core.math import at
from pathjax.derivatives import ior
from pathjax.emitters import Choice
from pathjax.integrators import path, pixel
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import bounce_numbers
from pathjax.scene.scene import Scene

# One path in this many is also traced at twice the step, to estimate the bias.
RICHARDSON_EVERY = 16
# Most dielectrics of one kernel: the four shifts of each are bits of an int32.
MOST_GLASS = 7


def mean_and_differences(
    work: pixel.Work,
    scene: Scene,
    choice: Choice | None,
    steps: Float[Array, " G"],
    rows: tuple[int, ...],
    options: Options,
) -> tuple[Float[Array, "3"], tuple[Float[Array, "G 3"], Float[Array, "G 3"]]]:
    """Return the mean of a pixel, its central differences in the IOR of G dielectrics, and their biases.

    A sample is a path at the scene's IORs, then more for each dielectric that it met: at + h and - h, and for one
    sample in RICHARDSON_EVERY at + 2 h and - 2 h. A path that never met a dielectric does not depend on its IOR.

    Args:
        steps: h, in relative IOR.
        rows: table rows of the dielectrics, at most MOST_GLASS.
        options: with `watch_moving`.
    """
    pixel_number, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel_number)
    table = ior.table(scene)
    ratios = dielectric.relative_ior(table)
    rows = jnp.asarray(rows, jnp.int32)
    shifts = jnp.arange(4 * len(rows), dtype=jnp.int32)  # four per dielectric: + h, - h, + 2 h, - 2 h

    def shifted(shift):
        """Return the scene at a shift, with branch probabilities at its own IORs; unshifted where shift < 0."""
        place, k = jnp.maximum(shift, 0) // 4, shift % 4
        row, h = at(rows, place), at(steps, place)
        moves = (jnp.arange(len(ratios)) == row) & (shift >= 0)
        change = jnp.where(k % 2 == 0, h, -h) * (1 + k // 2).astype(h.dtype)
        moved = dielectric.with_relative_ior(table, ratios + change, moves)
        return ior.with_table(scene, dielectric.choosing_by(moved, ratios, moves))

    def twice(number):
        return sampler.combine(stream, number) % RICHARDSON_EVERY == 0

    def step(state):
        number, shift, todo, now, weight, plus, sums = state
        now, weight = pixel.begun(scene, pixel_number, stream, number, now, weight, options)
        u = bounce_numbers(scene, stream, number, path.vertices(now))
        now = path.extend(shifted(shift), choice, now, u, options)

        def end():
            place, k = jnp.maximum(shift, 0) // 4, shift % 4
            value, place, k, again = compute_once((weight * now.L, place, k, twice(number)))
            # The path at the scene's IORs, or the second of a pair, with the value of the first in `plus`.
            mean, by_ior, bias = sums
            mean = pixel.add_compensated(mean, jnp.where(shift < 0, value, 0))
            width = 2 * at(steps, place) * (1 + k // 2).astype(value.dtype)
            quotient = compute_once((plus - value) / width)
            mine = ((jnp.arange(len(rows)) == place) & (shift >= 0) & (k % 2 == 1))[:, None]
            by_ior = pixel.add_compensated(by_ior, jnp.where(mine & (k == 1), quotient, 0))
            doubled = (RICHARDSON_EVERY / 3) * jnp.where(k == 1, -quotient, quotient)
            bias = pixel.add_compensated(bias, jnp.where(mine & again, doubled, 0))
            # The bits of `todo` are the shifts of this sample that remain.
            touched = (jnp.right_shift(now.moving, rows % 31) & 1) == 1
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
    nothing = pixel.no_path(scene, options)
    start = first_sample, base, jnp.int32(0), *nothing, zero, tuple((z, z) for z in (zero, zeros, zeros))
    *_, sums = persistent_loop(lambda state: state[0] != first_sample + spp, step, start)
    mean, by_ior, bias = (total / spp.astype(zero.dtype) for total, _ in sums)
    return mean, (by_ior, bias)
