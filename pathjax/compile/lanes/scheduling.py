"""Scheduling of items on lanes: in groups, or from a queue."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from jax import lax

from pathjax.compile.jax_compat import while_parts
from pathjax.compile.lanes import flags
from pathjax.compile.lanes.columns import entry, join, split, with_entry
from pathjax.compile.lanes.dataflow import variables, variables_read_by
from pathjax.compile.lanes.interpreter import Interpreter
from pathjax.compile.primitives import unset_p


def in_groups(interpreter: Interpreter, program, xs, shared):
    """Return the results (N, ...) of all items; the lanes of a group begin and end together."""
    width, count = interpreter.width, len(xs[0])
    groups = -(-count // width)

    def grouped(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[:1], (groups * width - count, *x.shape[1:]))])
        return x.reshape(groups, width, *x.shape[1:])

    def one_group(xs):
        return [join(y, width) for y in interpreter.run(program, [*map(split, xs), *shared])]

    return [y.reshape(groups * width, *y.shape[2:])[:count] for y in lax.map(one_group, list(map(grouped, xs)))]


def from_queue(interpreter: Interpreter, program, xs, shared, place, differ, memory=0):
    """Return the same where equation `place` is a `persistent_loop`: a lane that leaves it begins another item.

    Args:
        differ: result of `dataflow.differing_in`.
        memory: number of trailing outputs that are memory of `together`, which the loop carries; returned unchanged.
    """
    width, count, jaxpr = interpreter.width, len(xs[0]), program.jaxpr
    first_memory = len(jaxpr.outvars) - memory
    own_outputs, memory_outputs = jaxpr.outvars[:first_memory], jaxpr.outvars[first_memory:]
    before, loop, after = jaxpr.eqns[:place], jaxpr.eqns[place], jaxpr.eqns[place + 1 :]
    test_consts, body_consts, init = while_parts(loop, loop.invars)

    def begin(item, common):
        """Return the values before the loop, of one item; common: values that all items share, as far as known."""
        values = interpreter.initial_values(program, [*(entry(x, item) for x in xs), *shared]) | common
        interpreter.run_equations([eqn for eqn in before if any(v not in common for v in eqn.outvars)], values)
        return values | {v: interpreter.read(values, atom) for v, atom in zip(loop.outvars, init, strict=True)}

    first = begin(jnp.int32(0), {})
    common = {v: value for v, value in first.items() if v not in loop.outvars and not differ([v])[0]}
    # State of a lane: values of its item that are computed before the loop and read later, then the loop's carry.
    read_later = variables_read_by(after) | variables([*test_consts, *body_consts, *jaxpr.outvars])
    own = [v for v in first if v in read_later and v not in common and v not in loop.outvars]
    kept = [*own, *loop.outvars]
    differing = [True] * len(own) + differ(loop.outvars)
    shapes = [v.aval.shape for v in kept]
    said = variables(v for eqn in before if eqn.primitive is unset_p for v in eqn.outvars)
    unset = {v for v, atom in zip(loop.outvars, init, strict=True) if variables([atom]) & said}
    written = [differs and v not in unset for v, differs in zip(kept, differing, strict=True)]

    def read_all(values, atoms):
        return [interpreter.read(values, v) for v in atoms]

    def unpack(packed):
        return common | dict(zip(kept, interpreter.unpack(packed, differing, shapes), strict=True))

    def value_in_lane(lane, v, columns, differs):
        if not differs:
            return columns
        numbers = [entry(column, lane) for column in columns]
        return jnp.stack(numbers).reshape(v.aval.shape) if columns else jnp.zeros(v.aval.shape, v.aval.dtype)

    def idle(state):
        """Return packed flags of the lanes that are done with their item, or hold none while items are left."""
        following, item, packed, _ = state
        values = unpack(packed)
        (goes_on,) = interpreter.run(loop.params["cond_jaxpr"], read_all(values, [*test_consts, *loop.outvars]))
        return flags.packed(jnp.where(item < count, ~goes_on.item(), following < count))

    def refill(state):
        """Store the results of idle lanes, then begin new items in them, lane by lane.

        Two loops, as XLA copies columns that one loop both reads and writes, on every trip. The second counts down
        what the first has counted up: so it must come second, and nothing is copied between them either.
        """
        idle_lanes, (following, item, packed, results) = state

        def store_results(lane, state):
            following, results = state
            mine = map(partial(value_in_lane, lane), kept, packed, differing)
            ended = common | dict(zip(kept, mine, strict=True))
            interpreter.run_equations(after, ended)
            # What a lane without an item writes is overwritten by its next item, or by the last one.
            row = jnp.minimum(entry(item, lane), following)
            outputs = zip(results, read_all(ended, own_outputs), strict=True)
            return following + 1, [with_entry(result, value, row) for result, value in outputs]

        def begin_item(lane, state):
            following, item, packed = state
            number = following - 1
            begun = begin(jnp.minimum(number, count - 1), common)
            packed = [
                [with_entry(column, x, lane) for column, x in zip(columns, jnp.ravel(begun[v]), strict=True)]
                if is_written
                else columns
                for v, columns, is_written in zip(kept, packed, written, strict=True)
            ]
            return number, with_entry(item, number, lane), packed

        following, results = flags.for_each_lane(idle_lanes, store_results, (following, results))
        _, item, packed = flags.for_each_lane(idle_lanes, begin_item, (following, item, packed))
        state = following, item, packed, results
        return idle(state), state

    def trip(state):
        _, state = lax.while_loop(lambda state: flags.any_set(state[0]), refill, (idle(state), state))
        following, item, packed, results = state
        values = unpack(packed)
        interpreter.occupied = item < count if memory else None
        carry = interpreter.run(loop.params["body_jaxpr"], read_all(values, [*body_consts, *loop.outvars]))
        values |= zip(loop.outvars, carry, strict=True)
        return following, item, interpreter.pack(read_all(values, kept), differing), results

    copies = [
        split(jnp.broadcast_to(first[v], (width, *v.aval.shape))) if differs else first[v]
        for v, differs in zip(kept, differing, strict=True)
    ]
    results = [jnp.zeros((count, *v.aval.shape), v.aval.dtype) for v in own_outputs]
    state = jnp.int32(0), jnp.full((width,), count, jnp.int32), interpreter.pack(copies, differing), results
    # The counter is incremented once per lane at the start, then once per item whose results are stored.
    _, _, packed, results = lax.while_loop(lambda state: state[0] < count + width, trip, state)
    return [*results, *read_all(unpack(packed), memory_outputs)]
