"""Paths that follow both branches of their first dielectrics, one after the other.

Waiting branches are kept with the path in a stack of fixed depth; entry k holds a branch that may split k more times. A
new branch may split fewer times than any that already waits, so two branches never need the same entry, and the lowest
occupied entry is the youngest.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pathjax import bsdfs
from pathjax.core.math import at, spawn_ray
from pathjax.integrators.vertex import Vertex, leaving, sample
from pathjax.scene.scene import Scene


def start(path, depth: int):
    """Return the path with room to split `depth` times, depth > 0."""
    path = path._replace(splits=jnp.int32(depth))
    nothing = jax.tree.map(lambda x: jnp.zeros((depth, *jnp.shape(x)), x.dtype), _branch(path))
    return path._replace(pending=nothing)


def splits_here(scene: Scene, here: Vertex, path) -> Bool[Array, ""]:
    """Return whether both branches are followed at a vertex."""
    return bsdfs.has(scene.materials, here.kind, "branches") & (path.splits > 0)


def split(scene: Scene, here: Vertex, u: Float[Array, " numbers"], splits: Bool[Array, ""], path, on):
    """Return the path `on` after a vertex, which took one branch there; where it `splits`, the other branch waits.

    Args:
        u: of `Bounce.bsdf`.
        path: before the vertex.
    """

    def with_other(path, on):
        other, d = sample(scene, here, u, other=True)
        branch = on._replace(
            ray=spawn_ray(here.surface, d, here.hit.primitive),
            throughput=path.throughput * other.weight * other.pdf,  # roulette comes at the next vertex
            passive=path.passive * other.passive,
            alive=other.pdf > 0,
            medium=leaving(scene, here, path.medium, d),
        )
        return _push(on, branch)

    on = on._replace(splits=path.splits - splits.astype(jnp.int32))
    return lax.cond(splits, with_other, lambda path, on: on, path, on)


def _push(path, branch):
    """Put a branch, a Path, among the waiting ones; branch.splits < depth."""

    def put(entries, new):
        here = jnp.arange(len(entries)) == branch.splits
        return jnp.where(here.reshape(-1, *[1] * new.ndim), new, entries)

    return path._replace(pending=jax.tree.map(put, path.pending, _branch(branch)))


def resume(path):
    """Return the youngest waiting branch, with the radiance gathered so far, if the path has ended; else the path."""
    waits = path.pending.alive
    numbers = jnp.arange(len(waits))
    youngest = jnp.min(jnp.where(waits, numbers, len(waits)))

    def take():
        branch = jax.tree.map(lambda entries: at(entries, youngest), path.pending)
        left = path.pending._replace(alive=waits & (numbers != youngest))
        return branch._replace(L=path.L, moving=path.moving, pending=left)

    return lax.cond(path.alive | (youngest == len(waits)), lambda: path, take)


def _branch(path):
    """Return the fields that each branch has of its own; the others belong to the whole sample."""
    return path._replace(L=None, moving=None, pending=None)
