"""The form for accelerators: `vmap` over items, without copies of the arrays that items share.

JAX's own batching rule for a conditional whose lanes differ gives each lane a copy of every operand, including tables
that a branch reads: 3 MB per lane for a mesh of 70,000 triangles. Here both branches read the one table.

As many items run at once as fit into memory, each in a lane. A lane that leaves a `persistent_loop` takes another item,
so that lanes do not wait for the longest item.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from pathjax.compile.jax_compat import ClosedJaxpr, Literal, called_program, program_of, scan_parts, while_parts
from pathjax.compile.lanes.dataflow import differing_in, find_persistent_loop, variables, variables_read_by
from pathjax.compile.primitives import one_by_one_p
from pathjax.system import memory

# Lanes that fill an accelerator, as many as an H100 holds threads; lanes whose values stay in the caches of a CPU.
MOST_LANES, MOST_LANES_OF_CPU = 1 << 18, 1 << 10
# Lanes may take 1 / _SHARE of memory, as the live bytes are an estimate and others need memory, too; _MEMORY is the
# memory that is assumed where its size is unknown.
_SHARE, _MEMORY = 8, 1 << 33
# One lane in so many may be idle before idle lanes begin other items, which costs all lanes a little.
_IDLE = 8


def vectorised(f: Callable, xs, shared):
    """Return `f(x, *shared)` for every x of `xs`; both are pytrees of arrays (N, ...)."""
    rows, (program, consts, structure) = jax.tree.leaves(xs), _program(f, xs, shared)
    count, width = len(rows[0]), lanes_at_once(program, len(consts))
    differ = differing_in(program, [False] * len(consts) + [True] * len(rows))
    loop = find_persistent_loop(program, differ)
    if count <= width:
        ys = _at_once(program, consts, rows)
    elif loop is not None:
        ys = _from_queue(program, loop, differ, consts, rows, width)
    else:
        parted = _chunks(rows, width, [x[:1] for x in rows])
        ys = lax.map(lambda rows: _at_once(program, consts, rows), parted)
        ys = [y.reshape(-1, *y.shape[2:])[:count] for y in ys]
    return jax.tree.unflatten(structure, ys)


def vectorised_sum(f: Callable, xs, shared):
    """Return the sum of f over all items, and over items of zeros, which fill up the last chunk."""
    program, consts, structure = _program(f, xs, shared)
    rows = jax.tree.leaves(xs)

    def add(total, rows):
        return [x + y.sum(0) for x, y in zip(total, _at_once(program, consts, rows), strict=True)], None

    zeros = [jnp.zeros(aval.shape, aval.dtype) for aval in program.out_avals]
    parted = _chunks(rows, lanes_at_once(program, len(consts)), [jnp.zeros_like(x[:1]) for x in rows])
    return jax.tree.unflatten(structure, lax.scan(add, zeros, parted)[0])


def most_lanes() -> int:
    return MOST_LANES_OF_CPU if jax.default_backend() == "cpu" else MOST_LANES


def lanes_at_once(program: ClosedJaxpr, consts: int = 0) -> int:
    """Return how many items of a program run at once, as memory allows; its first `consts` inputs are shared."""
    fit = (memory.limit() or _MEMORY) // _SHARE // max(live_bytes(program, consts), 1)
    return max(min(fit, most_lanes()), 1)


def live_bytes(program: ClosedJaxpr, consts: int = 0) -> int:
    """Return the most bytes of one item's values that are live at once if nothing is fused or updated in place."""
    jaxpr = program.jaxpr
    last = {v: k for k, eqn in enumerate(jaxpr.eqns) for v in variables(eqn.invars)}
    last |= dict.fromkeys(variables(jaxpr.outvars), len(jaxpr.eqns))
    dying: dict[int, int] = {}
    live = most = 0

    def begin(v, k):
        nonlocal live
        size = math.prod(v.aval.shape) * v.aval.dtype.itemsize
        live += size
        end = last.get(v, k)
        dying[end] = dying.get(end, 0) + size

    for v in jaxpr.invars[consts:]:
        begin(v, -1)
    for k, eqn in enumerate(jaxpr.eqns):
        values = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple) else (value,))]
        inner = [x if isinstance(x, ClosedJaxpr) else ClosedJaxpr(x, ()) for x in values if hasattr(x, "eqns")]
        within = max((live_bytes(program, len(program.jaxpr.invars)) for program in inner), default=0)
        for v in eqn.outvars:
            begin(v, k)
        most = max(most, live + within)
        live -= dying.pop(k, 0)
    return max(most, live)


def _program(f: Callable, xs, shared):
    """Trace f of one item.

    Returns:
        The program, the arrays that f closes over, which are its first inputs, and the tree structure of its results.
    """
    item, structure = jax.tree.flatten(jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs))
    result = None

    def flat(*leaves):
        nonlocal result
        outputs, result = jax.tree.flatten(f(jax.tree.unflatten(structure, leaves), *shared))
        return outputs

    # By default some accelerators round the factors of a matrix product to 10 bits.
    with jax.default_matmul_precision("highest"):
        return *program_of(flat, *item), result


def _at_once(program, consts, rows) -> list:
    return jax.vmap(lambda *leaves: _evaluate(program, *consts, *leaves))(*rows)


def _chunks(rows: list, width: int, more: list) -> list:
    """Split rows into chunks of one size, of at most `width` items; the last one is filled up with the item `more`."""
    count = len(rows[0])
    chunks = -(-count // width)
    each = -(-count // chunks)

    def split(x, item):
        x = jnp.concatenate([x, jnp.broadcast_to(item, (each * chunks - count, *x.shape[1:]))])
        return x.reshape(chunks, each, *x.shape[1:])

    return list(map(split, rows, more))


def _from_queue(program, place: int, differ: Callable, consts, rows, width: int) -> list:
    """Results (N, ...), where equation `place` of the program is a `persistent_loop`."""
    jaxpr, count = program.jaxpr, len(rows[0])
    before, loop, after = jaxpr.eqns[:place], jaxpr.eqns[place], jaxpr.eqns[place + 1 :]
    test_consts, body_consts, init = while_parts(loop, loop.invars)
    test, body = loop.params["cond_jaxpr"], loop.params["body_jaxpr"]

    def begun(*leaves) -> dict:
        known = _run(before, _inputs(program, [*consts, *leaves]))
        return known | dict(zip(loop.outvars, _values(known, init), strict=True))

    first = begun(*(x[0] for x in rows))
    common = {v: x for v, x in first.items() if v not in loop.outvars and not differ([v])[0]}
    # State of a lane: values of its item that are computed before the loop and read later, then the loop's carry.
    read_later = variables_read_by(after) | variables([*test_consts, *body_consts, *jaxpr.outvars])
    own = [v for v in first if v in read_later and v not in common and v not in loop.outvars]
    kept = [*own, *loop.outvars]

    def of_lanes(f):
        mapped = jax.vmap(lambda *values: f(common | dict(zip(kept, values, strict=True))))
        return lambda lanes: mapped(*lanes)

    begin = jax.vmap(lambda *leaves: _values(begun(*leaves), kept))
    goes_on = of_lanes(lambda known: _evaluate(test, *_values(known, [*test_consts, *loop.outvars]))[0])
    advanced = of_lanes(
        lambda known: _values(known, own) + _evaluate(body, *_values(known, [*body_consts, *loop.outvars]))
    )
    ended = of_lanes(lambda known: _values(_run(after, known), jaxpr.outvars))

    def chosen(which, yes, no):
        return [_pick(which.astype(jnp.int32), (b, a)) for a, b in zip(yes, no, strict=True)]

    def refill(state):
        """Store the results of lanes that do not go on, and begin the next items in them."""
        following, item, on, lanes, results = state
        row = jnp.where(on, count, item)  # lanes without an item write past the end, too
        results = [x.at[row].set(y, mode="drop") for x, y in zip(results, ended(lanes), strict=True)]
        number = jnp.minimum(following + jnp.cumsum(~on, dtype=jnp.int32) - 1, count)
        item = jnp.where(on, item, number)
        lanes = chosen(on, lanes, begin(*(x[jnp.minimum(item, count - 1)] for x in rows)))
        following = jnp.minimum(following + jnp.count_nonzero(~on).astype(jnp.int32), count)
        return following, item, (item < count) & goes_on(lanes), lanes, results

    def trip(state):
        idle = jnp.count_nonzero(~state[2])
        due = (state[0] < count) & (idle * _IDLE >= width)
        following, item, on, lanes, results = lax.cond(due, refill, lambda state: state, state)
        lanes = chosen(on, advanced(lanes), lanes)
        return following, item, on & goes_on(lanes), lanes, results

    nobody = jnp.full((width,), count, jnp.int32)
    lanes = [jnp.broadcast_to(first[v], (width, *v.aval.shape)) for v in kept]
    results = [jnp.zeros((count, *v.aval.shape), v.aval.dtype) for v in jaxpr.outvars]
    state = jnp.int32(0), nobody, jnp.zeros((width,), bool), lanes, results
    state = lax.while_loop(lambda state: (state[0] < count) | jnp.any(state[2]), trip, state)
    return refill(state)[-1]


def _inputs(program, inputs) -> dict:
    """Return the values by variable before a program's first equation."""
    jaxpr = program.jaxpr
    return dict(zip([*jaxpr.constvars, *jaxpr.invars], [*program.consts, *inputs], strict=True))


def _values(known: dict, atoms) -> list:
    return [atom.val if isinstance(atom, Literal) else known[atom] for atom in atoms]


def _run(eqns, known: dict) -> dict:
    """Return the values together with the results of equations, with `_switch` for conditionals."""
    known = dict(known)
    for eqn in eqns:
        known |= zip(eqn.outvars, _apply(eqn, _values(known, eqn.invars)), strict=True)
    return known


def _evaluate(program, *inputs) -> list:
    """Return the results of a program."""
    return _values(_run(program.jaxpr.eqns, _inputs(program, inputs)), program.jaxpr.outvars)


def _apply(eqn, inputs) -> list:
    if (called := called_program(eqn)) is not None:
        return _evaluate(called, *inputs)
    if eqn.primitive is one_by_one_p:
        return _evaluate(eqn.params["program"], *inputs)
    match eqn.primitive.name:
        case "cond":
            which, *operands = inputs
            return _switch([partial(_evaluate, branch) for branch in eqn.params["branches"]], which, operands)
        case "while":
            test_consts, body_consts, carry = while_parts(eqn, inputs)
            test, body = (partial(_evaluate, eqn.params[name]) for name in ("cond_jaxpr", "body_jaxpr"))
            return lax.while_loop(lambda c: test(*test_consts, *c)[0], lambda c: body(*body_consts, *c), carry)
        case "scan":
            consts, carry, xs = scan_parts(eqn, inputs)

            def step(carry, row):
                results = _evaluate(eqn.params["jaxpr"], *consts, *carry, *row)
                return results[: len(carry)], results[len(carry) :]

            carry, ys = lax.scan(step, carry, xs, eqn.params["length"], eqn.params["reverse"])
            return [*carry, *ys]
    result = eqn.primitive.bind(*inputs, **eqn.params)
    return list(result) if eqn.primitive.multiple_results else [result]


def _switch(branches, which, operands) -> list:
    """Run `lax.switch`; where lanes differ, all branches run, and each lane picks its results."""

    @custom_vmap
    def switch(which, *operands):
        return lax.switch(which, branches, *operands)

    @switch.def_vmap
    def _(size, batched, which, *operands):
        which_differs, *operands_differ = batched
        axes = [0 if differs else None for differs in operands_differ]
        of_lanes = [jax.vmap(branch, axes, axis_size=size) for branch in branches]
        if not which_differs:
            results = lax.switch(which, of_lanes, *operands)
        else:
            results = [_pick(which, cases) for cases in zip(*(branch(*operands) for branch in of_lanes), strict=True)]
        return results, [True] * len(results)

    return switch(which, *operands)


def _pick(which, cases):
    """Pick, for each lane, its row of one of the cases (N, ...)."""
    shape = (len(which),) + (1,) * (cases[0].ndim - 1)
    return lax.select_n(jnp.broadcast_to(which.reshape(shape), cases[0].shape), *cases)
