"""Where a path meets a surface, and what scatters it there."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax import bsdfs
from pathjax.bsdfs import tree
from pathjax.core.math import shading_frame, to_local, to_world
from pathjax.core.types import BSDFSample, Frame, Hit, Ray, Surface
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


class Vertex(NamedTuple):
    hit: Hit
    surface: Surface
    frame: Frame  # around the shading normal; of reflectors, turned towards the ray
    wi: Float[Array, "3"]  # unit, in the frame, where the ray came from
    kind: Int[Array, ""]  # of the bsdf; -1: none, which absorbs
    row: Int[Array, ""]
    # Where bsdfs hold others, of `tree.Leaf`:
    weight: Float[Array, ""] | None = None
    turns: tuple[tree.Turn, ...] = ()
    colors: bsdfs.Colors | None = None  # of the textures of the bsdf; None: there are none


def vertex(
    scene: Scene, ray: Ray, hit: Hit, u: Float[Array, ""] | None = None, differentiated: bool = False
) -> Vertex:
    """What a ray meets at its hit; of a miss, some surface. The scene holds a shape.

    Reflectors see either side as their front, so their frame is turned towards the ray; glass tells its sides apart.

    Args:
        u: chooses among bsdfs that hold others; None where there are none.
        differentiated: of `tree.leaf`.
    """
    surface = geometry.surface(scene.geometry, ray, hit)
    frame = shading_frame(surface)
    wi = to_local(frame, -ray.d)
    leaf = bsdfs.leaf(scene.materials, hit.shape, surface, frame, wi, u, differentiated)
    kind, row, frame, wi, weight, turns = leaf
    side = jnp.where(bsdfs.has(scene.materials, kind, "sided") | (wi[2] > 0), 1, -1).astype(wi.dtype)
    frame, wi = frame._replace(n=frame.n * side), jnp.stack([wi[0], wi[1], wi[2] * side])
    turns = tuple(turn._replace(n=turn.n * side) for turn in turns)
    colors = bsdfs.colors(scene.materials, kind, row, surface)
    return Vertex(hit, surface, frame, wi, kind, row, weight, turns, colors)


def evaluate(scene: Scene, here: Vertex, d: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """f |cos theta| and pdf of the bsdf for light from the unit direction d, in world space."""
    wo = to_local(here.frame, d)
    f, pdf = bsdfs.evaluate(scene.materials, here.kind, here.row, here.surface, here.wi, wo, here.colors)
    if here.turns:
        share = tree.seen_by_turned(here.turns, here.frame.n, d)
        f, pdf = f * share, jnp.where(share > 0, pdf, 0)
    return f, pdf


def sample(
    scene: Scene, here: Vertex, u: Float[Array, " numbers"], other: bool = False
) -> tuple[BSDFSample, Float[Array, "3"]]:
    """A sample of the bsdf, whose weight estimates the integral of f |cos theta|, and its direction in world space.

    u: of `random_numbers.Bounce.bsdf`; other: of `bsdfs.sample_other`.
    """
    if other:
        drawn = bsdfs.sample_other(scene.materials, here.row, here.surface, here.wi, u)
    else:
        drawn = bsdfs.sample(scene.materials, here.kind, here.row, here.surface, here.wi, u, here.colors)
    d = to_world(here.frame, drawn.wo)
    if here.turns:
        share = tree.seen_by_turned(here.turns, here.frame.n, d)
        share = jnp.where(bsdfs.has(scene.materials, here.kind, "passes"), 1, share)
        drawn = drawn._replace(weight=drawn.weight * share, pdf=jnp.where(share > 0, drawn.pdf, 0))
    return drawn, d
