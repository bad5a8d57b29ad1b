"""J^T v, and J in many scalars, by a recorded sweep: about the cost of one image, whatever the number of parameters.

A path's derivative has entries at the parameters of its vertices, and nowhere else. So each vertex is recorded
(`record`, which has the equations), and when the path has ended, its vertices are swept in reverse order. Their
derivatives, times the adjoint of the pixel, are added to a list of derivatives at the entries that the vertex looked up
(`places`, `totals`): one list for all pixels or, without an adjoint, one for each.

All lanes record at once, in one row of a ring of buffers, and are swept at once, every WINDOW trips: back from the last
path end that they have recorded to the first vertex of the oldest path that is not swept yet.
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

# Trips between two sweeps; trips that the ring holds where the longest path is unknown when a kernel is traced; and at
# most. Powers of 2. In the second case a path of more than RING - WINDOW vertices is lost, and derivatives become NaN.
WINDOW, RING, MOST_RING = 32, 1024, 1 << 14
# Of the paths that roulette may end, one in 1e20 is still alive after this many vertices.
ROULETTE = 900
# Bits of a lane's record.
BEGINS, ENDS, HOLDS = 1, 2, 4


def columns_of(record: Record) -> list:
    """Return the scalars of a record, one after another, the two flags first, in one integer."""
    bits = jnp.where(record.begins, BEGINS, 0) | jnp.where(record.ends, ENDS, 0)
    numbers = [x for leaf in jax.tree.leaves(record._replace(begins=None, ends=None)) for x in jnp.ravel(leaf)]
    return [bits, *numbers]


# ---- the memory that lanes share ------------------------------------------------------------------------------------


class Memory(NamedTuple):
    total: Total
    clock: Int[Array, ""]  # trips
    swept: Int[Array, ""]  # trips before the last sweep
    lost: Int[Array, ""]  # 1: a path was longer than the ring
    size: Int[Array, ""]  # trips of the ring that are used: a short ring stays in near caches
    ring: list  # (trips, scalars, W) of Records, one per dtype: loops pay for each array that they carry


class Sweep(NamedTuple):
    """State of the backward sweep, per lane."""

    back: Int[Array, ""]  # trips so far
    goes_on: Bool[Array, ""]
    complete: Int[Array, " W"]  # 1: has met the end of a path, so that R is known
    stopped: Int[Array, " W"]  # 1: all older vertices have been swept before
    R: list[Float[Array, " W"]]  # as in `record`
    total: Total


def start(scene: Scene, record: Record, entries: int, ring: int, lanes: int) -> Memory:
    """Return the memory before the first pixel.

    Args:
        record: a record of shapes and dtypes.
        entries: of the total.
        ring: trips that the ring holds.
        lanes: their number.
    Raises:
        InputError: paths may have more vertices than the ring can hold.
    """
    if ring > MOST_RING:
        raise InputError(
            f"max_depth and rr_depth let paths have more than {MOST_RING - WINDOW} vertices, too many to be recorded "
            "for derivatives in many numbers; set a smaller max_depth or rr_depth"
        )
    total = totals.start(entries, lanes, scene.camera.origin.dtype)
    # No trip is read before it is written. On CPUs the ring is filled with zeros all the same, so it should be short.
    types = [x.dtype for x in jax.eval_shape(columns_of, record)]
    buffers = [lax.empty((ring, types.count(dtype), lanes), dtype) for dtype in dict.fromkeys(types)]
    zero = jnp.int32(0)
    return Memory(total, zero, zero, zero, ring_size(scene, ring), buffers)


def longest_ring(scene: Scene) -> int:
    """Trips of a ring that holds the scene's longest path and a window; RING where max_depth or rr_depth is traced."""
    depths = scene.max_depth, scene.rr_depth
    if any(map(is_traced, depths)):
        return RING
    most, unharmed = (int(np.asarray(depth).max()) for depth in depths)
    longest = min(most, unharmed + ROULETTE)
    if _passes(scene):
        longest = max(longest, ROULETTE)
    return 1 << (longest + WINDOW - 1).bit_length()


def _passes(scene: Scene) -> bool:
    """Return whether a path may record vertices that do not count towards its depth."""
    passes = scene.media is not None or bsdfs.occurs(scene.materials, "passes")
    return bool(passes or scene.free_passes or scene.hide_emitters)


def ring_size(scene: Scene, ring: int) -> Int[Array, ""]:
    """Return the power of 2 that holds the longest path and a window; `ring` if that is unknown or less."""
    if _passes(scene):
        return jnp.int32(ring)
    sizes = [1 << k for k in range(ring.bit_length())]
    wanted = jnp.minimum(scene.max_depth, ring) + WINDOW
    return jnp.min(jnp.where(jnp.array(sizes) >= wanted, jnp.array(sizes), ring)).astype(jnp.int32)


def remember(structure: Record, memory: Memory, here: Bool[Array, " W"], columns: list) -> Memory:
    """Record one vertex per lane; sweep every WINDOW trips."""
    bits, *numbers = columns
    # A lane without an item records an empty path: one that begins and ends here and holds no vertex.
    columns = [jnp.where(here, bits | HOLDS, BEGINS | ENDS), *numbers]
    ring = _with_row(memory.ring, memory.clock & (memory.size - 1), columns)
    memory = memory._replace(clock=memory.clock + 1, ring=ring)
    return sweep(structure, memory, memory.clock - memory.swept >= WINDOW)


def _with_row(ring: list, row: Int[Array, ""], columns: list) -> list:
    """Return the ring with a trip's columns written to a row, in order within each dtype."""
    new = []
    for buffer in ring:
        for k, x in enumerate([x for x in columns if x.dtype == buffer.dtype]):
            where = row, jnp.int32(k), jnp.int32(0)
            buffer = lax.dynamic_update_slice(buffer, x[None, None], where, allow_negative_indices=False)
        new.append(buffer)
    return new


def _row(ring: list, row: Int[Array, ""], types: list) -> list:
    """Return the columns that `_with_row` wrote to a row. types: dtype of each."""
    following = {}
    for buffer in ring:
        columns = lax.dynamic_index_in_dim(buffer, row, keepdims=False, allow_negative_indices=False)
        following[buffer.dtype] = iter([columns[k] for k in range(len(columns))])
    return [next(following[dtype]) for dtype in types]


def sweep(structure: Record, memory: Memory, due: Bool[Array, ""]) -> Memory:
    """Add the derivatives of all paths that have ended since the last sweep, if `due`."""
    window = jnp.where(due, memory.clock - memory.swept, 0)
    types = [x.dtype for x in jax.eval_shape(columns_of, structure)]

    def step(state: Sweep) -> Sweep:
        bits, *numbers = _row(memory.ring, (memory.clock - 1 - state.back) & (memory.size - 1), types)
        record = unflattened(structure, numbers)
        begins, ends, holds = (bits & bit != 0 for bit in (BEGINS, ENDS, HOLDS))
        complete = (state.complete != 0) | ends
        here = complete & (state.stopped == 0) & holds
        # A non-finite value of one path must not reach the path before it.
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
    # In the last sweep the window may be empty.
    lost = memory.lost | jnp.where((window > 0) & ~all_set(last.stopped != 0), 1, 0)
    return memory._replace(total=last.total, swept=jnp.where(due, memory.clock, memory.swept), lost=lost)


def unflattened(structure: Record, numbers: list) -> Record:
    """Return the Record that has these scalars, each vector as a list."""
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
    """Add the derivatives of a pixel's samples to the memory; return the samples' mean, and the memory.

    Args:
        scale: factor of the derivatives of the mean.
        of_slot: Slot with places in the list of entries -> Slot with places in the total.
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
    # A loop of 0 or 1 trips: a `cond` would copy the total, which may be most of the memory.
    return lax.fori_loop(0, memory.lost, lambda _, total: jnp.full_like(total, jnp.nan), total)


class _Kernel(NamedTuple):
    """What `pullback` and `rows` share."""

    scene: Scene
    choice: Choice | None
    structure: Record  # shapes and dtypes
    of_pixel: Callable  # `pixel_sweep`


def _kernel(scene: Scene, kept: Kept, options: Options, of_slot: Callable = lambda slot: slot) -> _Kernel:
    """Prepare `pullback` or `rows`. of_slot: how they change Slots, apart from their places."""
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
    """Return the Slot with places in the total. place_of: place in the list of entries -> place in the total."""
    return replace(slot, places=tuple(map(place_of, slot.places)))


def in_numbers(slot: Slot) -> Slot:
    """Return the Slot that adds to derivatives in the scalar itself, where that may be the luminance of a texture."""
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
    """Return J^T adjoint for the kept entries: 3 columns, whose sum is the derivative in a scalar, and one unused.

    Args:
        scene: without names.
        adjoint: (N, 3) of the means of the pixels.
        pixels, first_sample, spp, seed: (N,) each, as for `map_pixels`.
        kept: entries of arrays in `differentiated.paths`.
        ring: as returned by `longest_ring`.
        form, devices: as for `native_fold`.
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
    """Return the means of pixels, and derivatives of each channel in the same channel of kept colours, or in scalars.

    A colour texture that is used as a scalar has derivatives in that scalar, so it must not be used as a colour too.
    Arguments as for `pullback`, work as for `map_pixels`. A row is (N, 4), whose last column is unused.
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
