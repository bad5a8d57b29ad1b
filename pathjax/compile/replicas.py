"""Replicate arrays on all devices once, instead of at each call; and read results on one device without a copy."""

from __future__ import annotations

import weakref
from functools import partial
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pathjax.compile.jax_compat import is_traced

Tree = TypeVar("Tree")
# id of an array -> (weak reference to it, its replica). An entry lives as long as its array.
_kept: dict[int, tuple[weakref.ref, jax.Array]] = {}


def on_all_devices(tree: Tree, devices: int | None = None) -> Tree:
    """Return a pytree with its arrays replicated on all devices, for kernels that run on all of them.

    CPU devices share one memory, so their replicas are views. Traced values, and arrays that a user has placed on
    devices, stay as they are.

    Args:
        devices: as in `native_map`; if given, the pytree is returned as it is.
    """
    if devices is not None or len(jax.devices()) == 1:
        return tree
    leaves, structure = jax.tree.flatten(tree)
    copied = [x for x in leaves if isinstance(x, jax.Array) and not is_traced(x) and not x.committed]
    new = list({id(x): x for x in copied if id(x) not in _kept}.values())
    for x, replica in zip(new, _replicas(new), strict=True):
        _kept[id(x)] = weakref.ref(x, partial(_forget, id(x))), replica
    found = {id(x): _kept[id(x)][1] for x in copied}
    return jax.tree.unflatten(structure, [found.get(id(x), x) for x in leaves])


def _forget(key: int, _: weakref.ref) -> None:
    _kept.pop(key, None)


def _replicas(arrays: list[jax.Array]) -> list[jax.Array]:
    """Return the arrays replicated on all devices of all processes, of which each process makes its own copies."""
    here = jax.local_devices()
    everywhere = NamedSharding(Mesh(np.array(jax.devices()), ("device",)), PartitionSpec())
    with jax.ensure_compile_time_eval():  # within a user's jit too, where replicas must not be tracers
        # CPU devices use views of each other's memory without a copy. Views keep the memory alive, but not the arrays.
        sources = [np.from_dlpack(x) for x in arrays] if here[0].platform == "cpu" else arrays  # type: ignore[arg-type]
        copies = zip(*(jax.device_put(sources, device) for device in here), strict=True)
        return [
            jax.make_array_from_single_device_arrays(x.shape, everywhere, list(of_devices))
            for x, of_devices in zip(arrays, copies, strict=True)
        ]


def on_one_device(x: jax.Array, axis: int) -> tuple[jax.Array, ...]:
    """Return an array that is sharded over CPU devices along an axis as arrays of one device: they share one memory.

    Any other array is returned as it is.
    """
    if not isinstance(x, jax.Array) or is_traced(x) or not x.is_fully_addressable or len(x.devices()) == 1:
        return (x,)
    pieces = {shard.index[axis].start or 0: shard.data for shard in x.addressable_shards}
    # Unless another axis is dealt, too.
    if sum(piece.size for piece in pieces.values()) != x.size or jax.default_backend() != "cpu":
        return (x,)
    return tuple(jax.device_put(np.from_dlpack(pieces[start])) for start in sorted(pieces))
