"""Calls that all processes must make alike: differences are detected before the computation begins."""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import distributed
from pathjax.compile import is_traced
from pathjax.scene.parameters import nameless
from pathjax.scene.scene import Scene

P = ParamSpec("P")
R = TypeVar("R")
# Memory address in a function's repr, which differs between processes.
_ADDRESS = re.compile(" at 0x[0-9a-f]+")


def fingerprint(x: object) -> str:
    """Return a hash of a scene's structure and arrays, without names and files, or of another argument's contents."""
    leaves, structure = jax.tree.flatten(jax.tree.map(_plain, x, is_leaf=lambda x: isinstance(x, Scene)))
    digest = hashlib.sha256(_ADDRESS.sub("", str(structure)).encode())
    for leaf in map(np.asarray, leaves):
        if leaf.dtype == object:  # its bytes are memory addresses
            continue
        digest.update(f"{leaf.dtype}{leaf.shape}".encode())
        digest.update(leaf.tobytes())
    return digest.hexdigest()[:16]


def _plain(x: object) -> object:
    """Reduce an object to its arrays."""
    if isinstance(x, Scene):
        return nameless(x)
    if callable(x):
        return None
    return vars(x) if is_dataclass(x) else x


def agreed_by_all(f: Callable[P, R]) -> Callable[P, R]:
    """Return f with a check that all processes, which share its kernels, call it with the same arguments.

    With several processes, it returns when the result is computed. Within `jax.jit` and other transformations, where
    values are traced, nothing is compared. `progress` may differ.

    Raises:
        InputError: processes differ in the function that they call, or in an argument.
        ProcessLost: a process has ended.
    """
    signature = inspect.signature(f)

    @wraps(f)
    def shared(*args: P.args, **kwargs: P.kwargs) -> R:
        if distributed.count() == 1 or any(map(is_traced, [jnp.zeros(()), *jax.tree.leaves((args, kwargs))])):
            return f(*args, **kwargs)
        given = signature.bind(*args, **kwargs)
        given.apply_defaults()
        with distributed.losses():
            distributed.same({"call": fingerprint(f.__name__)})
            facts = {f"{name} for {f.__name__}": x for name, x in given.arguments.items() if name != "progress"}
            distributed.same({name: fingerprint(x) for name, x in facts.items()})
            return jax.block_until_ready(f(*args, **kwargs))

    return shared
