"""Compiled programs, such as solvers, cached for the next fit of the same problem."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable

import equinox as eqx
import jax
import numpy as np


class Stepper:
    """A compiled optimistix solver that is run step by step."""

    def __init__(self, solver, fn: Callable, y, arguments):
        def begin(y, arguments):
            f, aux = jax.eval_shape(fn, y, arguments)
            return solver.init(fn, y, arguments, {}, f, aux, frozenset())

        def step(y, state, arguments):
            y, state, aux = solver.step(fn, y, arguments, {}, state, frozenset())
            done, _ = solver.terminate(fn, y, arguments, {}, state, frozenset())
            return y, state, aux, done

        self.begin = eqx.filter_jit(begin).lower(y, arguments).compile()
        self.step = eqx.filter_jit(step).lower(y, self.begin(y, arguments), arguments).compile()


# The latest programs of this process, by solver, parameters and shapes, so that fits of the same problem compile once.
_programs: dict = {}
_MAX_PROGRAMS = 12


def compiled(key: Hashable, make: Callable, *arguments):
    """Return make(*arguments), cached by the key and the arguments' shapes, and the seconds that this call took."""
    leaves, tree = jax.tree.flatten(arguments)
    key = key, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    started = time.perf_counter()
    if key not in _programs:
        if len(_programs) >= _MAX_PROGRAMS:
            del _programs[next(iter(_programs))]
        _programs[key] = make(*arguments)
    return _programs[key], time.perf_counter() - started


def identity(solver) -> Hashable:
    """Return a key: equal for solvers of one class with the same hyperparameters, functions and arrays, else not."""
    leaves, tree = jax.tree.flatten(solver)
    return tree, tuple(_identity(leaf) for leaf in leaves)


def _identity(leaf) -> Hashable:
    if isinstance(leaf, jax.Array | np.ndarray):
        leaf = np.asarray(leaf)
        return leaf.shape, leaf.dtype, leaf.tobytes()
    return type(leaf), leaf  # 1 and 1.0 make different programs
