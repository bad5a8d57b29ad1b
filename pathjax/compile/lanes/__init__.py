"""Transform a function of one item into a function of many lanes, with every component of an item in its own register.

`jax.vmap` puts an axis in front of each array: the x of two points then lie three apart, and stacking them costs
branches, so that LLVM vectorises little. This transformation keeps the components of every small array apart, each an
array (W,) over the lanes. Structure (stack, slice, reshape) then costs nothing, arithmetic is SIMD across the lanes,
and values that all lanes share stay shared. Branches become selects; a loop runs until its last lane is done, but lanes
leave a `persistent_loop` one by one, each for its next item.

README.md beside this file shows a function, its program and its lane program, and lists the behaviour of XLA that this
relies on.
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
    """Return a function that runs f(x, *shared) for any number of items x, `width` at a time.

    Args:
        f: function of one item.
        width: W, the number of lanes.
        memory: the memory of `together`, a pytree of arrays; None: there is none. With memory, f is (x, *shared,
            memory) -> (y, memory), and its persistent loop, whose test must depend on the item, carries the memory.
    Returns:
        function (xs, *shared) -> ys, or (ys, memory after all items) with memory; xs and ys are pytrees of arrays
        (N, ...).
    Raises:
        ValueError: f holds two persistent loops, or memory is given and f holds none.
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
    """Pause Python's garbage collector: tracing creates many lasting objects, which it would scan again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
