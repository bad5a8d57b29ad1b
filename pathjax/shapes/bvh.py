"""Traversal of the 8-wide hierarchy of `bvh_build`, one ray, in octant order."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.core.math import at, larger, smaller

WIDTH = 8


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Tree:
    bounds: jax.Array  # (N, 2, 3, 8) lower and upper planes of the children; NaN in empty slots
    child: jax.Array  # (N, 8) int32: > 0 an inner node, < 0 the leaf ~child
    depth: int = field(metadata={"static": True})  # levels of inner nodes: the size of the stack


def traverse(tree: Tree, leaf, o, d, t, primitive):
    """Visit the leaves that the ray o + s d, 0 <= s <= t, may hit, near ones first.

    Args:
        leaf: (number of the leaf, t, primitive) -> (t, primitive) after testing it; a negative t ends the search.
        o, d: (3,) origin and unit direction.
        t: () the farthest distance of interest; shrinks as hits are found.
        primitive: () int32, carried along.
    Returns:
        t, primitive.

    A node's children still to visit are the bits of a mask: bit k is the child in slot k ^ octant, which the builder
    has chosen so that ascending bits go away from a ray of that octant. The stack holds a node and a mask for each
    level. Nothing else is kept, since every buffer that the loop carries costs instructions in each of its trips;
    for the same reason the constants of the ray travel in one array.
    """
    eps = np.finfo(d.dtype).eps
    lane = jnp.arange(WIDTH, dtype=jnp.int32)
    # A component of zero becomes one that moves the ray less than rounding does over any distance in range.
    tiny = np.asarray(1e-18, d.dtype)
    inv = 1 / jnp.where(jnp.abs(d) < tiny, jnp.copysign(tiny, d), d)
    negative = (d < 0).astype(jnp.int32)
    octant = negative[0] + 2 * negative[1] + 4 * negative[2]
    weights = jnp.left_shift(jnp.int32(1), lane ^ octant)
    # Slabs are widened by what o, o / d and the product round (Ize 2013): a few ulps of the coordinates.
    start, slack = o * inv, jnp.abs(o * inv) * (4 * eps)
    ray = jnp.concatenate([inv, start + slack, start - slack])
    ray, octant, weights = lax.optimization_barrier((ray, octant, weights))

    def hit_children(node, t):
        box = at(tree.bounds, node)
        low = [box[0, axis] * ray[axis] for axis in range(3)]
        high = [box[1, axis] * ray[axis] for axis in range(3)]
        near = [smaller(low[axis], high[axis]) - ray[3 + axis] for axis in range(3)]
        far = [larger(low[axis], high[axis]) - ray[6 + axis] for axis in range(3)]
        # The NaN of an empty slot gets through as the last argument.
        enter = larger(larger(larger(jnp.zeros_like(t), near[2]), near[1]), near[0])
        leave = smaller(smaller(far[0], far[1]), smaller(far[2], t))
        return jnp.sum(jnp.where(enter <= leave * (1 + 5 * eps), weights, 0), dtype=jnp.int32)

    def visit_next(state):
        level, node, mask, stack, t, primitive = state
        slot = (31 - lax.clz(mask & -mask)) ^ octant
        child = at(tree.child, node, slot)
        rest = mask & (mask - 1)

        def test_leaf():
            return *leaf(~child, t, primitive), jnp.int32(0)

        def open_node():
            return t, primitive, hit_children(child, t)

        t, primitive, below = lax.cond(child < 0, test_leaf, open_node)
        descend = below != 0
        stack = lax.dynamic_update_slice(stack, jnp.stack([node, rest])[None], (level, jnp.int32(0)))
        level = level + (descend & (rest != 0))
        node, mask = jnp.where(descend, child, node), jnp.where(descend, below, rest)

        done = mask == 0
        node_above, mask_above = at(stack, jnp.maximum(level - 1, 0))
        node, mask = jnp.where(done, node_above, node), jnp.where(done & (level > 0), mask_above, mask)
        return level - done, node, mask, stack, t, primitive

    def more(state):
        _, _, mask, _, t, _ = state
        return (mask != 0) & (t >= 0)

    root = jnp.int32(0)
    stack = jnp.zeros((tree.depth, 2), jnp.int32)
    return lax.while_loop(more, visit_next, (root, root, hit_children(root, t), stack, t, primitive))[4:]
