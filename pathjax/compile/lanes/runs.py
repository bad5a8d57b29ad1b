"""Branches that cost much, each run for those lanes alone that take it.

Lanes of one branch are listed one after another, and laid side by side a few at a time. So the branches together cost
what one costs for all lanes, and to gather what they read and to bring back their results comes on top.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import lax

from pathjax.compile.jax_compat import ClosedJaxpr
from pathjax.compile.lanes import flags
from pathjax.compile.lanes.columns import as_components, differs, gathered, with_entry
from pathjax.compile.lanes.dataflow import variables, variables_read_by
from pathjax.compile.lanes.primitive_rules import COMPONENTWISE

# Lanes that run a branch at once: a few vectors of the processor, of which few are idle at the end of a run.
WIDTH = 64
# Operations on a number of all branches together, from which on this is quicker than to run them all and select; of a
# gathered number, in such operations. Both are as measured.
_LEAST_WORK, _GATHER = 1000, 20


def pays(width: int, branches: tuple[ClosedJaxpr, ...]) -> bool:
    """Whether branches are best run so. One that does nothing is taken by lanes that wait for others."""
    work = list(map(_work, branches))
    return width > WIDTH and min(work) > 0 and sum(work) > _LEAST_WORK


def _work(program: ClosedJaxpr) -> int:
    """Operations on a number, those of a loop once."""
    total = 0
    for eqn in program.jaxpr.eqns:
        values = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple) else (value,))]
        inner = [value for value in values if hasattr(value, "jaxpr")]
        name = eqn.primitive.name
        each = _GATHER if name in ("dynamic_slice", "gather") else name in COMPONENTWISE
        numbers = sum(math.prod(v.aval.shape) for v in eqn.outvars)
        total += sum(map(_work, inner)) if inner else each * numbers
    return total


def _read_by_any(branches) -> list[bool]:
    """Of each operand."""
    programs = [branch.jaxpr for branch in branches]
    read = [variables_read_by(jaxpr.eqns) | variables(jaxpr.outvars) for jaxpr in programs]
    by_branch = ([v in r for v in jaxpr.invars] for jaxpr, r in zip(programs, read, strict=True))
    return list(map(any, zip(*by_branch, strict=True)))


def in_runs(interpreter, which, branches: tuple[ClosedJaxpr, ...], operands: list) -> list:
    """Results of the branch that each lane takes; which: (W,) int32 its number."""
    width, size = interpreter.width, interpreter.width + WIDTH
    active = jnp.ones((width,), bool) if interpreter.active is None else interpreter.active

    def enlist(lane, state):
        listed, order, place = state
        return listed + 1, with_entry(order, lane, listed), with_entry(place, listed, lane)

    def enlist_all(k, state):
        listed, ends = state
        listed = flags.for_each_lane(flags.packed(active & (which == k)), enlist, listed)
        return listed, with_entry(ends, listed[0], k + 1)

    listed = jnp.int32(0), jnp.zeros((size,), jnp.int32), jnp.zeros((width,), jnp.int32)
    ends = jnp.zeros((len(branches) + 1,), jnp.int32)
    (_, order, place), ends = lax.fori_loop(0, len(branches), enlist_all, (listed, ends))

    # What is read lies in that order, once for all branches: a run of lanes reads it from one place on.
    def in_order(x, is_read):
        if not differs(x) or not is_read:
            return x
        return as_components(x.shape, [gathered(item, order) if jnp.ndim(item) else item for item in x.flat])

    operands = interpreter.materialize(list(map(in_order, operands, _read_by_any(branches))))
    outputs = branches[0].out_avals
    narrow = type(interpreter)(WIDTH)
    results = [[jnp.zeros((size,), aval.dtype)] * math.prod(aval.shape) for aval in outputs]
    for k, branch in enumerate(branches):
        first, end = ends[k], ends[k + 1]

        def step(state, branch=branch, end=end):
            first, results = state

            def mine(x):
                if not differs(x):
                    return x
                window = (lax.dynamic_slice(item, (first,), (WIDTH,)) if jnp.ndim(item) else item for item in x.flat)
                return as_components(x.shape, window)

            narrow.active = jnp.arange(WIDTH) < end - first
            found = narrow.pack(narrow.run(branch, list(map(mine, operands))), [True] * len(outputs))
            # What is written beyond the run's end is written again by the next one.
            stored = [
                [lax.dynamic_update_slice(whole, part, (first,)) for whole, part in zip(*columns, strict=True)]
                for columns in zip(results, found, strict=True)
            ]
            return first + WIDTH, stored

        def goes_on(state, end=end):
            return state[0] < end

        _, results = lax.while_loop(goes_on, step, (first, results))
    return [
        as_components(aval.shape, [gathered(column, place) for column in columns])
        for aval, columns in zip(outputs, results, strict=True)
    ]
