"""Large arrays on all devices, which JAX copies at each call that needs them there; and on one without copies."""

from __future__ import annotations

import weakref
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pathjax.compile.jax_compat import is_traced

Tree = TypeVar("Tree")
# Bytes of an array that is worth it: less is copied in some ten microseconds, which keeping it takes, too.
_LARGE = 1 << 18
# By the address of an array: a reference to it, and the same numbers on all devices, for as long as it lives.
_kept: dict[int, tuple[weakref.ref, jax.Array]] = {}


def on_all_devices(tree: Tree, devices: int | None = None) -> Tree:
    """The tree, whose large arrays are those on all devices, for kernels that run there.

    CPU devices share one memory, so nothing is copied there. Traced values, and arrays that someone placed, stay.

    Args:
        devices: of `native_map`; if given, the tree stays.
    """
    if devices is not None or len(jax.devices()) == 1:
        return tree
    return jax.tree.map(lambda x: _replica(x) if _is_copied(x) else x, tree)


def _is_copied(x) -> bool:
    return isinstance(x, jax.Array) and not is_traced(x) and x.nbytes >= _LARGE and not x.committed


def _replica(x: jax.Array) -> jax.Array:
    kept = _kept.get(id(x))
    if kept is not None and kept[0]() is x:
        return kept[1]
    here, used = jax.local_devices(), jax.devices()
    # A view of a CPU device's memory, which other CPU devices take as it is. It keeps the memory, and not x.
    source = np.from_dlpack(x) if here[0].platform == "cpu" else x  # type: ignore[arg-type]
    copies = [x if {device} == x.devices() else jax.device_put(source, device) for device in here]
    everywhere = NamedSharding(Mesh(np.array(used), ("device",)), PartitionSpec())
    replica = jax.make_array_from_single_device_arrays(x.shape, everywhere, copies)
    key = id(x)
    _kept[key] = weakref.ref(x, lambda _: _kept.pop(key, None)), replica
    return replica


def on_one_device(x: jax.Array, axis: int) -> tuple[jax.Array, ...]:
    """What several CPU devices hold of an array, along an axis, as arrays of one of them: they share one memory.

    An array of which this cannot be said is returned as it is.
    """
    if not isinstance(x, jax.Array) or is_traced(x) or not x.is_fully_addressable or len(x.devices()) == 1:
        return (x,)
    pieces = {shard.index[axis].start or 0: shard.data for shard in x.addressable_shards}
    # Unless another axis is dealt, too.
    if sum(piece.size for piece in pieces.values()) != x.size or jax.default_backend() != "cpu":
        return (x,)
    return tuple(jax.device_put(np.from_dlpack(pieces[start])) for start in sorted(pieces))
