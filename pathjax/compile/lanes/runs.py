"""Expensive branches, each run only for the lanes that take it.

The lanes of a branch are listed, and gathered side by side a few at a time. So the branches together cost as much as
one branch for all lanes, plus gathering their inputs and scattering their results. A branch that costs less than that
is run for all lanes, as cheap branches always are.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.compile.jax_compat import ClosedJaxpr
from pathjax.compile.lanes import flags
from pathjax.compile.lanes.columns import as_components, differs, entry, gathered, with_entry
from pathjax.compile.lanes.dataflow import variables, variables_read_by
from pathjax.compile.lanes.primitive_rules import COMPONENTWISE

# Lanes that run a branch at once: one or two vectors of the processor. Few lanes take a branch, so that most lanes of a
# longer run would be idle.
WIDTH = 16
# Work in scalar operations, as measured: runs are faster than running all branches where the listed branches together
# have more than _LEAST_WORK; a branch of more than _LITTLE is listed; a gathered scalar counts as _GATHER.
_LEAST_WORK, _LITTLE, _GATHER = 1000, 200, 20


def pays(width: int, branches: tuple[ClosedJaxpr, ...]) -> bool:
    """Return whether runs pay for these branches. They do not if one does nothing: its lanes wait for the others."""
    work = list(map(_work, branches))
    return width > WIDTH and min(work) > 0 and sum(each for each in work if each > _LITTLE) > _LEAST_WORK


def _work(program: ClosedJaxpr) -> int:
    """Count the scalar operations of a program, those of a loop once."""
    total = 0
    for eqn in program.jaxpr.eqns:
        values = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple) else (value,))]
        inner = [value for value in values if hasattr(value, "jaxpr")]
        name = eqn.primitive.name
        each = _GATHER if name in ("dynamic_slice", "gather") else name in COMPONENTWISE
        numbers = sum(math.prod(v.aval.shape) for v in eqn.outvars)
        total += sum(map(_work, inner)) if inner else each * numbers
    return total


def in_runs(interpreter, which, branches: tuple[ClosedJaxpr, ...], operands: list) -> list:
    """Return the results of the branch that each lane takes; which: (W,) int32 index of the branch."""
    width, outputs = interpreter.width, branches[0].out_avals
    active = jnp.ones((width,), bool) if interpreter.active is None else interpreter.active
    costs_little = [_work(branch) <= _LITTLE for branch in branches]
    rare = [k for k, little in enumerate(costs_little) if not little]
    operands = interpreter.materialize(operands)

    # Cheap branches run for all lanes; a lane of an expensive branch gets its results from a run below.
    results = [as_components(aval.shape, [jnp.zeros((), aval.dtype)] * math.prod(aval.shape)) for aval in outputs]
    for k, branch in enumerate(branches):
        if costs_little[k]:
            found = interpreter.run_for(which == k, branch, operands)
            results = [interpreter.select(which == k, *cases) for cases in zip(results, found, strict=True)]
    columns = interpreter.pack(results, [True] * len(outputs))

    # List the lanes of the expensive branches, branch after branch.
    def enlist(lane, state):
        listed, order = state
        return listed + 1, with_entry(order, lane, listed)

    def enlist_all(place, state):
        listed, ends = state
        mine = active & (which == entry(jnp.array(rare, jnp.int32), place))
        listed = flags.for_each_lane(flags.packed(mine), enlist, listed)
        return listed, with_entry(ends, listed[0], place + 1)

    listed, ends = (jnp.int32(0), jnp.zeros((width + WIDTH,), jnp.int32)), jnp.zeros((len(rare) + 1,), jnp.int32)
    (_, order), ends = lax.fori_loop(0, len(rare), enlist_all, (listed, ends))
    for place, k in enumerate(rare):
        run = _run(type(interpreter)(WIDTH), branches[k], operands, order, ends[place + 1])
        _, columns = lax.while_loop(partial(_below, ends[place + 1]), run, (ends[place], columns))
    return [as_components(aval.shape, items) for aval, items in zip(outputs, columns, strict=True)]


def _run(narrow, branch: ClosedJaxpr, operands: list, order, end):
    """Return a function that runs a branch for WIDTH of the lanes in `order`, up to `end`, and stores their results.

    It takes and returns the position in `order` and the columns of the results.
    """

    def of_lanes(x, is_read, lanes):
        if not differs(x) or not is_read:
            return x
        return as_components(x.shape, [gathered(item, lanes) if jnp.ndim(item) else item for item in x.flat])

    def run(state):
        first, columns = state
        lanes = lax.dynamic_slice(order, (first,), (WIDTH,))
        inputs = [of_lanes(x, is_read, lanes) for x, is_read in zip(operands, _reads(branch), strict=True)]
        narrow.active = jnp.arange(WIDTH) < end - first
        found = narrow.pack(narrow.run(branch, narrow.materialize(inputs)), [True] * len(branch.out_avals))

        def store(state):
            n, columns = state
            lane = entry(lanes, n)
            pairs = zip(jax.tree.leaves(columns), jax.tree.leaves(found), strict=True)
            stored = [with_entry(column, entry(mine, n), lane) for column, mine in pairs]
            return n + 1, jax.tree.unflatten(jax.tree.structure(columns), stored)

        most = jnp.minimum(end - first, WIDTH)
        _, columns = lax.while_loop(partial(_below, most), store, (jnp.int32(0), columns))
        return first + WIDTH, columns

    return run


def _below(end, state):
    return state[0] < end


def _reads(branch: ClosedJaxpr) -> list[bool]:
    """Return for each operand whether the branch reads it."""
    read = variables_read_by(branch.jaxpr.eqns) | variables(branch.jaxpr.outvars)
    return [v in read for v in branch.jaxpr.invars]
