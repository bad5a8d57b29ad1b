"""A binary tree that chooses near and bright lights (Conty Estevez and Kulla 2018, "Importance sampling of many lights
with adaptive tree splitting").

A sample descends from the root. It takes either child with a probability proportional to the power that faces the
point, over the square of the distance. For lights i of power p_i and normal n_i, and the point in the direction d, this
power is the sum of p_i max(n_i . d, 0). It is approximated by the mean normal and a rest that faces all sides:

    max(N . d, 0) + (P - |N|) / 4,    N = sum p_i n_i,    P = sum p_i,

which is exact for a small light that is flat or round. The tree is complete, and all leaves are on one level: the bits
of a leaf's index are the way to it, so the probability of any light is computed by the same descent as a sample. The
order of lights depends only on their positions, which are known when a scene is built; powers, which may be traced, are
summed once per render.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import at, dot, larger, safe_divide, safe_sqrt

# Fewer lights are chosen by power alone, at less cost; the six faces of a cube are six lights. From this number on the
# tree is 1.1 to 2.9 times as efficient, with 200 lights 2.3 to 5.7 times (a room 20 wide, 16 spp). Where flat lights
# face all directions, their normals contribute a factor of 1.2 to this.
FEWEST = 9
# Least share of power that is taken to face all sides: some of many lights, or a part of a large one, may face a point
# that their middle does not face.
_LEAST_AROUND = 1 / 16


@register_dataclass
@dataclass(frozen=True)
class LightTree:
    # Middle, squared radius, N, and the rest that faces all sides. Children of k are 2 k and 2 k + 1; 0 is unused.
    nodes: Float[Array, "N 8"]
    leaf: Int[Array, " K"]  # leaf of each light, from 0
    light: Int[Array, " L"]  # light of each leaf; -1: none
    levels: int = field(metadata={"static": True})


def arranged(places: Float[np.ndarray, "K 3 3"]) -> Int[np.ndarray, " K"]:
    """Return the leaf of each light, by recursive halving along the longest axis.

    places: lower and upper corner of the box around each light, and its mean normal.
    """
    leaf = np.zeros(len(places), np.int32)
    middles = places[:, :2].mean(1)

    def fill(lights, first, room):
        leaf[lights] = first
        if len(lights) == 1:
            return
        axis = np.ptp(middles[lights], axis=0).argmax()
        lights = lights[np.argsort(middles[lights, axis], kind="stable")]
        half = (len(lights) + 1) // 2
        fill(lights[:half], first, room // 2)
        fill(lights[half:], first + room // 2, room // 2)

    fill(np.arange(len(places)), 0, leaves(len(places)))
    return leaf


def leaves(lights: int) -> int:
    return 1 << (lights - 1).bit_length()


def built(places: Float[Array, "K 3 3"], leaf: Int[Array, " K"], power: Float[Array, " K"]) -> LightTree:
    """Build the tree of lights, given their places and their leaves from `arranged`. power: up to a common factor."""
    light = jnp.full(leaves(len(leaf)), -1, jnp.int32).at[leaf].set(jnp.arange(len(leaf), dtype=jnp.int32))
    # Empty leaves come last in their node; their power is 0, and their place that of a light in the node.
    near = lax.cummax(jnp.where(light >= 0, jnp.arange(len(light)), 0))
    lo, hi, normal = (places[light[near], part] for part in range(3))
    level, levels = jnp.where(light >= 0, power[light], 0)[:, None], []
    facing = normal * level
    while True:
        half = (hi - lo) / 2
        length = jnp.sqrt(jnp.sum(facing * facing, 1, keepdims=True))
        around = jnp.maximum(level - length, _LEAST_AROUND * level) / 4
        levels.append(jnp.concatenate([lo + half, jnp.sum(half * half, 1, keepdims=True), facing, around], 1))
        if len(lo) == 1:
            break
        lo, hi = jnp.minimum(lo[::2], lo[1::2]), jnp.maximum(hi[::2], hi[1::2])
        level, facing = level[::2] + level[1::2], facing[::2] + facing[1::2]
    nodes = jnp.concatenate([jnp.zeros_like(levels[-1]), *levels[::-1]])
    return LightTree(nodes, leaf, light, len(levels) - 1)


def choose(
    tree: LightTree, ref: Float[Array, "3"], u: Float[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Choose a light for the point ref: return its number, its probability, and u, uniform again."""

    def by_chance(level, state, first):
        node, probability, u = state
        goes_on = u >= first
        share = jnp.where(goes_on, 1 - first, first)
        u = jnp.where(goes_on, u - first, u) * safe_divide(1, share)
        return 2 * node + goes_on.astype(jnp.int32), probability * share, jnp.clip(u, 0, 1 - 2**-24)

    node, probability, u = _descend(tree, ref, by_chance, (jnp.int32(1), jnp.ones_like(u), u))
    number = at(tree.light, node - len(tree.light))
    return jnp.maximum(number, 0), jnp.where(number < 0, 0, probability), u


def probability(tree: LightTree, ref: Float[Array, "3"], number: Int[Array, ""]) -> Float[Array, ""]:
    """Return the probability with which `choose` finds a light."""
    leaf = at(tree.leaf, number)

    def towards_it(level, state, first):
        node, probability = state
        bit = (leaf >> (tree.levels - 1 - level)) & 1
        return 2 * node + bit, probability * jnp.where(bit == 1, 1 - first, first)

    return _descend(tree, ref, towards_it, (jnp.int32(1), jnp.ones_like(ref[0])))[1]


def _descend(tree: LightTree, ref, step: Callable, state):
    """Descend to a leaf. step: (level, state, probability of the first child of state[0]) -> state."""
    ref = lax.stop_gradient(ref)

    def importance(node):
        row = at(tree.nodes, node)
        to = jnp.stack([ref[axis] - row[axis] for axis in range(3)])
        # Within the sphere around a node, its radius replaces the distance, which says nothing there.
        inverse = safe_divide(1, safe_sqrt(larger(dot(to, to), row[3])))
        return inverse * inverse * (larger(dot(row[4:7], to) * inverse, 0) + row[7])

    def down(level, state):
        first, second = compute_once((importance(2 * state[0]), importance(2 * state[0] + 1)))
        total = first + second
        return step(level, state, jnp.where(total > 0, first * safe_divide(1, total), 0.5))

    return lax.fori_loop(0, tree.levels, down, state)
