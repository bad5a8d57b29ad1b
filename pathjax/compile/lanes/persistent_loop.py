"""All items through the lanes: in groups, or from a queue."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from jax import lax

from pathjax.compile.lanes.columns import join, split
from pathjax.compile.lanes.dataflow import read_by, variables, while_parts
from pathjax.compile.lanes.interpreter import Lanes, in_turn, of_lane, put, some, words_of
from pathjax.core.math import at


def in_groups(machine: Lanes, program, xs, shared):
    """Results (N, ...) of all items; the lanes of a group begin and end together."""
    width, count = machine.width, len(xs[0])
    groups = -(-count // width)

    def grouped(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[:1], (groups * width - count, *x.shape[1:]))])
        return x.reshape(groups, width, *x.shape[1:])

    def one_group(xs):
        return [join(y, width) for y in machine.run(program, [*map(split, xs), *shared])]

    return [y.reshape(groups * width, *y.shape[2:])[:count] for y in lax.map(one_group, list(map(grouped, xs)))]


def from_queue(machine: Lanes, program, xs, shared, place, flags):
    """The same where equation `place` of the program is its `own_loop`: a lane that leaves it takes the next item.

    flags: of `flags_of`.
    """
    width, count, jaxpr = machine.width, len(xs[0]), program.jaxpr
    before, loop, after = jaxpr.eqns[:place], jaxpr.eqns[place], jaxpr.eqns[place + 1 :]
    test_consts, body_consts, init = while_parts(loop, loop.invars)

    def begin(item, common):
        """Values before the loop, of one item; common: what all items share, where it is known already."""
        values = machine.environment(program, [*(at(x, item) for x in xs), *shared]) | common
        machine.run_equations([eqn for eqn in before if any(v not in common for v in eqn.outvars)], values)
        return values | {v: machine.read(values, atom) for v, atom in zip(loop.outvars, init, strict=True)}

    first = begin(jnp.int32(0), {})
    common = {v: value for v, value in first.items() if v not in loop.outvars and not flags([v])[0]}
    # What a lane keeps of its item: what is made of it before the loop and read later, then what the loop carries.
    read_later = read_by(after) | variables([*test_consts, *body_consts, *jaxpr.outvars])
    own = [v for v in first if v in read_later and v not in common and v not in loop.outvars]
    kept = [*own, *loop.outvars]
    differing = [True] * len(own) + flags(loop.outvars)
    shapes = [v.aval.shape for v in kept]
    dtypes = [v.aval.dtype for v in kept]

    def part(values, atoms):
        return [machine.read(values, v) for v in atoms]

    def unpacked(packed):
        return common | dict(zip(kept, machine.unpack(packed, differing, shapes), strict=True))

    def packed_from(values):
        return machine.pack([values[v] for v in kept], differing)

    def awaits(state):
        """Flags of lanes that are done with their item, or have none while some are left."""
        following, item, packed, _ = state
        values = unpacked(packed)
        (goes_on,) = machine.run(loop.params["cond_jaxpr"], part(values, [*test_consts, *loop.outvars]))
        return words_of(jnp.where(item < count, ~goes_on.item(), following < count))

    def serve(state):
        """Put results away, then begin other items, lane by lane.

        In two rounds, as XLA copies columns that a loop both reads and writes, on every trip. The second counts down
        what the first has counted up: so it comes second, and nothing is copied between them either.
        """
        waiting, (following, item, packed, results) = state

        def put_away(lane, state):
            following, results = state
            mine = map(partial(of_lane, lane), packed, differing, shapes, dtypes)
            ended = common | dict(zip(kept, mine, strict=True))
            machine.run_equations(after, ended)
            # A lane without an item writes what its next one, or the last, overwrites.
            row = jnp.minimum(at(item, lane), following)
            outputs = zip(results, part(ended, jaxpr.outvars), strict=True)
            results = [lax.dynamic_update_index_in_dim(result, value, row, 0) for result, value in outputs]
            return following + 1, results

        def take_next(lane, state):
            following, item, packed = state
            number = following - 1
            begun = begin(jnp.minimum(number, count - 1), common)
            packed = [
                [put(column, x, lane) for column, x in zip(columns, jnp.ravel(begun[v]), strict=True)] if d else columns
                for v, columns, d in zip(kept, packed, differing, strict=True)
            ]
            return number, put(item, number, lane), packed

        following, results = in_turn(waiting, put_away, (following, results))
        _, item, packed = in_turn(waiting, take_next, (following, item, packed))
        state = following, item, packed, results
        return awaits(state), state

    def trip(state):
        _, (following, item, packed, results) = lax.while_loop(lambda s: some(s[0]), serve, (awaits(state), state))
        values = unpacked(packed)
        new = machine.run(loop.params["body_jaxpr"], part(values, [*body_consts, *loop.outvars]))
        return following, item, packed_from(values | dict(zip(loop.outvars, new, strict=True))), results

    copies = [
        split(jnp.broadcast_to(first[v], (width, *v.aval.shape))) if d else first[v]
        for v, d in zip(kept, differing, strict=True)
    ]
    packed = machine.pack(copies, differing)
    results = [jnp.zeros((count, *v.aval.shape), v.aval.dtype) for v in jaxpr.outvars]
    state = jnp.int32(0), jnp.full((width,), count, jnp.int32), packed, results
    # A number is taken by each lane at first, then for each item that is put away.
    *_, results = lax.while_loop(lambda s: s[0] < count + width, trip, state)
    return results
