"""Which values of a program may differ between lanes, and the parts of its equations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
from jax.extend import core


def variables(atoms) -> set:
    """Those that are no literals."""
    return {atom for atom in atoms if not isinstance(atom, core.Literal)}


def read_by(eqns) -> set:
    """Variables that equations read."""
    return variables(atom for eqn in eqns for atom in eqn.invars)


def callee(eqn) -> core.ClosedJaxpr | None:
    """What a call runs; None: this is no call."""
    if eqn.primitive.name == "call_hi_primitive":  # jax 0.12, of what it writes in other primitives
        return jax.make_jaxpr(partial(eqn.primitive.to_lojax, **eqn.params))(*(v.aval for v in eqn.invars))
    for key in ("jaxpr", "call_jaxpr"):
        if key in eqn.params:
            program = eqn.params[key]
            return program if hasattr(program, "consts") else core.ClosedJaxpr(program, ())
    return None


def while_parts(eqn, values):
    """Values of a while loop: constants of the condition, of the body, what is carried."""
    n, m = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    return values[:n], values[n : n + m], values[n + m :]


def scan_parts(eqn, values):
    """Values of a scan: constants, what is carried, what is taken row by row."""
    if "num_consts" in eqn.params:
        n, m = eqn.params["num_consts"], eqn.params["num_carry"]
    else:  # jax 0.12
        n, m, _ = (len(tree.vals) for tree in eqn.params["ft_in"].unpack())
    return values[:n], values[n : n + m], values[n + m :]


def settled(step, flags: list[bool]) -> list[bool]:
    """The least flags above these that `step` does not raise."""
    while (raised := [a or b for a, b in zip(flags, step(flags), strict=True)]) != flags:
        flags = raised
    return flags


def flags_of(program: core.ClosedJaxpr, differing: list[bool]) -> Callable:
    """A function from atoms of a program to whether each may differ between lanes if these inputs do."""
    known = {v for v, d in zip(program.jaxpr.invars, differing, strict=True) if d}

    def flags(atoms) -> list[bool]:
        return [not isinstance(atom, core.Literal) and atom in known for atom in atoms]

    for eqn in program.jaxpr.eqns:
        known.update(v for v, d in zip(eqn.outvars, eqn_flow(eqn, flags(eqn.invars)), strict=True) if d)
    return flags


def flow(program: core.ClosedJaxpr, differing: list[bool]) -> list[bool]:
    """Which results may differ."""
    return flags_of(program, differing)(program.jaxpr.outvars)


def own_loop(program: core.ClosedJaxpr, flags: Callable) -> int | None:
    """Number of the last equation of a program that is a loop which lanes leave at different times."""

    def leaves_alone(eqn):
        if eqn.primitive.name != "while":
            return False
        test_consts, *_ = while_parts(eqn, flags(eqn.invars))
        return any(flow(eqn.params["cond_jaxpr"], test_consts + flags(eqn.outvars)))

    return max((number for number, eqn in enumerate(program.jaxpr.eqns) if leaves_alone(eqn)), default=None)


def eqn_flow(eqn, inputs: list[bool]) -> list[bool]:
    if not any(inputs):
        return [False] * len(eqn.outvars)
    match eqn.primitive.name:
        case "while":
            return while_flow(eqn, inputs)
        case "scan":
            return scan_flow(eqn, inputs)
        case "cond":
            results = [flow(branch, inputs[1:]) for branch in eqn.params["branches"]]
            return [inputs[0] or any(each) for each in zip(*results, strict=True)]
    called = callee(eqn)
    return [True] * len(eqn.outvars) if called is None else flow(called, inputs)


def while_flow(eqn, inputs):
    test_consts, body_consts, carry = while_parts(eqn, inputs)

    def step(carry):
        (goes_on,) = flow(eqn.params["cond_jaxpr"], test_consts + carry)
        return [goes_on or d for d in flow(eqn.params["body_jaxpr"], body_consts + carry)]

    return settled(step, carry)


def scan_flow(eqn, inputs):
    consts, carry, xs = scan_parts(eqn, inputs)
    carry = settled(lambda carry: flow(eqn.params["jaxpr"], consts + carry + xs)[: len(carry)], carry)
    return carry + flow(eqn.params["jaxpr"], consts + carry + xs)[len(carry) :]
