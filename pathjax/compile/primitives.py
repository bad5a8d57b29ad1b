"""What code of one item may say to `lanes`: six primitives, with all rules that JAX's transformations need.

Five change no result, and outside of lanes they do next to nothing. `together` changes what all items share.
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
    """A pytree of arrays, whose consumers all read one result.

    XLA fuses what is computed into each of its consumers, so a value that five results share is computed five times.
    In lanes it is not; elsewhere this is `lax.optimization_barrier`. A value that is computed by few operations, or
    that has one consumer, is better left to XLA: what is computed once is written to memory and read back.
    """
    leaves, structure = jax.tree.flatten(values)
    return jax.tree.unflatten(structure, compute_once_p.bind(*leaves) if leaves else [])


def basis(count: int, dtype):
    """Tangents (count, count) of as many numbers, one after another: the identity.

    `jax.vmap` pushes them through a function all at once. Lanes know the zeros, and compute nothing of what is zero
    because of them: so the tangent of a number costs only what depends on the number. In a function that has a
    `persistent_loop` it stands in the loop's body.
    """
    return basis_p.bind(count=count, dtype=np.dtype(dtype))


def one_by_one(f: Callable) -> Callable:
    """f, which lanes run for one after another of those that are in the branch, or the loop, where it stands.

    For a search whose lanes would go different ways. Within it, JAX's control flow is real control flow.
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
    """A search in parts, functions that may close over arrays. Its state is a pytree; of zeros, it is done."""

    begin: F  # () -> state, of which `visit` does not come next
    opens: F  # state -> whether `open` comes next
    open: F  # state -> state: the usual step; leaves a search done that is done
    visits: F  # state -> whether `visit` comes next; if neither does, the search is done
    visit: F  # state -> state: a step that comes less often, or costs more
    result: F  # state -> results


@dataclass(frozen=True)
class Part:
    """A function of a `Search` as a program, called with all inputs of the search and with its state."""

    program: ClosedJaxpr
    places: tuple[int, ...]  # of the inputs that it reads

    @cached_property
    def _once(self) -> Callable:
        """The program as one function of XLA's, however many slots call it: traced once, and once lowered."""
        return jax.jit(jaxpr_as_fun(self.program))

    def __call__(self, inputs, *state):
        return self._once(*(inputs[place] for place in self.places), *state)

    def reads(self) -> list[int]:
        """Which of the arrays of the state it reads."""
        jaxpr = self.program.jaxpr
        read = {id(v) for v in [*jaxpr.outvars, *(v for eqn in jaxpr.eqns for v in eqn.invars)]}
        return [k for k, v in enumerate(jaxpr.invars[len(self.places) :]) if id(v) in read]


def interleaved(search: Search):
    """Results of a search, of which lanes run several at once, as each alone waits for memory most of the time.

    In all else it is what `one_by_one` makes of a function that runs the search.
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
    """`lax.while_loop`, from which each lane goes on to its next item, instead of waiting for the longest.

    For the loop that most of an item's work consists of. Lanes do so where it stands in the item's function itself, not
    within other control flow, and once; otherwise it is an ordinary loop. What stands before it is done when a lane
    begins an item, what stands after it when the lane is done with it, both for one lane alone: so both are short.
    """
    return lax.while_loop(lambda state: persistent_test_p.bind(jnp.asarray(test(state))), body, state)


def unset(values):
    """A pytree of arrays that a persistent_loop begins with, and its body sets before it reads them.

    A lane that takes its next item need not write them: there it finds what the last one left.
    """
    return jax.tree.map(unset_p.bind, values)


def together(f: Callable) -> Callable:
    """f(memory, here, values) -> memory, called by one item as (memory, values), and by lanes once for all of them.

    Memory is a pytree of arrays that items share, like a table to which each of them adds: the only thing by which one
    item may leave anything to another. f gets the flags (W,) of the lanes that hold an item, and the values, numbers of
    an item, as (W,) arrays. It stands in the body of a `persistent_loop` that carries the memory, and in no branch; see
    `lanes`. Outside of lanes an item is the only lane.
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
    """The same of tangents or cotangents, of which some are known to be zero."""
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

# What lanes make of it, column by column: a barrier that fusion sees, where XLA's own is gone before.
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
    """Tangents come from a program of their own, linear in those of the inputs, so that it transposes."""
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

# Stands behind the test of the loop, a bool: so JAX's own rules of loops transform it, and it has no derivative.
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
    """Under `jax.vmap` no item shares its memory with others."""
    outputs = jax.vmap(lambda *inputs: _alone(*inputs, **params), axes)(*inputs)
    return outputs, [0] * len(outputs)


# Derivatives are made of it, and it has none.
together_p.def_impl(_alone)
batching.primitive_batchers[together_p] = _together_batch
together_p.def_abstract_eval(lambda *avals, f, shared: avals[:shared])
mlir.register_lowering(together_p, mlir.lower_fun(_alone, multiple_results=True))
