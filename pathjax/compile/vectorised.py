"""The form for accelerators: `vmap` over items, which leaves whole what they share.

JAX's own rule of a conditional whose lanes differ gives each lane a copy of every operand, of the tables that a branch
looks things up in too: 3 MB a lane for a mesh of 70,000 triangles. Here both branches read the one table.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from pathjax.compile.jax_compat import Literal, called_program, program_of, scan_parts, while_parts
from pathjax.compile.primitives import one_by_one_p


def vectorised(f: Callable, xs, shared):
    """`f(x, *shared)` for every x of `xs`, pytrees of arrays (N, ...), at once."""
    item, structure = jax.tree.flatten(jax.tree.map(lambda x: x[0], xs))
    result = None

    def flat(*leaves):
        nonlocal result
        outputs, result = jax.tree.flatten(f(jax.tree.unflatten(structure, leaves), *shared))
        return outputs

    # Some accelerators round the factors of a product of matrices to 10 bits unless they are told not to.
    with jax.default_matmul_precision("highest"):
        program, consts = program_of(flat, *item)
    rows = jax.vmap(lambda *leaves: _evaluate(program, *consts, *leaves))(*jax.tree.leaves(xs))
    return jax.tree.unflatten(result, rows)


def _evaluate(program, *inputs) -> list:
    """Results of a program, whose conditionals are those of `_switch`."""
    jaxpr = program.jaxpr
    known = dict(zip(jaxpr.constvars, program.consts, strict=True)) | dict(zip(jaxpr.invars, inputs, strict=True))

    def values(atoms):
        return [atom.val if isinstance(atom, Literal) else known[atom] for atom in atoms]

    for eqn in jaxpr.eqns:
        known |= dict(zip(eqn.outvars, _apply(eqn, values(eqn.invars)), strict=True))
    return values(jaxpr.outvars)


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
    """`lax.switch`; where lanes differ all branches run, and each lane picks its results."""

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
    """The rows that lanes take, each of one of the cases (N, ...)."""
    shape = (len(which),) + (1,) * (cases[0].ndim - 1)
    return lax.select_n(jnp.broadcast_to(which.reshape(shape), cases[0].shape), *cases)
