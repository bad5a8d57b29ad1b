"""The path tracer: L = Le + T L, estimated along one path at a time (Kajiya 1986; Veach 1997, chapter 10).

`extend` is one vertex of a path. Its steps, each a function, are the terms of the equation:

    emission                      Le: light emitted where the path arrives, times the share of bsdf sampling
    next_event.light_sample       T Le: light of a sampled light, reflected once
    vertex.sample                 T L: one sampled direction estimates the integral; the path continues in it
    roulette.survival             few paths of little throughput survive, with the weight of all of them
    splitting                     optional: both branches of glass instead of a random one
    control.roulette              optional: paths end in known light instead of in darkness

`reference` is the same estimator without options or optimisation: read it first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import bsdfs, emitters, media
from pathjax.compile import compute_once
from pathjax.core.math import dot, smaller, spawn_ray
from pathjax.core.types import EmitterSample, Hit, Ray
from pathjax.emitters import Choice
from pathjax.integrators import next_event, roulette, splitting
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import Bounce
from pathjax.integrators.shadow import Arrival, Dimmed, Passed
from pathjax.integrators.vertex import Vertex, leaving, sample, vertex, within
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


class Gain(NamedTuple):
    """Contribution of one vertex to the terms of L = Le + T Le + T^2 Le + ..., divided by the throughput before it."""

    emission: Float[Array, "3"]  # to the term T^depth Le, depth being that of the path before the vertex
    light: Float[Array, "3"]  # light sample, to the term T^(depth + 1 + passed) Le
    weight: Float[Array, "3"]  # factor of the throughput
    passed: Int[Array, ""] | None = None  # vertices passed straight on by the light sample; None: nothing can be passed
    nudged: Passed | None = None  # from the light sample's shadow ray; None: not needed
    dimmed: Dimmed | None = None  # likewise


class Path(NamedTuple):
    """State of the path loop, carried from one vertex to the next."""

    ray: Ray  # from the last vertex to the next
    L: Float[Array, "3"] | Gain  # radiance gathered so far; a Gain: at the last vertex alone
    throughput: Float[Array, "3"]  # product of the weights so far
    pdf: Float[Array, ""]  # density [1/sr] of ray.d by bsdf sampling; inf from a camera or a Dirac lobe
    # A path that passes straight through a surface keeps the pdf of the vertex before, where light samples were drawn.
    depth: Int[Array, ""]  # vertices so far, without free passes
    alive: Bool[Array, ""]  # False: L is complete
    # None where not needed, so that it is not compiled:
    origin: Float[Array, "3"] | None = None  # the point at which `pdf` was sampled
    passed: Int[Array, ""] | None = None  # free passes so far
    passive: Float[Array, ""] | None = None  # factor of the throughput by refraction, which roulette divides out
    moving: Int[Array, ""] | None = None  # bit r % 31 is set once the path met row r of the bsdfs that move paths
    expected: Float[Array, ""] | None = None  # value that a control expects of the path, all channels
    splits: Int[Array, ""] | None = None  # how many dielectrics may still split it
    medium: Int[Array, ""] | None = None  # medium of the ray: a row or media.NONE
    pending: Path | None = None  # (split_depth, ...) waiting branches where alive; see `splitting`


def vertices(path: Path) -> Int[Array, ""]:
    """Return the number of vertices so far, which is the index of the next one."""
    return path.depth if path.passed is None else path.depth + path.passed


def start(scene: Scene, ray: Ray, options: Options) -> Path:
    """Return the path that starts with a camera ray."""
    one, zero3 = jnp.ones_like(ray.t_max), jnp.zeros_like(ray.o)
    transmits, passes = (bsdfs.occurs(scene.materials, each) for each in ("transmissive", "passes"))
    splits = options.split_depth and bsdfs.occurs(scene.materials, "branches")
    path = Path(
        ray,
        Gain(zero3, zero3, one + zero3, jnp.int32(0) if passes else None) if options.by_vertex else zero3,
        zero3 + (scene.max_depth > 0),
        one * jnp.inf,
        jnp.int32(0),
        scene.max_depth > 0,
        ray.o if passes or emitters.chosen_by_place(scene.emitters) else None,
        jnp.int32(0) if scene.free_passes else None,
        one if transmits else None,
        jnp.int32(0) if options.watch_moving else None,
        jnp.zeros_like(one) if options.controlled else None,
        medium=None if scene.media is None else scene.media.camera,
    )
    return splitting.start(path, options.split_depth) if splits else path


def extend(scene: Scene, choice: Choice | None, path: Path, u: Bounce, options: Options, control=None) -> Path:
    """Follow a path to its next vertex.

    Args:
        choice: how lights are chosen, from `emitters.choice`.
        path: alive.
        u: random numbers of this vertex.
        control: `transport.Control`, if `options.controlled`.
    Returns:
        The path; once it is not alive, `L` is the radiance that arrives, unbiased up to max_depth.
    Gradient: samples are detached from albedos and radiances, so weights carry the derivative, unbiased. Where the IOR
    of glass moves the path, the derivative follows the moving points (attached) and misses the terms of edges.
    """
    hit, here, u = meet(scene, path, u, options)
    return onward(scene, choice, path, hit, here, u, options, control)


def meet(scene: Scene, path: Path, u: Bounce, options: Options) -> tuple[Hit, Vertex | None, Bounce]:
    """Return the hit and vertex of a path's ray (no vertex, None, in a scene without shapes), and u unchanged."""
    ray = path.ray
    if scene.scatters:
        distance = media.distance(scene.media, path.medium, ray, path.throughput, u.flight)
        distance, u = compute_once((distance, u))
        hit = geometry.closest_hit(scene.geometry, ray._replace(t_max=smaller(distance, ray.t_max)))
        here = within(vertex(scene, ray, hit, u.leaf, options.derivative), ray, path.medium, distance)
        u, here = compute_once((u, here))
        return here.hit, here, u
    hit = geometry.closest_hit(scene.geometry, ray)
    here = vertex(scene, ray, hit, u.leaf, options.derivative) if scene.geometry.tables else None
    u, here = compute_once((u, here))
    return hit, here, u


def onward(
    scene: Scene,
    choice: Choice | None,
    path: Path,
    hit: Hit,
    here: Vertex | None,
    u: Bounce,
    options: Options,
    control=None,
) -> Path:
    """Do the rest of `extend` for a path whose ray is known to meet `here`."""
    ray, first = path.ray, path.depth == 0
    if options.by_vertex:
        path = path._replace(L=path.L._replace(weight=jnp.ones_like(ray.o)))
    if scene.media is not None:
        flown, scattered = smaller(hit.t, ray.t_max), here.scattered if scene.scatters else None
        weight = media.flight_weight(scene.media, path.medium, ray, path.throughput, flown, scattered)
        path = _scaled(path, lambda carried: carried * weight)
    light = sky = None
    if here is not None and next_event.draws_background(scene, choice, options):
        light, sky = next_event.draw_or_meet(scene, choice, here, _met(scene, hit, here), u, ray.d)
    path = path._replace(L=_with_emission(path.L, emission(scene, choice, path, hit, here, options, sky)))
    if scene.free_passes:
        free = bsdfs.has(scene.materials, here.kind, "passes")
        path = path._replace(depth=path.depth + jnp.where(free, 0, 1), passed=path.passed + jnp.where(free, 1, 0))
        goes_on = _met(scene, hit, here) & (free | (path.depth < scene.max_depth))
    else:
        path = path._replace(depth=path.depth + 1)
        if here is None:
            return _ended(path)
        goes_on = _met(scene, hit, here) & (path.depth < scene.max_depth)
    if control is not None:
        path, goes_on = lax.cond(
            goes_on,
            lambda path: control.roulette(scene.geometry, path, hit, here.surface, u.roulette),
            lambda path: (path, goes_on),
            path,
        )
    go_on = partial(scatter, scene, choice, here, u, goes_on, options, light)
    if scene.hide_emitters:
        # Camera rays pass through emitters, as in Mitsuba.
        beyond = spawn_ray(here.surface, ray.d, hit.primitive)._replace(t_max=ray.t_max - hit.t)
        through = path._replace(ray=beyond, depth=jnp.int32(0), medium=leaving(scene, here, path.medium, ray.d))
        hidden = first & geometry.emits(scene.geometry, hit)
        path = lax.cond(hidden, lambda path: through, lambda path: lax.cond(goes_on, go_on, _ended, path), path)
    else:
        path = lax.cond(goes_on, go_on, _ended, path)
    return path if path.pending is None else splitting.resume(path)


def emission(
    scene: Scene, choice: Choice | None, path: Path, hit: Hit, here: Vertex | None, options: Options, sky=None
) -> Float[Array, "3"]:
    """Return Le where a path arrives, times its throughput and the share of bsdf sampling in finding that light.

    path: before the vertex `here`, which its ray meets at `hit`; sky: background, from `next_event.draw_or_meet`.
    """
    shapes, found = scene.geometry, hit.primitive >= 0

    def received():
        def at_surface():
            surface, ray = here.surface, path.ray if path.origin is None else path.ray._replace(o=path.origin)
            again = options.derivative or path.origin is not None
            arrival = hit._replace(t=dot(surface.p - ray.o, ray.d)) if again else hit
            return emitters.hit(scene.emitters, shapes, choice, ray, arrival, surface)

        def at_infinity():
            return emitters.background(scene.emitters, choice, path.ray.d) if sky is None else sky

        Le, pdf_light = at_infinity() if here is None else lax.cond(found, at_surface, at_infinity)
        share = next_event.share_of_bsdf_sampling(scene, choice, path.pdf, pdf_light, options)
        if scene.hide_emitters:
            # Lights, including the background, are black to camera rays.
            share = jnp.where(path.depth == 0, 0, share)
        return _carried(path) * Le * share

    # The branch saves time, since most surfaces do not emit.
    bright = True if here is None else ~found | geometry.emits(shapes, hit)
    if scene.scatters:
        bright = bright & ~here.scattered
    return lax.cond(bright, received, lambda: jnp.zeros_like(path.throughput))


def scatter(
    scene: Scene,
    choice: Choice | None,
    here: Vertex,
    u: Bounce,
    goes_on: Bool[Array, ""],
    options: Options,
    light: EmitterSample | None,
    path: Path,
) -> Path:
    """Estimate T L at a vertex: a light sample, and a direction in which the path continues if it survives roulette.

    light: light sample of `next_event.draw_or_meet`, if known.
    """
    if here.weight is not None:
        path = _scaled(path, lambda carried: carried * here.weight)
    if next_event.occurs(scene, choice, options):
        medium, depth = path.medium, path.depth
        direct = next_event.light_sample(scene, choice, here, u, goes_on, depth, options, medium, light)
        path = path._replace(L=_with_light(path.L, direct._replace(light=_carried(path) * direct.light)))
    drawn, d = compute_once(sample(scene, here, u.bsdf))
    if path.pending is not None:
        splits = splitting.splits_here(scene, here, path)
        drawn = drawn._replace(weight=jnp.where(splits, drawn.pdf, 1) * drawn.weight)
    behind = _scaled(path, lambda carried: carried * drawn.weight)
    passive = None if path.passive is None else lax.stop_gradient(path.passive * drawn.passive)
    if options.controlled:
        survival = jnp.ones_like(drawn.pdf)
    else:
        survival = roulette.survival(scene, path.depth, behind.throughput, passive)
    # A direction of density 0 (in the surface, by rounding; an impossible branch of glass) carries nothing.
    scatters = (here.kind >= 0) | here.scattered if scene.scatters else here.kind >= 0
    carries = scatters & (drawn.pdf > 0) & (options.derivative | (roulette.largest(behind.throughput) > 0))
    on = _scaled(behind, lambda carried: carried / survival)._replace(
        ray=spawn_ray(here.surface, d, here.hit.primitive),
        pdf=jnp.where(drawn.delta, jnp.inf, drawn.pdf),
        alive=carries & (u.roulette < survival),
        passive=passive,
        medium=leaving(scene, here, path.medium, d),
    )
    if path.origin is not None:
        passes = bsdfs.has(scene.materials, here.kind, "passes")
        on = on._replace(pdf=jnp.where(passes, path.pdf, on.pdf), origin=jnp.where(passes, path.origin, here.surface.p))
    if path.moving is not None:
        on = on._replace(moving=path.moving | bsdfs.moving_bit(scene.materials, here.kind, here.row))
    return on if path.pending is None else splitting.split(scene, here, u.bsdf, splits, path, on)


def _met(scene, hit, here):
    """Return whether the path has a vertex."""
    found = hit.primitive >= 0
    return found | here.scattered if scene.scatters else found


def _ended(path: Path) -> Path:
    return path._replace(alive=jnp.bool_(False))


def _scaled(path: Path, scale: Callable) -> Path:
    """Return the path with its throughput scaled, and its vertex's weight too."""
    L = path.L._replace(weight=scale(path.L.weight)) if isinstance(path.L, Gain) else path.L
    return path._replace(L=L, throughput=scale(path.throughput))


def _carried(path: Path) -> Float[Array, "3"]:
    """Return the factor of light that the path meets."""
    return path.L.weight if isinstance(path.L, Gain) else path.throughput


def _with_emission(L, emitted):
    return L._replace(emission=emitted, light=jnp.zeros_like(emitted)) if isinstance(L, Gain) else L + emitted


def _with_light(L, direct: Arrival):
    return L._replace(**direct._asdict()) if isinstance(L, Gain) else L + direct.light
