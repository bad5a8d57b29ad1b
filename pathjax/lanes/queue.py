"""All items through the lanes: in groups, or from a queue."""

from __future__ import annotations


import jax.numpy as jnp
from jax import lax

from pathjax.lanes.flow import eqn_flow, read_by, variables, while_parts
from pathjax.lanes.machine import Lanes
from pathjax.core.math import at
from pathjax.lanes.values import differs, join, rows, split


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


def from_queue(machine: Lanes, program, xs, shared, place):
    """The same where equation `place` of the program is its `own_loop`: a lane that leaves it takes the next item."""
    width, count, jaxpr = machine.width, len(xs[0]), program.jaxpr
    before, loop, after = jaxpr.eqns[:place], jaxpr.eqns[place], jaxpr.eqns[place + 1 :]
    test_consts, body_consts, init = while_parts(loop, loop.invars)

    def values_of(items, common):
        """What is known before the loop; common: what all items share, where it is known already."""
        values = machine.environment(program, [*(rows(x, items) for x in xs), *shared]) | common
        machine.run_equations([eqn for eqn in before if any(v not in common for v in eqn.outvars)], values)
        return values

    first = values_of(jnp.zeros((width,), jnp.int32), {})
    common = {v: value for v, value in first.items() if not differs(value)}
    read_later = read_by(after) | variables([*test_consts, *body_consts, *jaxpr.outvars])
    own = [v for v in first if v in read_later and v not in common]
    # What a lane keeps of its item: what is known of it, then what the loop carries.
    kept = [*own, *loop.outvars]
    flags = [True] * len(own) + eqn_flow(loop, [differs(machine.read(first, v)) for v in loop.invars])
    shapes = [v.aval.shape for v in kept]

    def part(state, atoms):
        return [machine.read(state, v) for v in atoms]

    def unpacked(packed):
        return common | dict(zip(kept, machine.unpack(packed, flags, shapes), strict=True))

    def packed_from(values):
        return machine.pack([values[v] for v in kept], flags)

    def awaits(state):
        """(W,) whether a lane is done with its item, or has none while some are left."""
        following, item, packed, _ = state
        values = unpacked(packed)
        (goes_on,) = machine.run(loop.params["cond_jaxpr"], part(values, [*test_consts, *loop.outvars]))
        return jnp.where(item < count, ~goes_on.item(), following < count)

    def serve(state):
        """Put results away, and begin other items."""
        following, item, packed, results = state
        waits = awaits(state)
        old = unpacked(packed)
        ended = dict(old)
        machine.run_equations(after, ended)
        joined = [join(value, width) for value in part(ended, jaxpr.outvars)]

        def of_lane(lane, state):
            def put():
                following, item, results = state
                mine = at(item, lane)
                # A lane without an item writes what its next one overwrites.
                results = [
                    lax.dynamic_update_index_in_dim(result, at(value, lane), jnp.minimum(mine, following), 0)
                    for result, value in zip(results, joined, strict=True)
                ]
                return following + 1, item.at[lane].set(following), results

            return lax.cond(at(waits, lane), put, lambda: state)

        following, item, results = lax.fori_loop(0, width, of_lane, (following, item, results))
        begun = values_of(jnp.minimum(item, count - 1), common)
        begun |= zip(loop.outvars, part(begun, init), strict=True)
        new = {v: machine.select(waits, old[v], begun[v]) if f else old[v] for v, f in zip(kept, flags, strict=True)}
        return following, item, packed_from(new), results

    def trip(state):
        following, item, packed, results = lax.while_loop(lambda s: jnp.any(awaits(s)), serve, state)
        values = unpacked(packed)
        new = machine.run(loop.params["body_jaxpr"], part(values, [*body_consts, *loop.outvars]))
        return following, item, packed_from(values | dict(zip(loop.outvars, new, strict=True))), results

    first |= zip(loop.outvars, part(first, init), strict=True)
    results = [jnp.zeros((count, *v.aval.shape), v.aval.dtype) for v in jaxpr.outvars]
    state = jnp.int32(0), jnp.full((width,), count, jnp.int32), packed_from(first), results
    *_, results = lax.while_loop(lambda s: (s[0] < count) | jnp.any(s[1] < count), trip, state)
    return results
