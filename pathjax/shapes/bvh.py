"""Traversal of the 8-wide hierarchy of `bvh_build`, one ray, front to back."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.core.math import at, larger, smaller

WIDTH = 8
NO_HIT = np.int32(0x7FFFFFFF)  # as a primitive: none; as the bits of a distance: beyond infinity


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Tree:
    bounds: jax.Array  # (N, 2, 3, 8) lower and upper planes of the children; empty slots are turned inside out
    child: jax.Array  # (N, 8) int32: > 0 an inner node, < 0 the leaf ~child
    depth: int = field(metadata={"static": True})  # levels of inner nodes: the size of the stack


def order_bits(t):
    """int32 that orders as the positive float t does. (Integer minima vectorise, float minima do not.)"""
    if t.dtype == jnp.float64:
        # The upper half of a double orders like the double, up to 2^-20: enough to sort nodes by.
        return (lax.bitcast_convert_type(t, jnp.int64) >> 32).astype(jnp.int32)
    return lax.bitcast_convert_type(t, jnp.int32)


def traverse(tree: Tree, leaf, o, d, t, primitive):
    """Visit the leaves that the ray o + s d, 0 <= s <= t, may hit, nearest first.

    Args:
        leaf: (number of the leaf, t, primitive) -> (t, primitive) after testing it; a negative t ends the search.
        o, d: (3,) origin and unit direction.
        t: () the farthest distance of interest; shrinks as hits are found.
        primitive: () int32, carried along.
    Returns:
        t, primitive.

    The stack holds, for each level, a node and a sort key for each of its children: the bits of the distance at which
    the ray enters the child, the slot in the lowest three. Its smallest entry is the next child to visit, and an entry
    beyond t ends the level. The slabs are widened by the rounding errors of the test (Ize 2013, "Robust BVH ray
    traversal"), so no ray slips between the boxes of two triangles that share an edge.
    """
    eps = np.finfo(d.dtype).eps
    lane = jnp.arange(WIDTH, dtype=jnp.int32)
    slot_bits = np.int32(WIDTH - 1)

    # A component of zero becomes one that moves the ray less than rounding does over any distance in range.
    tiny = np.asarray(1e-18, d.dtype)
    inv = 1 / jnp.where(jnp.abs(d) < tiny, jnp.copysign(tiny, d), d)
    start = o * inv
    slack = jnp.abs(start) * (2 * eps)
    negative = (d < 0).astype(jnp.int32)
    inv, start_near, start_far, negative = lax.optimization_barrier((inv, start + slack, start - slack, negative))

    def keys_of_children(node, t):
        near = [at(tree.bounds, node, negative[a], a) * inv[a] - start_near[a] for a in range(3)]
        far = [at(tree.bounds, node, 1 - negative[a], a) * inv[a] - start_far[a] for a in range(3)]
        enter = larger(near[0], larger(near[1], larger(near[2], jnp.zeros_like(t))))
        leave = smaller(far[0], smaller(far[1], smaller(far[2], t)))
        hit = enter <= leave * (1 + 4 * eps)
        return jnp.where(hit, (order_bits(enter) & ~slot_bits) | lane, NO_HIT)

    def visit_next(state):
        level, nodes, keys, t, primitive = state
        row = at(keys, level)
        key = jnp.min(row)

        def visit(nodes, keys):
            child = at(tree.child, at(nodes, level), key & slot_bits)
            keys = lax.dynamic_update_index_in_dim(keys, jnp.where(row == key, NO_HIT, row), level, 0)

            def test_leaf(nodes, keys):
                return level, nodes, keys, *leaf(~child, t, primitive)

            def open_node(nodes, keys):
                nodes = lax.dynamic_update_index_in_dim(nodes, child, level + 1, 0)
                keys = lax.dynamic_update_index_in_dim(keys, keys_of_children(child, t), level + 1, 0)
                return level + 1, nodes, keys, t, primitive

            return lax.cond(child < 0, test_leaf, open_node, nodes, keys)

        def leave_level(nodes, keys):
            return level - 1, nodes, keys, t, primitive

        return lax.cond(key <= order_bits(t), visit, leave_level, nodes, keys)

    def more(state):
        level, _, _, t, _ = state
        return (level >= 0) & (t >= 0)

    nodes = jnp.zeros(tree.depth, jnp.int32)
    keys = jnp.full((tree.depth, WIDTH), NO_HIT).at[0].set(keys_of_children(jnp.int32(0), t))
    return lax.while_loop(more, visit_next, (jnp.int32(0), nodes, keys, t, primitive))[3:]
