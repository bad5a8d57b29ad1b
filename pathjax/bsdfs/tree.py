"""Bsdfs that hold bsdfs: which one of them scatters at a point, and in which frame.

A material is a tree whose leaves scatter. It is not evaluated as a mixture: after a hit one uniform number walks from
the root to a leaf, as in PBRT-4, and light samples and bsdf samples both see that leaf alone. The estimator is unbiased
given the leaf, so its mean is that of the mixture, at the cost of one bsdf.

Scenes without wrappers use none of this; the sides of a plain `twosided` are resolved when the scene is built.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax.bsdfs.wrapper import Choosing, Turning, Wrapper
from pathjax.compile import compute_once
from pathjax.core.math import at, cross, dot, normalize, safe_divide, smaller, to_local, to_world
from pathjax.core.types import Frame, Surface
from pathjax.kinds import Instance, Row

# Kind, row, and whether its back is seen as if it were a front. Kinds index the tables of leaves, then those of
# wrappers; -1 absorbs.
Node = Int[Array, "3"]
# Least probability of either bsdf where the choice is differentiated: one of share 0 may still have a derivative.
MIN_CHANCE = 0.1


# ---- while a scene is built -----------------------------------------------------------------------------------------


def is_wrapper(instance: Instance) -> bool:
    return issubclass(instance.kind, Wrapper)


def sides(instance: Instance) -> list[tuple[Instance | None, bool]]:
    """Return the bsdfs on its front and its back, and whether each is mirrored, so that a back is seen as a front."""
    front, back = instance.kind.sides(instance)
    return [(front, False), (back, instance.kind.turns_back)]


def reached(instances: list[Instance]) -> list[list[Instance]]:
    """Return all bsdfs on the sides of the given ones (level 0), of those that these hold (level 1), ..., by level."""
    levels = []
    while instances:
        level = list(dict.fromkeys(side for each in instances for side, _ in sides(each) if side is not None))
        levels.append(level)
        instances = [held for each in level if is_wrapper(each) for held in each.values["held"]]
    return levels


def may_pass(instance: Instance) -> bool:
    return any(leaf.kind.passes for leaf in instance.kind.leaves(instance))


def nodes_of(instance: Instance, number: dict) -> np.ndarray:
    """Return the `Wrapper.nodes` of an instance. number: leaf or wrapper -> its kind and row."""
    held = [[(*number[side], turned) for side, turned in sides(each)] for each in instance.values["held"]]
    return np.swapaxes(np.array(held, np.int32), 0, 1)


# ---- at a vertex ----------------------------------------------------------------------------------------------------


class Turn(NamedTuple):
    """One turn of a frame; the identity at points where the frame was not turned."""

    n: Float[Array, "3"]  # the normal before the turn, mirrored with the frame
    roughness: Float[Array, ""]  # squared, of facets that would have such normals; 0: no shadowing


class Chosen(NamedTuple):
    """One choice on the way to a leaf, for derivatives."""

    row: Int[Array, ""]  # of the wrapper
    factor: Float[Array, ""]  # of the leaf's weight
    by: Float[Array, " columns"]  # derivative of the factor in the columns `Materials.recorded`


class Leaf(NamedTuple):
    """The bsdf that scatters at a vertex."""

    kind: Int[Array, ""]
    row: Int[Array, ""]
    frame: Frame
    wi: Float[Array, "3"]  # in the frame
    # Product of share over probability of all choices; its value is 1 unless `differentiated`. None: no wrappers.
    weight: Float[Array, ""] | None
    turns: tuple[Turn, ...]
    chosen: tuple[Chosen, ...] = ()  # one for each of `steps`; empty where `Materials.recorded` is


def leaf(
    materials,
    node: Node,
    surface: Surface,
    frame: Frame,
    wi: Float[Array, "3"],
    u: Float[Array, ""],
    differentiated: bool = False,
) -> Leaf:
    """Walk from a node down to a leaf.

    Args:
        frame, wi: the shading frame, and the direction to the previous vertex in it.
        u: uniform in [0, 1).
        differentiated: also choose bsdfs of share 0, since a share may have a derivative; the mean is the same.
    """
    upright, weight, turns = frame, jnp.ones_like(wi[2]), ()
    node, frame, wi, turns = _entered(node, frame, wi, turns)
    recorded, trace = materials.recorded, []
    for level in materials.levels:
        for place in level:
            table = materials.wrappers[place]
            here = node[0] == len(materials.tables) + place
            p = Row(table, jnp.where(here, node[1], 0), surface, materials.textures)
            if issubclass(table.kind, Turning):
                same = upright, frame, wi, jnp.zeros_like(weight)
                before = frame.n
                turn = partial(_turned, table.kind, p, surface, upright, frame, wi)
                # The next level reads these many times.
                upright, frame, wi, roughness = compute_once(lax.cond(here, turn, lambda same=same: same))
                turns = (*turns, Turn(before, roughness))
                node = jnp.where(here, _held(p, wi[2] > 0)[0], node)
            else:
                columns = recorded[place] if recorded else None
                if recorded:
                    none = jnp.zeros((len(columns),), weight.dtype)
                    trace.append(Chosen(jnp.int32(0), jnp.ones_like(weight), none))
                same = node, u, weight, *trace[-1:]
                choice = partial(_choice, table.kind, p, node, wi[2], u, weight, differentiated, columns)
                node, u, weight, *trace[-1:] = compute_once(lax.cond(here, choice, lambda same=same: same))
            node, frame, wi, turns = _entered(node, frame, wi, turns)
    return Leaf(node[0], node[1], frame, wi, weight, turns, tuple(trace))


def _entered(node, frame, wi, turns):
    """Return node, frame, wi and turns, mirrored where a back is seen as a front."""
    side = jnp.where(node[2] == 1, -1, 1).astype(wi.dtype)
    turns = tuple(turn._replace(n=turn.n * side) for turn in turns)
    node = jnp.stack([node[0], node[1], jnp.zeros_like(node[2])])
    return node, frame._replace(n=frame.n * side), jnp.stack([wi[0], wi[1], wi[2] * side]), turns


def _held(p, front):
    return at(p.nodes, jnp.where(front, 0, 1))


def _choice(kind, p, node, cos, u, weight, differentiated, columns):
    """Choose one of two bsdfs: return its node, u for the next choice, the weight and, given columns, a `Chosen`."""
    front, cos = cos > 0, jnp.abs(cos)
    share = kind.share(p, cos)
    chance = lax.stop_gradient(share)
    if differentiated:
        chance = jnp.clip(chance, MIN_CHANCE, 1 - MIN_CHANCE)
    first, second = _held(p, front)
    takes_second = u < chance
    factor = jnp.where(takes_second, safe_divide(share, chance), safe_divide(1 - share, 1 - chance))
    weight = weight * factor
    u = jnp.where(takes_second, safe_divide(u, chance), safe_divide(u - chance, 1 - chance))
    following = jnp.where(takes_second, second, first), u, weight
    if columns is None:
        return following
    by_share = jnp.where(takes_second, safe_divide(1.0, chance), -safe_divide(1.0, 1 - chance))
    return *following, Chosen(node[1], factor, by_share * share_by(kind, p, cos, columns))


def steps(materials) -> list[int]:
    """Return the indices of the wrappers at which `leaf` makes a choice, in order."""
    places = (place for level in materials.levels for place in level)
    return [place for place in places if materials.wrappers[place].kind.chooses]


def share_by(
    kind: type[Choosing], p: Row, cos: Float[Array, ""], columns: tuple[int | None, ...]
) -> Float[Array, " columns"]:
    """Return the derivative of the share of the second bsdf in some columns of the table; for None it is 0."""

    def share(nudges):
        nudges = {column: nudges[s] for s, column in enumerate(columns) if column is not None}
        return kind.share(p.nudged(nudges), cos)

    return jax.jacfwd(share)(jnp.zeros((len(columns),), cos.dtype))


def _turned(kind, p, surface, upright, frame, wi):
    """Return both frames turned, wi in the new `frame`, and `Turn.roughness`.

    upright: the same frame, but never mirrored; textures refer to it.
    """
    x, y, z = compute_once(lax.stop_gradient(kind.normal(p, surface, partial(to_local, upright))))
    if (flips := p.flip_invalid_normals) is not None:
        away = flips & (wi[2] * (wi[0] * x + wi[1] * y + wi[2] * z) <= 0)
        x, y = jnp.where(away, -x, x), jnp.where(away, -y, y)
    n = normalize(jnp.stack([x, y, z]))
    up = jnp.stack([*jnp.zeros_like(n[:2]), jnp.ones_like(x)])
    n = compute_once(jnp.where(dot(n, n) > 0, n, up))
    s = normalize(jnp.stack([1 - n[0] * n[0], -n[0] * n[1], -n[0] * n[2]]))
    t = cross(n, s)
    turned = [Frame(*(to_world(each, v) for v in (s, t, n))) for each in (upright, frame)]
    roughness = jnp.zeros_like(x)
    if (shadows := p.use_shadowing_function) is not None:
        slope = safe_divide(1 - n[2] * n[2], n[2] * n[2])
        roughness = jnp.where(shadows, smaller(slope / 8, jnp.ones_like(slope)), 0)
    return *turned, jnp.stack([dot(s, wi), dot(t, wi), dot(n, wi)]), roughness


def seen_by_turned(turns: tuple[Turn, ...], n: Float[Array, "3"], d: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the share of light from direction d that counts, where the frame was turned to the normal n.

    It is 0 for light in front of one of the normals and behind another, and small for light that grazes the surface
    (Conty Estevez, Lecocq and Stein 2019, "A microfacet-based shadowing function to solve the bump terminator
    problem").
    """
    share, below = jnp.ones_like(d[0]), dot(d, n)
    for turn in reversed(turns):
        cos = dot(d, turn.n)
        squared = cos * cos
        tan2 = (1 - squared) / jnp.where(squared > 0, squared, 1)
        lit = 2 / (1 + jnp.sqrt(1 + turn.roughness * tan2))
        share, below = jnp.where(cos * below > 0, share * lit, 0), cos
    return share


# ---- along shadow rays ----------------------------------------------------------------------------------------------


def passing(
    materials,
    node: Node,
    cos: Float[Array, ""],
    surface: Surface,
    passes: Callable,
    nudges: Float[Array, "held columns"] | None = None,
    level: int = 0,
    place_in_tree: int = 0,
) -> Float[Array, ""]:
    """Return the share of light that goes straight on: the probability that `leaf` reaches a leaf that passes light.

    Args:
        cos: of the shading normal and the direction back along the ray; positive on the front.
        passes: kind -> whether its leaves pass light.
        nudges: added to the columns `Materials.recorded` of each wrapper of `on_the_way`.
    """
    kind, row, turned = node
    cos = jnp.where(turned == 1, jnp.abs(cos), cos)
    share = ((kind < len(materials.tables)) & passes(kind)).astype(surface.p.dtype)
    for place in materials.passing[level] if level < len(materials.passing) else ():
        table = materials.wrappers[place]
        here = kind == len(materials.tables) + place

        def through(table=table, here=here, place=place):
            p = Row(table, jnp.where(here, row, 0), surface, materials.textures)
            following = place_in_tree + 1, place_in_tree + 1 + most_on_the_way(materials, level + 1)
            held = zip(_held(p, cos > 0), following, strict=False)
            shares = [passing(materials, each, cos, surface, passes, nudges, level + 1, n) for each, n in held]
            if len(shares) == 1:
                return shares[0]
            if nudges is not None:
                of_columns = zip(materials.recorded[place], nudges[place_in_tree], strict=True)
                p = p.nudged({column: nudge for column, nudge in of_columns if column is not None})
            second = table.kind.share(p, jnp.abs(cos))
            return (1 - second) * shares[0] + second * shares[1]

        share = lax.cond(here, through, lambda share=share: share)
    return share


def on_the_way(materials, node: Node, front: Bool[Array, ""], level: int = 0) -> list[tuple[Int[Array, ""], ...]]:
    """Return kind and row of all nodes that `passing` may visit: a node, then the subtrees of its first and second.

    Leaves, and places without a node, have a kind that is not that of a wrapper.
    """
    if level >= len(materials.passing):
        return []
    kind, row, turned = node
    front = front | (turned == 1)
    held = jnp.full((2, 3), -1, jnp.int32)
    for place in materials.passing[level]:
        here = kind == len(materials.tables) + place
        found = _held(Row(materials.wrappers[place], jnp.where(here, row, 0)), front)
        held = jnp.where(here, jnp.concatenate([found, held])[:2], held)
    return [(kind, row)] + [each for side in held for each in on_the_way(materials, side, front, level + 1)]


def most_on_the_way(materials, level: int = 0) -> int:
    """Return the number of nodes of `on_the_way` from a level on."""
    return 2 ** max(len(materials.passing) - level, 0) - 1
