"""Vertices of a path: where it meets a surface or a particle of a medium, and what scatters it there."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import bsdfs, media
from pathjax.bsdfs import tree
from pathjax.compile import compute_once
from pathjax.core.math import frame_from_normal, shading_frame, to_local, to_world
from pathjax.core.types import BSDFSample, Frame, Hit, Ray, Surface
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry
from pathjax.textures import Pairs


class Vertex(NamedTuple):
    hit: Hit
    surface: Surface
    frame: Frame  # around the shading normal; for reflectors, turned towards the ray
    wi: Float[Array, "3"]  # unit, in the frame, where the ray came from
    kind: Int[Array, ""]  # of the bsdf; -1: none, absorbs
    row: Int[Array, ""]
    # Of `tree.Leaf`, where bsdfs hold others:
    weight: Float[Array, ""] | None = None
    turns: tuple[tree.Turn, ...] = ()
    chosen: tuple[tree.Chosen, ...] = ()
    colors: bsdfs.Colors | None = None  # of the bsdf's textures; None: there are none
    entries: tuple[Pairs, ...] | None = None  # of these textures; None: none is differentiated
    medium: Int[Array, ""] | None = None  # that scatters here; media.NONE: a surface does. None: no medium scatters

    @property
    def scattered(self) -> Bool[Array, ""]:
        """Whether a medium scatters here, not a surface."""
        return jnp.bool_(False) if self.medium is None else self.medium != media.NONE


def vertex(scene: Scene, ray: Ray, hit: Hit, u: Float[Array, ""] | None = None, differentiated: bool = False) -> Vertex:
    """Return the vertex at a ray's hit; for a miss, that of an arbitrary surface. The scene holds a shape.

    Reflectors treat either side as their front, so their frame is turned towards the ray; glass tells its sides apart.

    Args:
        u: chooses a leaf of bsdfs that hold others; None where there are none.
        differentiated: as for `tree.leaf`.
    """
    surface = compute_once(geometry.surface(scene.geometry, ray, hit))
    frame = shading_frame(surface)
    wi = to_local(frame, -ray.d)
    leaf = bsdfs.leaf(scene.materials, hit.shape, surface, frame, wi, u, differentiated)
    kind, row, frame, wi, weight, turns, chosen = leaf
    side = jnp.where(bsdfs.has(scene.materials, kind, "sided") | (wi[2] > 0), 1, -1).astype(wi.dtype)
    frame, wi = frame._replace(n=frame.n * side), jnp.stack([wi[0], wi[1], wi[2] * side])
    turns = tuple(turn._replace(n=turn.n * side) for turn in turns)
    colors, entries = bsdfs.colors(scene.materials, kind, row, surface)
    return Vertex(hit, surface, frame, wi, kind, row, weight, turns, chosen, colors, entries)


def within(here: Vertex, ray: Ray, medium: Int[Array, ""], distance: Float[Array, ""]) -> Vertex:
    """Return the vertex in a medium, which has no bsdf, if the ray meets a particle before its hit and its end.

    Args:
        here: `vertex` of the ray's hit up to that distance; returned otherwise.
        distance: to the particle, from `media.distance`.
    """
    scattered = (here.hit.primitive < 0) & (distance < ray.t_max)
    distance = jnp.where(scattered, distance, 0)

    def chosen(inside, there):
        return jnp.where(scattered, inside, there)

    surface = here.surface._replace(
        p=chosen(ray.o + distance * ray.d, here.surface.p), margin=chosen(0, here.surface.margin)
    )
    return here._replace(
        hit=here.hit._replace(t=chosen(distance, here.hit.t)),
        surface=surface,
        frame=Frame(*map(chosen, frame_from_normal(-ray.d), here.frame)),
        kind=chosen(-1, here.kind),
        row=chosen(0, here.row),
        weight=None if here.weight is None else chosen(1, here.weight),
        chosen=tuple(each._replace(by=chosen(0, each.by)) for each in here.chosen),
        medium=chosen(medium, media.NONE),
    )


def leaving(
    scene: Scene, here: Vertex, medium: Int[Array, ""] | None, d: Float[Array, "3"]
) -> Int[Array, ""] | None:
    """Return the medium of a ray that arrived in `medium` and leaves a vertex in the direction d.

    None in scenes without media.
    """
    if medium is None:
        return None
    return media.beyond(scene.media, medium, here.hit.shape, here.surface.n, d)


def is_smooth(scene: Scene, here: Vertex) -> Bool[Array, ""]:
    """Return whether the bsdf or phase function at a vertex has a density (is not Dirac)."""
    smooth = bsdfs.has(scene.materials, here.kind, "smooth")
    return smooth if here.medium is None else smooth | here.scattered


def evaluate(scene: Scene, here: Vertex, d: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return f |cos theta| and pdf of the bsdf (or the phase function and its pdf) for light from unit direction d."""
    wo = to_local(here.frame, d)

    def of_surface():
        return _evaluate_bsdf(scene, here, wo, d)

    if here.medium is None:
        return of_surface()
    return lax.cond(here.scattered, lambda: media.evaluate(scene.media, here.medium, wo), of_surface)


def _evaluate_bsdf(scene, here, wo, d):
    f, pdf = bsdfs.evaluate(scene.materials, here.kind, here.row, here.surface, here.wi, wo, here.colors)
    if here.turns:
        share = tree.seen_by_turned(here.turns, here.frame.n, d)
        f, pdf = f * share, jnp.where(share > 0, pdf, 0)
    return f, pdf


def sample(
    scene: Scene, here: Vertex, u: Float[Array, " numbers"], other: bool = False
) -> tuple[BSDFSample, Float[Array, "3"]]:
    """Sample the bsdf, or in a medium the phase function; also return the direction in world space.

    The sample's weight estimates the integral of f |cos theta|.

    u: of `random_numbers.Bounce.bsdf`; other: draw by `bsdfs.sample_other`.
    """

    def of_surface():
        return bsdfs.sample(scene.materials, here.kind, here.row, here.surface, here.wi, u, here.colors)

    if other:
        drawn = bsdfs.sample_other(scene.materials, here.row, here.surface, here.wi, u)
    elif here.medium is None:
        drawn = of_surface()
    else:
        drawn = lax.cond(here.scattered, lambda: media.sample(scene.media, here.medium, u[:2]), of_surface)
    d = to_world(here.frame, drawn.wo)
    if here.turns:
        share = tree.seen_by_turned(here.turns, here.frame.n, d)
        straight = bsdfs.has(scene.materials, here.kind, "passes")
        share = jnp.where(straight if here.medium is None else straight | here.scattered, 1, share)
        drawn = drawn._replace(weight=drawn.weight * share, pdf=jnp.where(share > 0, drawn.pdf, 0))
    return drawn, d
