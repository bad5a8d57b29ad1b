"""Calls that all processes make alike: a difference is found before they compute past each other."""

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
# Where a process has a function, in what Python prints of it.
_ADDRESS = re.compile(" at 0x[0-9a-f]+")


def fingerprint(x: object) -> str:
    """Hash of a scene's structure and arrays; names and files do not count. Of other arguments: of what they hold."""
    leaves, structure = jax.tree.flatten(jax.tree.map(_plain, x, is_leaf=lambda x: isinstance(x, Scene)))
    digest = hashlib.sha256(_ADDRESS.sub("", str(structure)).encode())
    for leaf in map(np.asarray, leaves):
        if leaf.dtype == object:  # whose bytes are where it is in memory
            continue
        digest.update(f"{leaf.dtype}{leaf.shape}".encode())
        digest.update(leaf.tobytes())
    return digest.hexdigest()[:16]


def _plain(x: object) -> object:
    """Something that is made of arrays alone."""
    if isinstance(x, Scene):
        return nameless(x)
    if callable(x):
        return None
    return vars(x) if is_dataclass(x) else x


def by_all(f: Callable[P, R]) -> Callable[P, R]:
    """f, whose kernels all processes share, if there are several: each must call it, and with the same arguments.

    It returns when they have done it. Within `jax.jit` and other transformations, where values are not known, none are
    compared. `progress` may differ.

    Raises:
        InputError: processes differ in what they call, or in an argument.
        ProcessLost: one has ended.
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
