"""The totals of the derivatives of all vertices: a list with a row per entry or, for few entries, a column per scalar.

XLA's own scatter would break the native kernel, so lanes add to a list one after another, several of them per trip.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.core.math import at
from pathjax.derivatives.record import Slot

# Up to this many entries every lane sums up by itself.
FEW = 8
# Bytes of a list that stays in near caches.
NEAR = 1 << 19
# Scalars of a list entry: three, and one more so that they are one vector, added at once, and lie in one cache line.
WIDTH = 4
# Lanes that add to a list in one trip of a loop: the overhead of a trip is that of several adds.
AT_ONCE = 4

# For few entries, a column for each of their scalars; else the list, to which whole vectors are added.
Total = list[Float[Array, " W"]] | Float[Array, "entries 4"]


def start(entries: int, lanes: int, dtype) -> Total:
    """Return a total of zeros."""
    few = entries <= FEW
    return [jnp.zeros((lanes,), dtype)] * (3 * entries) if few else jnp.zeros((entries, WIDTH), dtype)


def count(total: Total) -> int:
    """Return the number of entries."""
    return len(total) // 3 if isinstance(total, list) else len(total)


def finish(total: Total) -> Float[Array, "entries 4"]:
    """Return the list, from either form of total."""
    if isinstance(total, list):
        total = jnp.pad(jnp.stack([jnp.sum(x) for x in total]).reshape(-1, 3), [(0, 0), (0, WIDTH - 3)])
    return total


def add(total: Total, slot: Slot, change: list[Float[Array, " W"]]) -> Total:
    """Return the total with each lane's change (3) added."""
    if isinstance(total, list):
        for place, share in zip(slot.places, slot.shares or [None], strict=True):
            total = [t + jnp.where(place == k // 3, _part(change, share)[k % 3], 0) for k, t in enumerate(total)]
        return total

    places, first = slot.places, 0
    if total.size * total.dtype.itemsize > NEAR:
        adds = (change[0] != 0) | (change[1] != 0) | (change[2] != 0)
        places = [jnp.where(adds, place, 0) for place in places]
        first = _read_ahead(total, places)

    # A lane without a change adds 0.
    def one(lane, total):
        of_lane = partial(jax.tree.map, lambda column: at(column, lane))
        x = _as_entry(of_lane(change))
        for place, share in of_lane(list(zip(places, slot.shares or [None], strict=True))):
            where = place.astype(jnp.uint32), jnp.uint32(0)
            more = x if share is None else x * (_as_entry(share) if isinstance(share, list) else share)
            new = lax.dynamic_slice(total, where, more.shape, allow_negative_indices=False) + more
            total = lax.dynamic_update_slice(total, new, where, allow_negative_indices=False)
        return total

    at_once = AT_ONCE if len(change[0]) % AT_ONCE == 0 else 1

    def several(trip, total):
        for k in range(at_once):
            total = one(trip * at_once + k, total)
        return total

    return lax.fori_loop(first, len(change[0]) // at_once, several, total)


def _as_entry(numbers: list[Float[Array, ""]]) -> Float[Array, "1 4"]:
    """Return three scalars as a list entry. `jnp.stack` would compile to branches, one after another."""
    k = jnp.arange(WIDTH)
    x = jnp.zeros_like(numbers[0])
    for channel, number in enumerate(numbers):
        x = jnp.where(k == channel, number, x)
    return x[None]


def _read_ahead(total: Float[Array, "entries 4"], places: Sequence[Int[Array, " W"]]) -> Int[Array, ""]:
    """Read all places, so that they are in a near cache, and return 0.

    Processors have many reads of far memory in flight at a time but few adds, since each add delays those after it. The
    result depends on the values read, so that the compiler keeps the reads.
    """
    read = sum(total.at[place.astype(jnp.uint32), 0].get(mode="promise_in_bounds") * 0 for place in places)
    return jnp.where(jnp.sum(read) > 0, 1, 0)


def _part(change, share):
    """Return three scalars times their share: one for all, or one of each; None: 1."""
    if share is None:
        return change
    return [s * x for s, x in zip(share if isinstance(share, list) else [share] * 3, change, strict=True)]
