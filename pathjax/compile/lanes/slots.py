"""Interleaved searches of several lanes, none of which waits for another.

A search reads one node after another, each of which determines the next: the processor waits for memory most of the
time. So a few lanes search at once, each in a slot. Every trip of one loop opens a node in each slot; visits, and the
change to the next lane, are inner loops of any number of trips. (XLA writes the addresses of a loop's carry in every
trip of the loop around it, so all scalars of one size among a lane's inputs are one array, and those of its search's
state another; and a branch in place of such an inner loop costs more.)
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.compile.jax_compat import ClosedJaxpr
from pathjax.compile.lanes import flags
from pathjax.compile.lanes.columns import differs, entry, split, with_entry
from pathjax.compile.lanes.words import Words
from pathjax.compile.primitives import Part, Search, column_p

# As measured: with more slots the processor waits less, but each costs instructions in every trip.
SLOTS = 3


def in_slots(interpreter, program: ClosedJaxpr, search: Search[Part], inputs: list) -> list:
    """Return the results of a search for each active lane; program: the whole search of one lane."""
    width = interpreter.width
    active = jnp.ones((width,), bool) if interpreter.active is None else interpreter.active
    are_active = flags.packed(active)
    nobody, nothing = jnp.int32(width), jnp.int32(width + 1)  # row for results of no lane; marker of an empty slot

    def enlist(lane, state):
        count, order = state
        return count + 1, with_entry(order, lane, count)

    empty = jnp.int32(0), jnp.zeros((width,), jnp.int32)
    count, order = flags.for_each_lane(are_active, enlist, empty)

    own = [number for number, x in enumerate(inputs) if differs(x)]
    kept = Words(program.in_avals[number] for number in own)
    tables = [
        jnp.stack([jnp.broadcast_to(item, (width,)) for item in items], -1)
        for items in kept.of([inputs[number].flat for number in own])
    ]

    def rows_of(lane):
        return [entry(table, lane) for table in tables]

    def inputs_of(rows):
        """Return the inputs of a lane, from its rows of the tables."""
        mine = dict(zip(own, kept.values(rows), strict=True))
        return [mine.get(number, x) for number, x in enumerate(inputs)]

    # A slot holds a lane's rows of inputs, its index and the scalars of its search's state as words, and the state's
    # arrays.
    nowhere = [jnp.zeros_like(table[0]) for table in tables]
    avals = jax.eval_shape(search.begin, inputs_of(nowhere))
    numbers = [k for k, aval in enumerate(avals) if not aval.shape]
    words = Words([nobody, *(avals[k] for k in numbers)])

    def slot_of(lane, rows, state):
        mine = [lane, *(state[k] for k in numbers)]
        # Each is computed on its own: fused into the concatenation, all would be computed for each.
        items = words.of([[column_p.bind(x)[None]] for x in mine])
        return rows, [jnp.concatenate(each) for each in items], [x for x in state if x.shape]

    def held(slot):
        """Return lane, inputs and state of a slot."""
        rows, packed, arrays = slot
        lane, *mine = words.values(packed)
        of, others = dict(zip(numbers, mine, strict=True)), iter(arrays)
        return lane, inputs_of(rows), [of[k] if k in of else next(others) for k in range(len(avals))]

    def step(part, slot):
        lane, mine, state = held(slot)
        return slot_of(lane, slot[0], part(mine, *state))

    def visits(slot):
        _, mine, state = held(slot)
        return search.visits(mine, *state)[0]

    def is_done(state):
        lane, mine, state = held(state[1])
        return (lane < nothing) & ~(search.opens(mine, *state)[0] | search.visits(mine, *state)[0])

    def next_lane(state):
        """Store the final state of a slot's search, and begin the next lane's search in it."""
        taken, slot, ends = state
        lane, _, state = held(slot)
        ends = [with_entry(end, state[k], lane) for end, k in zip(ends, read, strict=True)]
        more = taken < count
        lane = jnp.where(more, entry(order, jnp.minimum(taken, width - 1)), nothing)
        rows = rows_of(lane)
        state = [jnp.where(more, x, jnp.zeros_like(x)) for x in search.begin(inputs_of(rows))]
        return taken + 1, slot_of(lane, rows, state), ends

    def trip(state):
        taken, slots, ends = state
        slots = [step(search.open, slot) for slot in slots]
        slots = [lax.while_loop(visits, partial(step, search.visit), slot) for slot in slots]
        for number, slot in enumerate(slots):
            taken, slots[number], ends = lax.while_loop(is_done, next_lane, (taken, slot, ends))
        return taken, slots, ends

    # Results are computed after all searches, so that their program is compiled once, not for each slot.
    def put_result(lane, results):
        mine = list(state)
        for end, k in zip(ends, read, strict=True):
            mine[k] = entry(end, lane)
        found = search.result(inputs_of(rows_of(lane)), *mine)
        return [with_entry(result, y, lane) for result, y in zip(results, found, strict=True)]

    state = [jnp.zeros(aval.shape, aval.dtype) for aval in avals]
    read = search.result.reads()
    ends = [jnp.zeros((width + 1, *state[k].shape), state[k].dtype) for k in read]
    start = jnp.int32(0), [slot_of(nobody, nowhere, state)] * SLOTS, ends
    # The counter is incremented at the end of each search, and once per slot before its first search.
    *_, ends = lax.while_loop(lambda state: state[0] < count + SLOTS, trip, start)
    results = [jnp.zeros((width, *aval.shape), aval.dtype) for aval in program.out_avals]
    return list(map(split, flags.for_each_lane(are_active, put_result, results)))
