"""J^T v, and J in many colours, at the price of about one image, whatever the number of parameters: a recorded sweep.

A path's derivative has entries at the parameters of the vertices that it meets, and nowhere else. So each vertex is
recorded as it is met, and when the path has ended its vertices are gone through again, the last one first:

    R_{k-1} = Le_k + n_k + w_k R_k                     radiance that arrives at vertex k-1; behind the last vertex 0
    dI/d theta = beta_k (dLe_k/d theta + dn_k/d theta + (dw_k/d theta) R_k)

with Le what the path ends on and n the light sample, each with its share, w the weight of the bsdf sample over the
survival of roulette, and beta the throughput before the vertex. Nothing is divided by a reflectance, so what is black
keeps its derivative. Times the adjoint of the pixel these are added to a list of derivatives, at the entries that the
vertex looked up (`places`): one list for all pixels, or, without an adjoint, one for each. What directions and
probabilities depend on is detached, as in all of pathjax.

All lanes record at once, in one row of a ring of buffers, and are swept at once, every WINDOW trips: back from the last
end of a path that they have recorded to the first vertex of a path that was swept before.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import bsdfs, emitters
from pathjax.compile import compute_once, native_fold, native_rows, persistent_loop, together
from pathjax.compile.lanes import flags
from pathjax.core import sampler
from pathjax.core.math import LUMINANCE, at
from pathjax.derivatives import places
from pathjax.emitters import Choice
from pathjax.integrators import path, pixel
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import Bounce, bounce_numbers
from pathjax.integrators.shadow import none_passed
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Trips between two sweeps, and those that the ring holds at most, a power of 2. A path of more than the difference is
# not recorded whole, and makes the derivatives NaN: one in 1e20, if roulette ends paths.
WINDOW, RING = 32, 1024
# Entries of a list that every lane sums up by itself.
FEW = 8

# Bits of what a lane records.
BEGINS, ENDS, HOLDS = 1, 2, 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Slot:
    """What a vertex adds to the derivatives in one number that it looked up, times the adjoint and the throughput."""

    places: tuple[Int[Array, ""], ...]  # of the number, in the list of derivatives
    # Of each place in the number, or in each of its channels; None: there is one place.
    shares: tuple[Float[Array, "..."], ...] | None
    now: Float[Array, "3"]  # d(Le + n)
    later: Float[Array, "3"] | None  # dw, to be multiplied by R
    is_number: bool = field(default=False, metadata={"static": True})  # the luminance of what is looked up


class Record(NamedTuple):
    """What the sweep needs of a vertex."""

    begins: Bool[Array, ""]  # the first of its path
    ends: Bool[Array, ""]  # the last one
    gathered: Float[Array, "3"]  # Le + n
    weight: Float[Array, "3"]  # w
    slots: list[Slot]


# ---- recording ------------------------------------------------------------------------------------------------------


def extend(
    scene: Scene,
    choice: Choice | None,
    now: path.Path,
    u: Bounce,
    options: Options,
    slots: places.Slots,
    paths: places.Paths,
    scale: Float[Array, "3"],
    number: Int[Array, ""],
) -> tuple[path.Path, Record, Bool[Array, ""]]:
    """`path.extend`, the Record of the vertex, whose `begins` is not known here, and whether it is the vertex itself.

    Each surface that the vertex's shadow ray passes has a Record of its own, before that of the vertex.

    Args:
        options: by vertex.
        scale: what derivatives are multiplied by, beside the throughput.
        number: of the Record among those of the vertex.
    """
    scene = places.prepared(scene, slots, number)
    hit, here, u = path.meet(scene, now, u, options)
    if slots.of_passed:
        now = now._replace(L=now.L._replace(nudged=none_passed(scene)))
    of_bsdfs, of_lights, of_choices, of_passed = slots.numbered(start=1)

    def varied(changes):
        changed = places.nudged(scene, slots, changes)
        of, there = now._replace(throughput=now.throughput + changes[0]), here
        if of_choices:
            change = jnp.dot(changes[of_choices.start : of_choices.stop], places.by_choices(slots, here))
            there = here._replace(weight=here.weight + change)
        on = path.onward(changed, choice, of, hit, there, u, options)
        return (on.L.emission, on.L.light, on.throughput), on

    count = of_passed.stop
    zeros = jnp.zeros((count,), scale.dtype)
    push = partial(jax.jvp, varied, (zeros,), has_aux=True)
    _, (Le, n, w), on = jax.vmap(lambda change: push((change,)), out_axes=(None, 0, None))(jnp.eye(count))
    w = jnp.where(on.alive, w, 0)
    found = []
    for s, k in enumerate(of_bsdfs if here is not None else ()):
        entries = places.of_bsdf(scene, paths, slots, s, here)
        found.append(Slot(*entries, scale * n[k], scale * w[k], s >= slots.colors))
    for s, k in enumerate(of_lights):
        entries = places.of_hit(scene, paths, slots, s, now.ray, hit, here)
        found.append(Slot(*entries, scale * Le[k], None))
        if choice is not None and here is not None:
            entries = places.of_light_sample(scene, choice, paths, slots, s, here, u)
            found.append(Slot(*entries, scale * n[k], None))
    for s, k in enumerate(of_choices):
        entries = places.of_choice(scene, paths, slots, s, here)
        found.append(Slot(*entries, scale * n[k], scale * w[k], is_number=True))
    record = Record(jnp.bool_(False), ~on.alive, Le[0] + n[0], w[0], found)
    if not of_passed:
        return on, record, jnp.bool_(True)

    # Of what is passed nothing but its own derivatives.
    passed, on = on.L.nudged, on._replace(L=on.L._replace(nudged=None))
    itself = number >= passed.count
    found = [jax.tree.map(lambda x: jnp.where(itself, x, 0).astype(x.dtype), slot) for slot in found]
    for s, k in enumerate(of_passed):
        entries = places.of_passed(scene, paths, slots, s, passed)
        found.append(Slot(*entries, jnp.where(itself, 0, scale * n[k]), None, is_number=True))
    gathered, weight = jnp.where(itself, record.gathered, 0), jnp.where(itself, record.weight, 1)
    return on, Record(record.begins, record.ends & itself, gathered, weight, found), itself


def columns_of(record: Record) -> list:
    """Its numbers, one after another, the two flags in one."""
    bits = jnp.where(record.begins, BEGINS, 0) | jnp.where(record.ends, ENDS, 0)
    numbers = [x for leaf in jax.tree.leaves(record._replace(begins=None, ends=None)) for x in jnp.ravel(leaf)]
    return [bits, *numbers]


# ---- the memory that lanes share ------------------------------------------------------------------------------------


class Memory(NamedTuple):
    total: list[Float[Array, " W"]] | Float[Array, "M 3"]  # of few entries, a column for each; or the list
    clock: Int[Array, ""]  # trips
    swept: Int[Array, ""]  # trips before the last sweep
    lost: Int[Array, ""]  # 1: a path was longer than the ring
    size: Int[Array, ""]  # trips that are used of the ring: few stay in near caches
    ring: list  # of each number of a Record, (RING, W)


class Sweep(NamedTuple):
    """What goes back through the ring, of each lane."""

    back: Int[Array, ""]  # trips so far
    goes_on: Bool[Array, ""]
    complete: Int[Array, " W"]  # 1: has met the end of a path, so that it knows what arrives
    stopped: Int[Array, " W"]  # 1: all that is older has been swept before
    R: list[Float[Array, " W"]]
    total: list[Float[Array, " W"]] | Float[Array, "M 3"]


def start(scene: Scene, record: Record, entries: int, lanes: int) -> Memory:
    """record: of shapes and dtypes."""
    dtype = scene.camera.origin.dtype
    few = entries <= FEW
    total = [jnp.zeros((lanes,), dtype)] * (3 * entries) if few else jnp.zeros((entries, 3), dtype)
    # No trip is read that was not written.
    ring = [lax.empty((RING, lanes), x.dtype) for x in jax.eval_shape(columns_of, record)]
    zero = jnp.int32(0)
    return Memory(total, zero, zero, zero, ring_size(scene), ring)


def ring_size(scene: Scene) -> Int[Array, ""]:
    """Power of 2 that holds the longest path and a window, as far as that is known; RING at most."""
    passes = scene.media is not None or bsdfs.occurs(scene.materials, "passes")
    if passes or scene.free_passes or scene.hide_emitters:
        return jnp.int32(RING)  # what is passed has records too, and does not count into depth
    sizes = [1 << k for k in range(RING.bit_length())]
    wanted = jnp.minimum(scene.max_depth, RING) + WINDOW
    return jnp.min(jnp.where(jnp.array(sizes) >= wanted, jnp.array(sizes), RING)).astype(jnp.int32)


def remember(structure: Record, memory: Memory, here: Bool[Array, " W"], columns: list) -> Memory:
    """Record a vertex of every lane; now and then, sweep."""
    bits, *numbers = columns
    # A lane without an item records nothing that is whole.
    columns = [jnp.where(here, bits | HOLDS, BEGINS | ENDS), *numbers]
    ring = _with_row(memory.ring, memory.clock & (memory.size - 1), columns)
    memory = memory._replace(clock=memory.clock + 1, ring=ring)
    return sweep(structure, memory, memory.clock - memory.swept >= WINDOW)


def _with_row(ring: list, row: Int[Array, ""], columns: list) -> list:
    def put(buffer, x):
        return lax.dynamic_update_slice(buffer, x[None], (row, jnp.int32(0)), allow_negative_indices=False)

    return list(map(put, ring, columns))


def _row(ring: list, row: Int[Array, ""]) -> list:
    return [lax.dynamic_index_in_dim(x, row, keepdims=False, allow_negative_indices=False) for x in ring]


def sweep(structure: Record, memory: Memory, due: Bool[Array, ""]) -> Memory:
    """Add what all paths give that have ended since the last sweep, if it is due."""
    window = jnp.where(due, memory.clock - memory.swept, 0)

    def step(state: Sweep) -> Sweep:
        bits, *numbers = _row(memory.ring, (memory.clock - 1 - state.back) & (memory.size - 1))
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
            if slot.is_number:
                change = [sum(change) * share for share in LUMINANCE]
            total = add(total, slot, [jnp.where(here, x, 0) for x in change])
        R = [n + w * x for n, w, x in zip(record.gathered, record.weight, R, strict=True)]
        back = state.back + 1
        stopped = (state.stopped != 0) | ((back >= window) & (begins | ~complete))
        goes_on = (back < window) | ((back < memory.size) & ~all_set(stopped))
        return Sweep(back, goes_on, complete.astype(jnp.int32), stopped.astype(jnp.int32), R, total)

    nothing = jnp.zeros((memory.ring[0].shape[1],), jnp.int32)
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


def add(total, slot: Slot, change: list[Float[Array, " W"]]):
    """The total to which each lane's change (3) is added."""
    if isinstance(total, list):
        for place, share in zip(slot.places, slot.shares or [None], strict=True):
            total = [t + jnp.where(place == k // 3, _part(change, share)[k % 3], 0) for k, t in enumerate(total)]
        return total

    # XLA's own scatter would break the native kernel; a lane that adds nothing adds 0.
    def one(lane, total):
        of_lane = partial(jax.tree.map, lambda column: at(column, lane))
        x = of_lane(change)
        for place, share in of_lane(list(zip(slot.places, slot.shares or [None], strict=True))):
            new = at(total, place) + jnp.stack(_part(x, share))
            total = lax.dynamic_update_slice(total, new[None], (place, jnp.int32(0)), allow_negative_indices=False)
        return total

    return lax.fori_loop(0, len(change[0]), one, total)


def _part(change, share):
    """Of three numbers the share, which is one, or one of each; None: all."""
    if share is None:
        return change
    return [s * x for s, x in zip(share if isinstance(share, list) else [share] * 3, change, strict=True)]


def all_set(of_lanes: Bool[Array, " W"]) -> Bool[Array, ""]:
    return ~flags.any_set(flags.packed(~of_lanes))


# ---- pixels ---------------------------------------------------------------------------------------------------------


def pixel_sweep(
    work: pixel.Work,
    scene: Scene,
    choice: Choice | None,
    scale: Float[Array, "3"],
    first: Int[Array, ""] | int,
    memory: Memory,
    *,
    options: Options,
    slots: places.Slots,
    paths: places.Paths,
    structure: Record,
) -> tuple[Float[Array, "3"], Memory]:
    """Add what the samples of a pixel give, and their mean.

    scale: of the derivatives of the mean; first: where the list begins in the total.
    """
    pixel_number, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel_number)
    share = 1 / jnp.maximum(spp, 1).astype(scale.dtype)

    def step(state):
        number, passed, now, weight, sums, memory = state
        begins = ~now.alive
        now, weight = pixel.begun(scene, pixel_number, stream, number, now, weight, options)
        u = bounce_numbers(scene, stream, number, path.vertices(now), options.sampler)
        of_sample = weight * (share * scale)
        on, record, itself = extend(scene, choice, now, u, options, slots, paths, of_sample, passed)
        there = [replace(slot, places=tuple(first + place for place in slot.places)) for slot in record.slots]
        record = record._replace(begins=begins, slots=there)
        memory = together(partial(remember, structure))(memory, columns_of(record))
        gain = weight * (on.L.emission + on.L.light)
        if slots.of_passed:
            gain = jnp.where(itself, gain, 0)
            passed, on = jnp.where(itself, 0, passed + 1), jax.tree.map(partial(jnp.where, itself), on, now)
        sums = pixel.add_compensated(sums, compute_once(gain))
        return number + jnp.where(on.alive, 0, 1).astype(number.dtype), passed, on, weight, sums, memory

    zero = jnp.zeros((3,), scale.dtype)
    state = first_sample, jnp.int32(0), *pixel.no_path(scene, options), (zero, zero), memory
    *_, (total, _), memory = persistent_loop(lambda state: state[0] != first_sample + spp, step, state)
    return share * total, memory


def finish(structure: Record, memory: Memory) -> Float[Array, "M 3"]:
    memory = sweep(structure, memory, jnp.bool_(True))
    total = memory.total
    if isinstance(total, list):
        total = jnp.stack([jnp.sum(x) for x in total]).reshape(-1, 3)
    return jnp.where(memory.lost != 0, jnp.nan, total)


def _structure(
    scene: Scene, choice: Choice | None, slots: places.Slots, paths: places.Paths, options: Options
) -> Record:
    """Of a Record, shapes and dtypes."""

    def record(scene, choice, x):
        now, _ = pixel.camera_path(scene, jnp.int32(0), x, x, options)
        u = bounce_numbers(scene, x, x, path.vertices(now), options.sampler)
        return extend(scene, choice, now, u, options, slots, paths, now.throughput, jnp.int32(0))[1]

    return jax.eval_shape(record, scene, choice, jnp.uint32(0))


@partial(jax.jit, static_argnames=("paths", "options", "devices"))
def pullback(scene: Scene, adjoint, pixels, first_sample, spp, seed, *, paths, options: Options, devices=None):
    """J^T adjoint: of each of the arrays, its shape.

    Args:
        scene: without names.
        adjoint: (N, 3) of the means of the pixels.
        pixels, first_sample, spp, seed: (N,) each.
        paths: of the arrays, which `places` knows.
    """
    scene = options.applied(scene)
    choice = emitters.choice(scene.emitters, options.strategy)
    slots = places.slots(scene, paths)
    first, entries = places.firsts(scene, paths)
    structure = _structure(scene, choice, slots, paths, options)
    sweep_of = partial(pixel_sweep, options=options, slots=slots, paths=paths, structure=structure)

    def of_pixel(work, scene, choice, memory):
        adjoint, work = work
        return sweep_of(work, scene, choice, adjoint, 0, memory)[1]

    begin, end = partial(start, scene, structure, entries), partial(finish, structure)
    work = adjoint, (pixels, first_sample, spp, seed)
    total = native_fold(of_pixel, work, scene, choice, start=begin, finish=end, devices=devices)

    def of_array(path):
        rows = total[first[path] : first[path] + places.count(scene, path)]
        rows = rows if places.of_colors(scene, path) else rows.sum(1)
        return rows.reshape(named.get(scene, path).shape)

    return [of_array(path) for path in paths]


@partial(jax.jit, static_argnames=("paths", "options", "devices"))
def rows(
    scene: Scene, pixels, first_sample, spp, seed, *, paths, options: Options, devices=None
) -> tuple[Float[Array, "N 3"], Float[Array, "N M 3"]]:
    """Means of pixels, and their derivatives in each of the list of colours: of each channel in its own.

    Arguments as for `pullback`; the arrays hold colours alone.
    """
    scene = options.applied(scene)
    choice = emitters.choice(scene.emitters, options.strategy)
    slots = places.slots(scene, paths)
    _, entries = places.firsts(scene, paths)
    structure = _structure(scene, choice, slots, paths, options)
    sweep_of = partial(pixel_sweep, options=options, slots=slots, paths=paths, structure=structure)

    def of_pixel(work, number, scene, choice, memory):
        return sweep_of(work, scene, choice, jnp.ones_like(scene.camera.origin), number * entries, memory)

    def begin(lanes, pixels, scene, choice):
        return start(scene, structure, pixels * entries, lanes)

    def end(memory):
        return finish(structure, memory).reshape(-1, entries, 3)

    work = pixels, first_sample, spp, seed
    return native_rows(of_pixel, work, scene, choice, start=begin, finish=end, devices=devices)
