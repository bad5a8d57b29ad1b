"""J^T v, and J in many numbers, at the price of about one image, whatever the number of parameters: a recorded sweep.

A path's derivative has entries at the parameters of the vertices that it meets, and nowhere else. So each vertex is
recorded as it is met (`record`, which has the equations), and when the path has ended its vertices are gone through
again, the last one first. Times the adjoint of the pixel these are added to a list of derivatives, at the entries that
the vertex looked up (`places`, `totals`): one list for all pixels, or, without an adjoint, one for each.

All lanes record at once, in one row of a ring of buffers, and are swept at once, every WINDOW trips: back from the last
end of a path that they have recorded to the first vertex of a path that was swept before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import bsdfs, emitters
from pathjax.compile import Rows, compute_once, is_traced, native_fold, native_rows, persistent_loop, together
from pathjax.compile.lanes import flags
from pathjax.core import sampler
from pathjax.core.math import LUMINANCE, luminance
from pathjax.derivatives import differentiated, totals
from pathjax.derivatives.kept import Kept
from pathjax.derivatives.record import Record, Slot, extend
from pathjax.derivatives.totals import Total
from pathjax.emitters import Choice
from pathjax.errors import InputError
from pathjax.integrators import path, pixel
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import bounce_numbers
from pathjax.integrators.reconstruction import images, pulled
from pathjax.scene.scene import Scene

# Trips between two sweeps, and those that the ring holds: powers of 2. Where the longest path is not known when a
# kernel is made, it is RING; a path of more than the difference is not recorded whole then, and makes derivatives NaN.
WINDOW, RING, MOST_RING = 32, 1024, 1 << 14
# Of paths that roulette may end, so many vertices later one in 1e20 is left.
ROULETTE = 900
# Bits of what a lane records.
BEGINS, ENDS, HOLDS = 1, 2, 4


def columns_of(record: Record) -> list:
    """Its numbers, one after another, the two flags in one."""
    bits = jnp.where(record.begins, BEGINS, 0) | jnp.where(record.ends, ENDS, 0)
    numbers = [x for leaf in jax.tree.leaves(record._replace(begins=None, ends=None)) for x in jnp.ravel(leaf)]
    return [bits, *numbers]


# ---- the memory that lanes share ------------------------------------------------------------------------------------


class Memory(NamedTuple):
    total: Total
    clock: Int[Array, ""]  # trips
    swept: Int[Array, ""]  # trips before the last sweep
    lost: Int[Array, ""]  # 1: a path was longer than the ring
    size: Int[Array, ""]  # trips that are used of the ring: few stay in near caches
    ring: list  # (trips, numbers, W) of each type: the numbers of Records; few arrays, as loops pay for each they carry


class Sweep(NamedTuple):
    """What goes back through the ring, of each lane."""

    back: Int[Array, ""]  # trips so far
    goes_on: Bool[Array, ""]
    complete: Int[Array, " W"]  # 1: has met the end of a path, so that it knows what arrives
    stopped: Int[Array, " W"]  # 1: all that is older has been swept before
    R: list[Float[Array, " W"]]
    total: Total


def start(scene: Scene, record: Record, entries: int, ring: int, lanes: int) -> Memory:
    """Before the first pixel.

    Args:
        record: of shapes and dtypes.
        ring: trips that it holds.
    Raises:
        InputError: too many.
    """
    if ring > MOST_RING:
        raise InputError(
            f"max_depth and rr_depth let paths have more than {MOST_RING - WINDOW} vertices, too many to be recorded "
            "for derivatives in many numbers; set a smaller max_depth or rr_depth"
        )
    total = totals.start(entries, lanes, scene.camera.origin.dtype)
    # No trip is read that was not written. On CPUs it is filled with zeros all the same, so it had better be short.
    types = [x.dtype for x in jax.eval_shape(columns_of, record)]
    buffers = [lax.empty((ring, types.count(dtype), lanes), dtype) for dtype in dict.fromkeys(types)]
    zero = jnp.int32(0)
    return Memory(total, zero, zero, zero, ring_size(scene, ring), buffers)


def longest_ring(scene: Scene) -> int:
    """Trips of a ring that holds the scene's longest path and a window; RING, where max_depth is not known yet."""
    depths = scene.max_depth, scene.rr_depth
    if any(map(is_traced, depths)):
        return RING
    most, unharmed = (int(np.asarray(depth).max()) for depth in depths)
    longest = min(most, unharmed + ROULETTE)
    if _passes(scene):
        longest = max(longest, ROULETTE)
    return 1 << (longest + WINDOW - 1).bit_length()


def _passes(scene: Scene) -> bool:
    """Whether paths meet what does not count into their depth, but has records too."""
    passes = scene.media is not None or bsdfs.occurs(scene.materials, "passes")
    return bool(passes or scene.free_passes or scene.hide_emitters)


def ring_size(scene: Scene, ring: int) -> Int[Array, ""]:
    """Power of 2 that holds the longest path and a window, as far as that is known; the ring's at most."""
    if _passes(scene):
        return jnp.int32(ring)
    sizes = [1 << k for k in range(ring.bit_length())]
    wanted = jnp.minimum(scene.max_depth, ring) + WINDOW
    return jnp.min(jnp.where(jnp.array(sizes) >= wanted, jnp.array(sizes), ring)).astype(jnp.int32)


def remember(structure: Record, memory: Memory, here: Bool[Array, " W"], columns: list) -> Memory:
    """Record a vertex of every lane; now and then, sweep."""
    bits, *numbers = columns
    # A lane without an item records nothing that is whole.
    columns = [jnp.where(here, bits | HOLDS, BEGINS | ENDS), *numbers]
    ring = _with_row(memory.ring, memory.clock & (memory.size - 1), columns)
    memory = memory._replace(clock=memory.clock + 1, ring=ring)
    return sweep(structure, memory, memory.clock - memory.swept >= WINDOW)


def _with_row(ring: list, row: Int[Array, ""], columns: list) -> list:
    """The ring with a trip's columns at a row, those of a type one after another."""
    new = []
    for buffer in ring:
        for k, x in enumerate([x for x in columns if x.dtype == buffer.dtype]):
            where = row, jnp.int32(k), jnp.int32(0)
            buffer = lax.dynamic_update_slice(buffer, x[None, None], where, allow_negative_indices=False)
        new.append(buffer)
    return new


def _row(ring: list, row: Int[Array, ""], types: list) -> list:
    """What `_with_row` put there, of columns of these types."""
    following = {}
    for buffer in ring:
        columns = lax.dynamic_index_in_dim(buffer, row, keepdims=False, allow_negative_indices=False)
        following[buffer.dtype] = iter([columns[k] for k in range(len(columns))])
    return [next(following[dtype]) for dtype in types]


def sweep(structure: Record, memory: Memory, due: Bool[Array, ""]) -> Memory:
    """Add what all paths give that have ended since the last sweep, if it is due."""
    window = jnp.where(due, memory.clock - memory.swept, 0)
    types = [x.dtype for x in jax.eval_shape(columns_of, structure)]

    def step(state: Sweep) -> Sweep:
        bits, *numbers = _row(memory.ring, (memory.clock - 1 - state.back) & (memory.size - 1), types)
        record = unflattened(structure, numbers)
        begins, ends, holds = (bits & bit != 0 for bit in (BEGINS, ENDS, HOLDS))
        complete = (state.complete != 0) | ends
        here = complete & (state.stopped == 0) & holds
        # What is not finite in one path stays out of the one before.
        R = [jnp.where(ends, 0, x) for x in state.R]
        total = state.total
        for slot in record.slots:
            change = slot.now
            if slot.later is not None:
                change = [a + b * x for a, b, x in zip(slot.now, slot.later, R, strict=True)]
            if slot.by_luminance:
                change = [sum(change) * share for share in LUMINANCE]
            total = totals.add(total, slot, [jnp.where(here, x, 0) for x in change])
        R = [n + w * x for n, w, x in zip(record.gathered, record.weight, R, strict=True)]
        back = state.back + 1
        stopped = (state.stopped != 0) | ((back >= window) & (begins | ~complete))
        goes_on = (back < window) | ((back < memory.size) & ~all_set(stopped))
        return Sweep(back, goes_on, complete.astype(jnp.int32), stopped.astype(jnp.int32), R, total)

    nothing = jnp.zeros((memory.ring[0].shape[-1],), jnp.int32)
    zeros = [jnp.zeros(nothing.shape, structure.weight.dtype)] * 3
    first = Sweep(jnp.int32(0), window > 0, nothing, nothing, zeros, memory.total)
    last = lax.while_loop(lambda state: state.goes_on, step, first)
    # At the end there may be nothing left to sweep.
    lost = memory.lost | jnp.where((window > 0) & ~all_set(last.stopped != 0), 1, 0)
    return memory._replace(total=last.total, swept=jnp.where(due, memory.clock, memory.swept), lost=lost)


def unflattened(structure: Record, numbers: list) -> Record:
    """The Record whose numbers these are, each vector as a list."""
    following = iter(numbers)

    def taken(leaf):
        return [next(following) for _ in range(leaf.size)] if leaf.shape else next(following)

    return jax.tree.map(taken, structure._replace(begins=None, ends=None))


def all_set(of_lanes: Bool[Array, " W"]) -> Bool[Array, ""]:
    return ~flags.any_set(flags.packed(~of_lanes))


# ---- pixels ---------------------------------------------------------------------------------------------------------


def pixel_sweep(
    work: pixel.Work,
    scene: Scene,
    choice: Choice | None,
    scale: Float[Array, "3"],
    of_slot: Callable,
    memory: Memory,
    *,
    options: Options,
    slots: differentiated.Slots,
    paths: differentiated.Paths,
    structure: Record,
) -> tuple[Float[Array, "3"], Memory]:
    """Add what the samples of a pixel give, and their mean.

    scale: of the derivatives of the mean; of_slot: Slots of the list of entries as those of the total.
    """
    pixel_number, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel_number)
    share = 1 / jnp.maximum(spp, 1).astype(scale.dtype)

    def step(state):
        number, passed, now, weight, sums, memory = state
        begins = ~now.alive
        now, weight = pixel.begun(scene, pixel_number, stream, number, now, weight, options)
        u = bounce_numbers(scene, stream, number, path.vertices(now), options.sampler, bool(slots.grids))
        of_sample = weight * (share * scale)
        on, record, itself = extend(scene, choice, now, u, options, slots, paths, of_sample, passed)
        record = record._replace(begins=begins, slots=list(map(of_slot, record.slots)))
        memory = together(partial(remember, structure))(memory, columns_of(record))
        gain = weight * now.throughput * record.gathered
        if slots.of_passed:
            passed, on = jnp.where(itself, 0, passed + 1), jax.tree.map(partial(jnp.where, itself), on, now)
        sums = pixel.add_compensated(sums, compute_once(gain))
        return number + jnp.where(on.alive, 0, 1).astype(number.dtype), passed, on, weight, sums, memory

    zero = jnp.zeros((3,), scale.dtype)
    state = first_sample, jnp.int32(0), *pixel.no_path(scene, options), (zero, zero), memory
    *_, (total, _), memory = persistent_loop(lambda state: state[0] != first_sample + spp, step, state)
    return share * total, memory


def finish(structure: Record, memory: Memory) -> Float[Array, "entries 4"]:
    memory = sweep(structure, memory, jnp.bool_(True))
    total = totals.finish(memory.total)
    # A loop of no trip, where a choice would copy what may be most of the memory.
    return lax.fori_loop(0, memory.lost, lambda _, total: jnp.full_like(total, jnp.nan), total)


class _Kernel(NamedTuple):
    """What kernels of some arrays have in common."""

    scene: Scene
    choice: Choice | None
    structure: Record  # of shapes and dtypes
    of_pixel: Callable  # `pixel_sweep`


def _kernel(scene: Scene, kept: Kept, options: Options, of_slot: Callable = lambda slot: slot) -> _Kernel:
    """of_slot: what becomes of a Slot, whatever its places are."""
    scene = options.applied(scene)
    choice = emitters.choice(scene.emitters, options.strategy)
    paths, slots = kept.paths, differentiated.slots(scene, kept.paths, kept.fields)

    def record(scene, choice, x):
        now, _ = pixel.camera_path(scene, jnp.int32(0), x, x, options)
        u = bounce_numbers(scene, x, x, path.vertices(now), options.sampler, bool(slots.grids))
        found = extend(scene, choice, now, u, options, slots, paths, now.throughput, jnp.int32(0))[1]
        return found._replace(slots=list(map(of_slot, found.slots)))

    structure = jax.eval_shape(record, scene, choice, jnp.uint32(0))
    of_pixel = partial(pixel_sweep, options=options, slots=slots, paths=paths, structure=structure)
    return _Kernel(scene, choice, structure, of_pixel)


def moved(place_of: Callable, slot: Slot) -> Slot:
    """The Slot whose places are those of the total. place_of: from the list of entries to the total."""
    return replace(slot, places=tuple(map(place_of, slot.places)))


def in_numbers(slot: Slot) -> Slot:
    """What adds to the derivatives in the number itself where it may be the luminance of a texture."""
    if not slot.by_luminance:
        return slot
    shares = slot.shares and tuple(luminance(share) if share.ndim else share for share in slot.shares)
    return replace(slot, shares=shares, by_luminance=False)


@partial(jax.jit, static_argnames=("kept", "options", "ring", "form", "devices"))
def pullback(
    scene: Scene,
    adjoint,
    pixels,
    first_sample,
    spp,
    seed,
    *,
    kept: Kept,
    options: Options,
    ring,
    form=None,
    devices=None,
) -> Float[Array, "entries 4"]:
    """J^T adjoint: of the entries that are kept; of a number, the sum of the first three is its own. The last is none.

    Args:
        scene: without names.
        adjoint: (N, 3) of the means of the pixels.
        pixels, first_sample, spp, seed: (N,) each, as for `map_pixels`.
        kept: of arrays that `differentiated` knows.
        ring: of `longest_ring`.
        form, devices: of `native_fold`.
    """
    scene, choice, structure, sweep_of = _kernel(scene, kept, options)

    def of_pixel(work, scene, choice, memory):
        adjoint, work = work
        return sweep_of(work, scene, choice, adjoint, partial(moved, kept.place), memory)[1]

    def of_samples(adjoint, work, scene, choice):
        begin, end = partial(start, scene, structure, kept.count, ring), partial(finish, structure)
        how = dict(start=begin, finish=end, form=form, devices=devices)
        return native_fold(of_pixel, (adjoint, work), scene, choice, **how)

    work = pixels, first_sample, spp, seed
    if not options.shared:
        return of_samples(adjoint, work, scene, choice)
    zero = jnp.zeros((kept.count, totals.WIDTH), adjoint.dtype)
    return pulled(of_samples, zero, adjoint, work, scene, choice, options=options, devices=devices)


@partial(jax.jit, static_argnames=("kept", "options", "ring", "form", "devices"))
def rows(
    scene: Scene, pixels, first_sample, spp, seed, *, kept: Kept, options: Options, ring, form=None, devices=None
) -> tuple[Float[Array, "N 3"], Rows]:
    """Means of pixels, and derivatives of each channel in the same channel of each colour that is kept, or in a number.

    A texture of colours that stands for a number has derivatives in the number, so it stands nowhere for colours.
    Arguments as for `pullback`, and work as for `map_pixels`. A row is (N, 4), and the last number is none.
    """
    scene, choice, structure, sweep_of = _kernel(scene, kept, options, in_numbers)

    def of_pixel(work, number, scene, choice, memory):
        pixels = totals.count(memory.total) // kept.count
        ones = jnp.ones_like(scene.camera.origin)
        of_slot = partial(moved, lambda entry: pixels * kept.place(entry) + number)
        return sweep_of(work, scene, choice, ones, lambda slot: of_slot(in_numbers(slot)), memory)

    def begin(lanes, pixels, scene, choice):
        return start(scene, structure, pixels * kept.count, ring, lanes)

    def end(memory):
        return finish(structure, memory).reshape(kept.count, -1, totals.WIDTH)

    work, how = (pixels, first_sample, spp, seed), dict(form=form, devices=devices)
    if not options.shared:
        return native_rows(of_pixel, work, scene, choice, start=begin, finish=end, **how)

    def of_samples(work, scene, choice):
        means, rows = native_rows(of_pixel, work, scene, choice, start=begin, finish=end, **how)
        return means, jnp.moveaxis(rows.all(), 0, 1)

    dtype = scene.camera.origin.dtype
    like = jax.ShapeDtypeStruct((3,), dtype), jax.ShapeDtypeStruct((kept.count, totals.WIDTH), dtype)
    image, of_images = images(of_samples, like, work, scene, choice, options=options, devices=devices)
    return image, Rows((jnp.moveaxis(of_images, 0, 1)[None],), of_images.shape[::2])
