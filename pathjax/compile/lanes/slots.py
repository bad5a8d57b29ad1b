"""Searches of lanes, several at once, none of which waits for another.

A search reads one node after another, each of which says what the next is: the processor waits most of the time. So a
few lanes search at once, each in a slot. Every trip of one loop opens a node of each slot; visits and the change to the
next lane stand in loops of their own, of any number of trips. (XLA writes down where all that a loop carries is, in
every trip of the loop around it, so all numbers of one type that a lane searches with are one array; and a branch in
place of such a loop costs more.)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.compile.jax_compat import ClosedJaxpr
from pathjax.compile.lanes import flags
from pathjax.compile.lanes.columns import differs, entry, split, with_entry
from pathjax.compile.primitives import Part, Search

# As measured: with more the processor waits less, and each costs instructions in every trip.
SLOTS = 3


def in_slots(interpreter, program: ClosedJaxpr, search: Search[Part], inputs: list) -> list:
    """Results of a search of each lane that is active; program: the same of one lane."""
    width = interpreter.width
    active = jnp.ones((width,), bool) if interpreter.active is None else interpreter.active
    words = flags.packed(active)
    nobody, nothing = jnp.int32(width), jnp.int32(width + 1)  # where what no lane has left goes; an empty slot

    def enlist(lane, state):
        count, order = state
        return count + 1, with_entry(order, lane, count)

    empty = jnp.int32(0), jnp.zeros((width,), jnp.int32)
    count, order = flags.for_each_lane(words, enlist, empty)

    columns: dict[Any, list] = {}
    places: dict[int, slice] = {}
    for number, (x, aval) in enumerate(zip(inputs, program.in_avals, strict=True)):
        if differs(x):
            mine = columns.setdefault(aval.dtype, [])
            places[number] = slice(len(mine), len(mine) + x.size)
            mine += [jnp.broadcast_to(item, (width,)) for item in x.flat]
    tables = {dtype: jnp.stack(items, -1) for dtype, items in columns.items()}

    def rows_of(lane):
        return {dtype: entry(table, lane) for dtype, table in tables.items()}

    def inputs_of(rows):
        """Inputs of a lane, from its rows of the tables."""
        avals = program.in_avals
        return [
            rows[avals[number].dtype][places[number]].reshape(avals[number].shape) if number in places else x
            for number, x in enumerate(inputs)
        ]

    def visit(slot):
        lane, rows, state = slot

        def visits(state):
            return search.visits(inputs_of(rows), *state)[0]

        return lane, rows, lax.while_loop(visits, lambda state: search.visit(inputs_of(rows), *state), state)

    def is_done(state):
        _, (lane, rows, state), _ = state
        mine = inputs_of(rows)
        return (lane < nothing) & ~(search.opens(mine, *state)[0] | search.visits(mine, *state)[0])

    def next_lane(state):
        """Put away how the search of a slot ended, and begin that of the next lane in it."""
        taken, (lane, rows, state), ends = state
        ends = [with_entry(end, state[k], lane) for end, k in zip(ends, read, strict=True)]
        more = taken < count
        lane = jnp.where(more, entry(order, jnp.minimum(taken, width - 1)), nothing)
        rows = rows_of(lane)
        state = [jnp.where(more, x, jnp.zeros_like(x)) for x in search.begin(inputs_of(rows))]
        return taken + 1, (lane, rows, state), ends

    def trip(state):
        taken, slots, ends = state
        slots = [(lane, rows, search.open(inputs_of(rows), *state)) for lane, rows, state in slots]
        for number, slot in enumerate(list(map(visit, slots))):
            taken, slots[number], ends = lax.while_loop(is_done, next_lane, (taken, slot, ends))
        return taken, slots, ends

    # Results come after all searches, so that their program is there once, not in each slot.
    def put_result(lane, results):
        mine = list(state)
        for end, k in zip(ends, read, strict=True):
            mine[k] = entry(end, lane)
        found = search.result(inputs_of(rows_of(lane)), *mine)
        return [with_entry(result, y, lane) for result, y in zip(results, found, strict=True)]

    rows = {dtype: jnp.zeros_like(table[0]) for dtype, table in tables.items()}
    state = [jnp.zeros(x.shape, x.dtype) for x in jax.eval_shape(search.begin, inputs_of(rows))]
    read = search.result.reads()
    ends = [jnp.zeros((width + 1, *state[k].shape), state[k].dtype) for k in read]
    start = jnp.int32(0), [(nobody, rows, state)] * SLOTS, ends
    # A number is taken by each slot at the end of each search, and once before its first.
    *_, ends = lax.while_loop(lambda state: state[0] < count + SLOTS, trip, start)
    results = [jnp.zeros((width, *aval.shape), aval.dtype) for aval in program.out_avals]
    return list(map(split, flags.for_each_lane(words, put_result, results)))
