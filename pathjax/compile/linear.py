"""A linear function with a transpose of its own, for maps that are cheap both ways but by different methods."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.compile.jax_compat import Primitive, ad, batching, jaxpr_as_fun, mlir, program_of
from pathjax.errors import InputError

linear_p = Primitive("linear_with_transpose")
linear_p.multiple_results = True


def linear(f: Callable, transpose: Callable, known, x):
    """Return f(known, x), which is linear in x, a pytree of arrays.

    Its transpose is transpose(known, cotangent of the result). JAX's transformations see a linear function: derivatives
    in x, their transposes, and derivatives of the transpose work. Derivatives in `known` do not exist. `jax.vmap` runs
    its calls one after another.

    Raises:
        InputError: a derivative in `known` is requested.
    """
    known_leaves, known_tree = jax.tree.flatten(known)
    leaves, tree = jax.tree.flatten(x)
    results = jax.tree.structure(jax.eval_shape(f, known, x))

    def flat(function, tree):
        def called(known, leaves):
            return jax.tree.leaves(function(jax.tree.unflatten(known_tree, known), jax.tree.unflatten(tree, leaves)))

        return called

    return jax.tree.unflatten(results, _bind(flat(f, tree), flat(transpose, results), known_leaves, leaves))


def _bind(f, transpose, known, leaves):
    # Traced to a program, so that JAX sees which devices it uses.
    program, constants = program_of(lambda *inputs: f(inputs[: len(known)], inputs[len(known) :]), *known, *leaves)
    inputs = *constants, *known, *leaves
    sizes = len(constants), len(constants) + len(known)
    return linear_p.bind(*inputs, program=program, f=f, transpose=transpose, sizes=sizes)


def _call(*inputs, program, **params):
    return jaxpr_as_fun(program)(*inputs)


def _jvp(primals, tangents, **params):
    _, known = params["sizes"]
    if any(type(tangent) is not ad.Zero for tangent in tangents[:known]):
        raise InputError("second derivatives are not supported where derivatives are made without a Jacobian")
    changes = map(ad.instantiate_zeros, tangents[known:])
    return linear_p.bind(*primals, **params), linear_p.bind(*primals[:known], *changes, **params)


def _transpose(cotangents, *inputs, program, f, transpose, sizes):
    constants, known = sizes
    given = list(map(ad.instantiate_zeros, cotangents))
    return [None] * known + _bind(transpose, f, inputs[constants:known], given)


def _batch(inputs, axes, **params):
    def one(entries):
        following = iter(entries)
        mine = (x if axis is None else next(following) for x, axis in zip(inputs, axes, strict=True))
        return linear_p.bind(*mine, **params)

    batched = [jnp.moveaxis(x, axis, 0) for x, axis in zip(inputs, axes, strict=True) if axis is not None]
    results = lax.map(one, batched)
    return results, [0] * len(results)


linear_p.def_impl(_call)
linear_p.def_abstract_eval(lambda *avals, program, **params: program.out_avals)
mlir.register_lowering(linear_p, mlir.lower_fun(_call, multiple_results=True))
ad.primitive_jvps[linear_p] = _jvp
ad.primitive_transposes[linear_p] = _transpose
batching.primitive_batchers[linear_p] = _batch
