"""From a function of one item to the same function of many lanes, every number of an item in a register of its own.

`jax.vmap` puts an axis in front of each array: the x of two points then lie three apart, and stacking them costs
branches, so that LLVM vectorises little. This transformation keeps the components of every small array apart, each an
array (W,) over the lanes. Structure (stack, slice, reshape) then costs nothing, arithmetic is SIMD across the lanes,
and what all lanes share stays shared. Branches become selections; a loop goes on until its last lane is done, but a
`persistent_loop` is left by lanes one by one, each for the next item.

README.md beside this file shows a function, its program and what lanes make of it, and says what of XLA this relies on.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp

from pathjax.compile.lanes.dataflow import differing_in, find_persistent_loop
from pathjax.compile.lanes.interpreter import Interpreter
from pathjax.compile.lanes.scheduling import from_queue, in_groups

__all__ = ["lanes"]


def lanes(f: Callable, width: int, memory=None) -> Callable:
    """f(x, *shared) of any number of items x, `width` at a time.

    Args:
        memory: of `together`, a pytree of arrays. f is then (x, *shared, memory) -> (y, memory), where its persistent
            loop, which has no end that all items know, carries the memory.
    Returns:
        function of xs, a pytree of arrays (N, ...), and of what all items share, to pytrees of arrays (N, ...), and to
        the memory after all items, where there is one.
    Raises:
        ValueError: f holds two persistent loops.
    """
    memories = len(jax.tree.leaves(memory))

    @without_collections()
    def run(xs, *shared):
        shared = shared if memory is None else (*shared, memory)
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs)
        program, out = jax.make_jaxpr(f, return_shape=True)(one, *shared)
        xs, shared = jax.tree.leaves(xs), jax.tree.leaves(shared)
        if not len(xs[0]):
            return jax.tree.map(lambda y: jnp.zeros((0, *y.shape), y.dtype), out)
        interpreter = Interpreter(width)
        differing = differing_in(program, [True] * len(xs) + [False] * len(shared))
        loop = find_persistent_loop(program, differing)
        if memory is not None and loop is None:
            raise ValueError("memory is carried by the persistent_loop of an item, and there is none")
        if loop is None:
            outputs = in_groups(interpreter, program, xs, shared)
        else:
            outputs = from_queue(interpreter, program, xs, shared, loop, differing, memories)
        return jax.tree.unflatten(jax.tree.structure(out), outputs)

    return run


@contextlib.contextmanager
def without_collections() -> Iterator[None]:
    """Tracing makes many objects that stay, through all of which Python's collector would go time and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
