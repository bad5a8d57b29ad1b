"""Analysis of which values of a program may differ between lanes."""

from __future__ import annotations

from collections.abc import Callable

from pathjax.compile.jax_compat import ClosedJaxpr, Literal, called_program, scan_parts, while_parts
from pathjax.compile.primitives import basis_p, persistent_test_p, together_p


def variables(atoms) -> set:
    """Non-literal atoms."""
    return {atom for atom in atoms if not isinstance(atom, Literal)}


def variables_read_by(eqns) -> set:
    return variables(atom for eqn in eqns for atom in eqn.invars)


def differing_in(program: ClosedJaxpr, inputs_differ: list[bool]) -> Callable:
    """Return a function that tells for atoms of a program whether each may differ between lanes if these inputs do."""
    differing = {v for v, d in zip(program.jaxpr.invars, inputs_differ, strict=True) if d}

    def differ(atoms) -> list[bool]:
        return [not isinstance(atom, Literal) and atom in differing for atom in atoms]

    for eqn in program.jaxpr.eqns:
        outputs_differ = equation_outputs_differ(eqn, differ(eqn.invars))
        differing.update(v for v, d in zip(eqn.outvars, outputs_differ, strict=True) if d)
    return differ


def program_outputs_differ(program: ClosedJaxpr, inputs_differ: list[bool]) -> list[bool]:
    return differing_in(program, inputs_differ)(program.jaxpr.outvars)


def equation_outputs_differ(eqn, inputs_differ: list[bool]) -> list[bool]:
    if eqn.primitive is basis_p:
        return [True]  # as components, so that its zeros are known
    if eqn.primitive is together_p:
        return [False] * len(eqn.outvars)
    match eqn.primitive.name:
        case "while":
            return _while_outputs_differ(eqn, inputs_differ)
        case "scan":
            return _scan_outputs_differ(eqn, inputs_differ)
        case "cond":
            which_differs, *operands_differ = inputs_differ
            results = [program_outputs_differ(branch, operands_differ) for branch in eqn.params["branches"]]
            return [which_differs or any(each) for each in zip(*results, strict=True)]
    called = called_program(eqn)
    if called is None:
        return [any(inputs_differ)] * len(eqn.outvars)
    return program_outputs_differ(called, inputs_differ)


def _while_outputs_differ(eqn, inputs_differ):
    test_consts, body_consts, carry = while_parts(eqn, inputs_differ)
    memory = carried_memory(eqn)

    def step(carry):
        (goes_on,) = program_outputs_differ(eqn.params["cond_jaxpr"], test_consts + carry)
        results = program_outputs_differ(eqn.params["body_jaxpr"], body_consts + carry)
        return [(goes_on and not is_memory) or d for d, is_memory in zip(results, memory, strict=True)]

    return _fixpoint(step, carry)


def carried_memory(eqn) -> list[bool]:
    """Return for each carried value of a while loop whether it is the memory of `together`, which lanes share."""
    body = eqn.params["body_jaxpr"].jaxpr
    changed = variables(v for e in body.eqns if e.primitive is together_p for v in e.outvars)
    return [not isinstance(v, Literal) and v in changed for v in body.outvars]


def _scan_outputs_differ(eqn, inputs_differ):
    consts, carry, xs = scan_parts(eqn, inputs_differ)

    def step(carry):
        return program_outputs_differ(eqn.params["jaxpr"], consts + carry + xs)

    carry = _fixpoint(lambda carry: step(carry)[: len(carry)], carry)
    return carry + step(carry)[len(carry) :]


def _fixpoint(step, flags: list[bool]) -> list[bool]:
    """Raise flags by `step` until none changes."""
    while (raised := [a or b for a, b in zip(flags, step(flags), strict=True)]) != flags:
        flags = raised
    return flags


def find_persistent_loop(program: ClosedJaxpr, differ: Callable) -> int | None:
    """Return the index of the equation that is the `persistent_loop`; None: there is none, or lanes leave it together.

    Args:
        differ: result of `differing_in`.
    """

    def is_persistent(eqn):
        if eqn.primitive.name != "while":
            return False
        test = eqn.params["cond_jaxpr"].jaxpr
        return any(e.primitive is persistent_test_p and e.outvars == test.outvars for e in test.eqns)

    def lanes_differ(eqn):
        test_consts, *_ = while_parts(eqn, differ(eqn.invars))
        return any(program_outputs_differ(eqn.params["cond_jaxpr"], test_consts + differ(eqn.outvars)))

    found = [number for number, eqn in enumerate(program.jaxpr.eqns) if is_persistent(eqn)]
    if len(found) > 1:
        raise ValueError("an item has one persistent_loop; make the shorter ones a jax.lax.while_loop")
    return found[0] if found and lanes_differ(program.jaxpr.eqns[found[0]]) else None
