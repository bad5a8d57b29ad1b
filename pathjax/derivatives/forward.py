"""J v by forward mode on the records of `record`: about the cost of one image, whatever the number of parameters.

The change b of a path's throughput with v is carried along from vertex to vertex:

    dI = sum_k  b_k (Le_k + n_k) + beta_k (dLe_k + dn_k) v,        b_{k+1} = b_k w_k + beta_k dw_k v,        b_0 = 0

in the notation of `record`. A vertex looks up the entries of v that it needs as it looks up the parameters themselves.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax import emitters
from pathjax.compile import compute_once, persistent_loop
from pathjax.core import sampler
from pathjax.core.math import at, luminance
from pathjax.derivatives import differentiated
from pathjax.derivatives.kept import Kept
from pathjax.derivatives.record import Record, extend
from pathjax.derivatives.totals import NEAR
from pathjax.emitters import Choice
from pathjax.integrators import path, pixel
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import bounce_numbers
from pathjax.integrators.reconstruction import map_pixels
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Scalars in a row that holds a texel and its change: a power of 2, so that the row lies in one cache line.
WIDTH = 8


def changes(
    record: Record, v: Float[Array, "M numbers"], kept: Kept
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return the changes of Le + n and of w at a vertex with v.

    v: changes of the kept entries: the last three scalars of each row.
    """
    now = later = jnp.zeros_like(record.weight)
    for slot in record.slots:
        shares = slot.shares or (1,)
        change = sum(share * at(v, kept.place(place))[-3:] for place, share in zip(slot.places, shares, strict=True))
        # Else both of its consumers would read it from far memory.
        change = compute_once(luminance(change) if slot.by_luminance else change)
        now = now + slot.now * change
        if slot.later is not None:
            later = later + slot.later * change
    return now, later


def pixel_change(
    work: pixel.Work,
    scene: Scene,
    choice: Choice | None,
    v: Float[Array, "M 3"] | None,
    *,
    options: Options,
    slots: differentiated.Slots,
    kept: Kept,
) -> Float[Array, "3"]:
    """Return the change of a pixel's mean with v. v: None if it stands `beside` the one differentiated array."""
    pixel_number, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel_number)
    v = named.get(scene, kept.paths[0]) if v is None else v
    zero = jnp.zeros((3,), scene.camera.origin.dtype)

    def step(state):
        number, passed, now, weight, b, sums = state
        b = jnp.where(now.alive, b, 0)
        now, weight = pixel.begun(scene, pixel_number, stream, number, now, weight, options)
        u = bounce_numbers(scene, stream, number, path.vertices(now), options.sampler, bool(slots.grids))
        on, record, itself = extend(scene, choice, now, u, options, slots, kept.paths, jnp.ones_like(zero), passed)
        gain, later = changes(record, v, kept)
        sums = pixel.add_compensated(sums, compute_once(weight * (b * record.gathered + gain)))
        b = b * record.weight + later
        if slots.of_passed:
            passed, on = jnp.where(itself, 0, passed + 1), jax.tree.map(partial(jnp.where, itself), on, now)
        return number + jnp.where(on.alive, 0, 1).astype(number.dtype), passed, on, weight, b, sums

    state = first_sample, jnp.int32(0), *pixel.no_path(scene, options), zero, (zero, zero)
    *_, (total, _) = persistent_loop(lambda state: state[0] != first_sample + spp, step, state)
    return total / jnp.maximum(spp, 1).astype(total.dtype)


def beside(array: Float[Array, "M 3"], v: Float[Array, "M 3"]) -> Float[Array, "M numbers"]:
    """Return texels with their changes in the same rows, since reads from far memory, here one, dominate J v."""
    return jnp.concatenate([array, jnp.zeros((len(array), WIDTH - 6), array.dtype), v], 1)


@partial(jax.jit, static_argnames=("kept", "options", "form", "devices"))
def push(
    scene: Scene,
    v: Float[Array, "entries 3"],
    pixels,
    first_sample,
    spp,
    seed,
    *,
    kept: Kept,
    options: Options,
    form=None,
    devices=None,
) -> Float[Array, "N 3"]:
    """Return J v for the means of pixels.

    Args:
        scene: without names.
        v: changes of the kept entries.
        pixels, first_sample, spp, seed: (N,) each.
        kept: entries of arrays in `differentiated.paths`.
        form, devices: as for `native_map`.
    """
    scene = options.applied(scene)
    choice = emitters.choice(scene.emitters, options.strategy)
    slots, paths = differentiated.slots(scene, kept.paths, kept.fields), kept.paths
    far = v.size * v.dtype.itemsize > NEAR
    if far and kept.all and len(paths) == 1 and differentiated.may_be_wider(scene, paths[0]):
        scene, v = named.put(scene, paths[0], beside(named.get(scene, paths[0]), v)), None
    of_pixel = partial(pixel_change, options=options, slots=slots, kept=kept)
    work = pixels, first_sample, spp, seed
    return map_pixels(of_pixel, work, scene, choice, v, options=options, form=form, devices=devices)
