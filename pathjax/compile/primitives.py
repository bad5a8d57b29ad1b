"""Primitives by which code of one item controls `lanes`, with all rules that JAX's transformations need.

`together` updates memory that all items share. The others change no result, and do next to nothing outside of lanes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.compile.jax_compat import (
    ClosedJaxpr,
    Primitive,
    ad,
    aval_of,
    batching,
    call_of_identity,
    jaxpr_as_fun,
    mlir,
    program_of,
)

compute_once_p = Primitive("compute_once")
compute_once_p.multiple_results = True
column_p = Primitive("computed_column")
one_by_one_p = Primitive("one_by_one")
one_by_one_p.multiple_results = True
persistent_test_p = Primitive("persistent_test")
unset_p = Primitive("unset")
basis_p = Primitive("basis")
together_p = Primitive("together")
together_p.multiple_results = True


def compute_once(values):
    """Return a pytree of arrays as it is, but computed once, however many consumers read it.

    XLA fuses a computation into each of its consumers, so a value that five results share is computed five times. This
    prevents it in lanes; elsewhere it is `lax.optimization_barrier`. A value that takes few operations, or that has one
    consumer, is better left to XLA: a value that is computed once is written to memory and read back.
    """
    leaves, structure = jax.tree.flatten(values)
    return jax.tree.unflatten(structure, compute_once_p.bind(*leaves) if leaves else [])


def basis(count: int, dtype):
    """Return the identity (count, count): one unit tangent per row, for that many scalars.

    `jax.vmap` pushes the rows through a function all at once. Lanes know the zeros, and skip whatever is zero because
    of them: so the tangent of a scalar costs only the operations that depend on the scalar. In a function that has a
    `persistent_loop`, call it in the loop's body.
    """
    return basis_p.bind(count=count, dtype=np.dtype(dtype))


def one_by_one(f: Callable) -> Callable:
    """Return f such that lanes run it one after another, for the lanes that are active where it is called.

    For a search in which lanes would diverge. Inside f, JAX's control flow is real control flow.
    """

    def called(*args):
        leaves, structure = jax.tree.flatten(args)
        results = None

        def flat(*leaves):
            nonlocal results
            outputs, results = jax.tree.flatten(f(*jax.tree.unflatten(structure, leaves)))
            return outputs

        program, consts = program_of(flat, *leaves)
        return jax.tree.unflatten(results, one_by_one_p.bind(*consts, *leaves, program=program, search=None))

    return called


F = TypeVar("F", bound=Callable)


@dataclass(frozen=True)
class Search(Generic[F]):
    """A search given as functions that may close over arrays. Its state is a pytree; all zeros: the search is done."""

    begin: F  # () -> state; `visit` must not be the next step
    opens: F  # state -> whether `open` is the next step
    open: F  # state -> state: the usual step; keeps a finished search finished
    visits: F  # state -> whether `visit` is the next step; if neither is, the search is done
    visit: F  # state -> state: a step that is rarer, or costs more
    result: F  # state -> results


@dataclass(frozen=True)
class Part:
    """A function of a `Search` as a program. It is called with all inputs of the search and its state."""

    program: ClosedJaxpr
    places: tuple[int, ...]  # indices of the inputs that it reads

    @cached_property
    def _once(self) -> Callable:
        """The program as one jitted function: traced and lowered once, however many slots call it."""
        return jax.jit(jaxpr_as_fun(self.program))

    def __call__(self, inputs, *state):
        return self._once(*(inputs[place] for place in self.places), *state)

    def reads(self) -> list[int]:
        """Return the indices of the arrays of the state that it reads."""
        jaxpr = self.program.jaxpr
        read = {id(v) for v in [*jaxpr.outvars, *(v for eqn in jaxpr.eqns for v in eqn.invars)]}
        return [k for k, v in enumerate(jaxpr.invars[len(self.places) :]) if id(v) in read]


def interleaved(search: Search):
    """Run a search and return its results; lanes run several at once, as a single one mostly waits for memory.

    Otherwise it is like `one_by_one` of a function that runs the search.
    """
    inputs: list[Any] = []
    state: list[jax.ShapeDtypeStruct] = []
    parts: list[Part] = []
    structures: dict[str, Any] = {}
    for name, f in vars(search).items():

        def flat(*leaves, name=name, f=f):
            args = [jax.tree.unflatten(structures["begin"], leaves)] if name != "begin" else []
            outputs, structures[name] = jax.tree.flatten(f(*args))
            return outputs

        program, consts = program_of(flat, *state)
        inputs += [const for const in consts if all(const is not x for x in inputs)]
        places = [next(k for k, x in enumerate(inputs) if x is const) for const in consts]
        parts.append(Part(program, tuple(places)))
        state = state or [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in program.out_avals]
    programs = Search(*parts)
    program, _ = program_of(lambda *inputs: _search_alone(programs, inputs), *inputs)
    return jax.tree.unflatten(structures["result"], one_by_one_p.bind(*inputs, program=program, search=programs))


def _search_alone(search: Search[Part], inputs):
    def opens(state):
        return search.opens(inputs, *state)[0]

    def visits(state):
        return search.visits(inputs, *state)[0]

    def go_on(state):
        state = lax.while_loop(opens, lambda state: search.open(inputs, *state), state)
        return lax.while_loop(visits, lambda state: search.visit(inputs, *state), state)

    state = lax.while_loop(lambda state: opens(state) | visits(state), go_on, search.begin(inputs))
    return search.result(inputs, *state)


def persistent_loop(test: Callable, body: Callable, state):
    """Run `lax.while_loop` such that a lane that leaves it begins its next item instead of waiting for other lanes.

    For the loop that holds most of an item's work. It must stand in the item's function itself, and only once; within
    other control flow it is an ordinary loop. The code before it runs when a lane begins an item, the code after it
    when the lane ends the item, both for a single lane at a time: so keep both short.
    """
    return lax.while_loop(lambda state: persistent_test_p.bind(jnp.asarray(test(state))), body, state)


def unset(values):
    """Mark a pytree of arrays as initial values of a persistent_loop that its body overwrites before it reads them.

    A lane that begins its next item then does not write them: they keep the values of its last item.
    """
    return jax.tree.map(unset_p.bind, values)


def together(f: Callable) -> Callable:
    """Return a function (memory, values) -> memory of one item, for which lanes call f once for all of them.

    Memory is a pytree of arrays that items share, like a table to which each of them adds: the only way to pass data
    from one item to another. The call must stand in the body of a `persistent_loop` that carries the memory, and not in
    a branch; see `lanes`. Outside of lanes an item is the only lane.

    Args:
        f: (memory, mask (W,) of the lanes that hold an item, values of all lanes (W, ...)) -> memory.
    """

    def called(memory, values):
        memory_leaves, memory_tree = jax.tree.flatten(memory)
        leaves, tree = jax.tree.flatten(values)

        def flat(memory, here, leaves):
            new = f(jax.tree.unflatten(memory_tree, memory), here, jax.tree.unflatten(tree, leaves))
            return jax.tree.leaves(new)

        out = together_p.bind(*memory_leaves, *leaves, f=flat, shared=len(memory_leaves))
        return jax.tree.unflatten(memory_tree, out)

    return called


# ---- compute_once ---------------------------------------------------------------------------------------------------


def _once_each(values):
    """Apply `compute_once` to tangents or cotangents, except symbolic zeros."""
    there = [value for value in values if type(value) is not ad.Zero]
    results = iter(compute_once_p.bind(*there) if there else ())
    return [value if type(value) is ad.Zero else next(results) for value in values]


compute_once_p.def_impl(lambda *values: list(map(jnp.asarray, values)))
compute_once_p.def_abstract_eval(lambda *avals: avals)
mlir.register_lowering(
    compute_once_p, mlir.lower_fun(lambda *values: lax.optimization_barrier(values), multiple_results=True)
)
batching.primitive_batchers[compute_once_p] = lambda values, axes: (compute_once_p.bind(*values), axes)
ad.primitive_jvps[compute_once_p] = lambda primals, tangents: (compute_once_p.bind(*primals), _once_each(tangents))
ad.primitive_transposes[compute_once_p] = lambda cotangents, *primals: _once_each(cotangents)

# Lanes lower compute_once to this, column by column: a barrier that is still there at fusion, unlike XLA's own.
column_p.def_impl(jnp.asarray)
column_p.def_abstract_eval(lambda column: column)
mlir.register_lowering(column_p, call_of_identity)
batching.defvectorized(column_p)
ad.deflinear2(column_p, lambda cotangent, _: [cotangent])


# ---- basis ----------------------------------------------------------------------------------------------------------


def _identity(*, count, dtype):
    return jnp.eye(count, dtype=dtype)


basis_p.def_impl(_identity)
basis_p.def_abstract_eval(lambda *, count, dtype: aval_of((count, count), dtype))
mlir.register_lowering(basis_p, mlir.lower_fun(_identity, multiple_results=False))


# ---- one_by_one -----------------------------------------------------------------------------------------------------


def _one_by_one_batch(inputs, axes, *, program, search):
    outputs = one_by_one(jax.vmap(jaxpr_as_fun(program), axes))(*inputs)
    return outputs, [0] * len(outputs)


def _one_by_one_jvp(primals, tangents, *, program, search):
    """Compute tangents by a separate program that is linear in the tangents of the inputs, so that it transposes."""
    moves = [type(tangent) is not ad.Zero for tangent in tangents]
    smooth = [np.issubdtype(aval.dtype, np.inexact) for aval in program.out_avals]

    def smooth_tangents(primals, tangents):
        def of(*moving):
            following = iter(moving)
            inputs = [next(following) if m else primal for m, primal in zip(moves, primals, strict=True)]
            return [y for y, s in zip(jaxpr_as_fun(program)(*inputs), smooth, strict=True) if s]

        return jax.jvp(of, [primal for m, primal in zip(moves, primals, strict=True) if m], tangents)[1]

    moving = [tangent for m, tangent in zip(moves, tangents, strict=True) if m]
    following = iter(one_by_one(smooth_tangents)(list(primals), moving))
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.out_avals]
    results = [next(following) if s else zero for s, zero in zip(smooth, zeros, strict=True)]
    return one_by_one_p.bind(*primals, program=program, search=search), results


def _one_by_one_transpose(cotangents, *inputs, program, search):
    linear = [ad.is_undefined_primal(x) for x in inputs]
    there = [type(cotangent) is not ad.Zero for cotangent in cotangents]

    def transposed(known, cotangents):
        def of(*unknown):
            rest, others = iter(known), iter(unknown)
            outputs = jaxpr_as_fun(program)(*(next(others) if is_linear else next(rest) for is_linear in linear))
            return [y for y, t in zip(outputs, there, strict=True) if t]

        shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in inputs if ad.is_undefined_primal(x)]
        return jax.linear_transpose(of, *shapes)(cotangents)

    known = [x for x, is_linear in zip(inputs, linear, strict=True) if not is_linear]
    given = [cotangent for cotangent, t in zip(cotangents, there, strict=True) if t]
    following = iter(one_by_one(transposed)(known, given))
    return [next(following) if is_linear else None for is_linear in linear]


def _one_by_one_inline(*inputs, program, search):
    return jaxpr_as_fun(program)(*inputs)


one_by_one_p.def_impl(_one_by_one_inline)
one_by_one_p.def_abstract_eval(lambda *avals, program, search: program.out_avals)
mlir.register_lowering(one_by_one_p, mlir.lower_fun(_one_by_one_inline, multiple_results=True))
batching.primitive_batchers[one_by_one_p] = _one_by_one_batch
ad.primitive_jvps[one_by_one_p] = _one_by_one_jvp
ad.primitive_transposes[one_by_one_p] = _one_by_one_transpose


# ---- persistent_loop ------------------------------------------------------------------------------------------------

# Applied to the loop's test, a bool: so JAX's own rules for loops transform the loop, and it needs no derivative.
persistent_test_p.def_impl(jnp.asarray)
persistent_test_p.def_abstract_eval(lambda goes_on: goes_on)
mlir.register_lowering(persistent_test_p, lambda context, goes_on: [goes_on])
batching.primitive_batchers[persistent_test_p] = lambda values, axes: (persistent_test_p.bind(*values), *axes)


# ---- unset ----------------------------------------------------------------------------------------------------------

unset_p.def_impl(jnp.asarray)
unset_p.def_abstract_eval(lambda value: value)
mlir.register_lowering(unset_p, lambda context, value: [value])
batching.defvectorized(unset_p)
ad.deflinear2(unset_p, lambda cotangent, _: [cotangent])


# ---- together -------------------------------------------------------------------------------------------------------


def _alone(*inputs, f, shared):
    return f(inputs[:shared], jnp.ones((1,), bool), [jnp.asarray(x)[None] for x in inputs[shared:]])


def _together_batch(inputs, axes, **params):
    """Give each item of `jax.vmap` a memory of its own."""
    outputs = jax.vmap(lambda *inputs: _alone(*inputs, **params), axes)(*inputs)
    return outputs, [0] * len(outputs)


# It is used to compute derivatives and has none itself.
together_p.def_impl(_alone)
batching.primitive_batchers[together_p] = _together_batch
together_p.def_abstract_eval(lambda *avals, f, shared: avals[:shared])
mlir.register_lowering(together_p, mlir.lower_fun(_alone, multiple_results=True))
