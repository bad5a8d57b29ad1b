"""Traversal of the 8-wide hierarchy of `accel.build` by one ray, in octant order."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import Search, interleaved, register_dataclass
from pathjax.core.math import at, integer_like, larger, smaller

WIDTH = 8


@register_dataclass
@dataclass(frozen=True)
class Tree:
    # (N, 7, 8) integers as wide as the reals: bits of the children's lower planes x, y, z and upper planes, NaN in
    # empty slots; then the child: > 0 an inner node, < 0 the leaf ~child. One block: a visit misses the cache once.
    nodes: jax.Array
    depth: int = field(metadata={"static": True})  # levels of inner nodes: the size of the stack


def pack(built, dtype) -> Tree:
    """Pack the hierarchy that `accel.build` returned."""
    if len(built.child) >> 31 - WIDTH:
        raise ValueError(f"a BVH has fewer than 2^{31 - WIDTH} nodes, not {len(built.child)}")
    planes = built.bounds.reshape(-1, 6, WIDTH).astype(dtype)
    integer = integer_like(planes.dtype)
    nodes = np.concatenate([planes.view(integer), built.child[:, None].astype(integer)], 1)
    return Tree(nodes, built.depth)


def prepare(o, d):
    """Return constants of a ray o (3,), d (3,) unit: (9,) reciprocal of d and slab offsets, () uint32 octant."""
    eps = np.finfo(d.dtype).eps
    # Replace a zero component by one that moves the ray by less than rounding does, over any distance in range.
    tiny = np.asarray(1e-18, d.dtype)
    inv = 1 / jnp.where(jnp.abs(d) < tiny, jnp.copysign(tiny, d), d)
    negative = (d < 0).astype(jnp.int32)
    # Widen slabs by the rounding of o, o / d and the product (Ize 2013): a few ulps of the coordinates.
    start, slack = o * inv, jnp.abs(o * inv) * (4 * eps)
    # Unsigned like the axes of triangles: in lanes, all scalars of one type that a ray has share one array.
    octant = (negative[0] + 2 * negative[1] + 4 * negative[2]).astype(jnp.uint32)
    return jnp.concatenate([inv, start + slack, start - slack]), octant


def enter(tree: Tree, prepared, t):
    """Return the first entry of `traverse`, () uint32; 0 if the ray meets no child of the root at 0 <= s <= t."""
    ray, octant = prepared
    boxes = _box(tree, jnp.int32(0), ray).T

    # Child by child, vectorised over lanes: eight children side by side made up an eighth of the whole program.
    def add(slot, entry):
        bit = jnp.left_shift(jnp.uint32(1), slot.astype(jnp.uint32) ^ octant)
        return entry | jnp.where(_meets(at(boxes, slot), ray, t), bit, 0)

    return lax.fori_loop(0, WIDTH, add, jnp.uint32(0))


class _State(NamedTuple):
    free: Int[Array, ""]  # index of the first unused entry of the stack
    entry: Int[Array, ""]  # the next entry; 0: the search is done
    child: Int[Array, ""]  # its first child: >= 0 a node, < 0 the leaf ~child
    stack: Int[Array, " levels"]
    t: Float[Array, ""]
    found: Any


def traverse(tree: Tree, leaf, prepared, entry, t, found, result=lambda t, found: (t, found)):
    """Visit the leaves that the ray o + s d, 0 <= s <= t, may hit, near ones first.

    Args:
        leaf: (index of the leaf, t, found) -> (t, found) after testing it; a negative t ends the search.
        prepared: of `prepare`; entry: of `enter`.
        t: () maximum distance; shrinks as hits are found.
        found: pytree of arrays, carried along.
        result: (t, found) at the end -> results.

    The children of a node that are still to be visited are bits of a mask: bit k is the child in slot k ^ octant. The
    builder chooses slots so that ascending bits run front to back for rays of that octant. An entry is a node's index
    above its mask; the stack holds entries with nonempty masks, above a 0 that ends the search. No other state is kept,
    since every buffer that a loop carries costs instructions in every iteration.
    """
    ray, octant = prepared

    def first_child(entry):
        slot = (lax.population_count(~entry & (entry - 1)).astype(jnp.uint32) ^ octant) & (WIDTH - 1)
        return at(tree.nodes, entry >> WIDTH, 6, slot).astype(jnp.int32)

    def rest_of(entry):
        """Return the entry without its first child, and whether any child is left."""
        rest = entry & (entry - 1)
        return rest, rest & ((1 << WIDTH) - 1) != 0

    def push(stack, entry, free):
        return lax.dynamic_update_slice(stack, entry[None], (free.astype(jnp.uint32),), allow_negative_indices=False)

    def begin():
        stack = jnp.zeros((tree.depth + 2,), jnp.int32)
        root = entry.astype(jnp.int32)
        child = first_child(root)
        # A search begins by opening a node: if its first child is a leaf, it opens the root again.
        at_node = (child > 0) | (root == 0)
        start = jnp.where(at_node, root, -1 << WIDTH), jnp.where(at_node, child, 0)
        return _State(jnp.int32(1), *start, stack, t, found)

    def open_node(state):
        free, entry, child, stack, t, found = state
        # A search that is done meets no child, pushes nothing, and pops the 0 at the bottom for ever.
        below = _hit_children(tree, child, ray, _weights(octant, entry != 0), t)
        rest, some = rest_of(entry)
        # Push the rest, then the children that are met, unless they are empty; then pop.
        stack = push(stack, rest, free)
        free = free + some.astype(jnp.int32)
        stack = push(stack, jnp.where(below != 0, child << WIDTH | below, 0), free)
        free = jnp.maximum(free - (below == 0).astype(jnp.int32), 0)
        entry = at(stack, free)
        return _State(free, entry, first_child(entry), stack, t, found)

    def visit_leaf(state):
        free, entry, child, stack, t, found = state
        t, found = leaf(~child, t, found)
        rest, some = rest_of(entry)
        # Push the rest and pop it again: a branch would be mispredicted too often.
        stack = push(stack, rest, free)
        free = free - (~some).astype(jnp.int32)
        entry = jnp.where(t < 0, 0, at(stack, free))
        return _State(free, entry, first_child(entry), stack, t, found)

    return interleaved(
        Search(
            begin=begin,
            opens=lambda state: (state.entry != 0) & (state.child >= 0),
            open=open_node,
            visits=lambda state: (state.entry != 0) & (state.child < 0),
            visit=visit_leaf,
            result=lambda state: result(state.t, state.found),
        )
    )


def _weights(octant, is_any=True):
    """Return the bit of each slot in an entry, (8,) int32; all 0 unless `is_any`."""
    return jnp.left_shift(jnp.int32(is_any), (jnp.arange(WIDTH, dtype=jnp.uint32) ^ octant).astype(jnp.int32))


def _hit_children(tree: Tree, node, ray, weights, t):
    """Return the mask, () int32, of the children of a node that a ray meets at 0 <= s <= t."""
    return jnp.sum(jnp.where(_meets(_box(tree, node, ray), ray, t), weights, 0), dtype=jnp.int32)


def _box(tree: Tree, node, ray):
    """Return the planes (7, 8) of the children of a node; the last row is not a plane and must be ignored."""
    return lax.bitcast_convert_type(at(tree.nodes, node), ray.dtype)


def _meets(box, ray, t):
    """Return (...) bool: whether a ray meets boxes (7, ...) at 0 <= s <= t."""
    low = [box[axis] * ray[axis] for axis in range(3)]
    high = [box[3 + axis] * ray[axis] for axis in range(3)]
    near = [smaller(low[axis], high[axis]) - ray[3 + axis] for axis in range(3)]
    far = [larger(low[axis], high[axis]) - ray[6 + axis] for axis in range(3)]
    # NaN of an empty slot propagates as the second argument, and fails the comparison.
    enter = larger(larger(larger(jnp.zeros_like(t), near[2]), near[1]), near[0])
    leave = smaller(smaller(far[0], far[1]), smaller(far[2], t))
    eps = np.finfo(ray.dtype).eps
    return enter <= leave * (1 + 5 * eps)
