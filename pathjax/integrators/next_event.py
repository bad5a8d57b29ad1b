"""Next event estimation, and its multiple importance sampling with bsdf sampling (Veach 1997)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Real

from pathjax import bsdfs, emitters
from pathjax.compile import compute_once
from pathjax.core.math import spawn_ray
from pathjax.core.types import EmitterSample
from pathjax.emitters import Choice
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import Bounce
from pathjax.integrators.shadow import Arrival, none_dimmed, none_passed, transmitted
from pathjax.integrators.vertex import Vertex, evaluate, is_smooth, leaving
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


def occurs(scene: Scene, choice: Choice | None, options: Options) -> bool:
    """Return whether lights are sampled: not where all bsdfs are Dirac, since no light sample has their directions."""
    return options.strategy != "bsdf" and choice is not None and scene.samples_lights


def draws_background(scene: Scene, choice: Choice | None, options: Options) -> bool:
    """Return whether some of the light samples are of a background."""
    return occurs(scene, choice, options) and emitters.samples_background(scene.emitters, choice)


def draw_or_meet(
    scene: Scene, choice: Choice, vertex: Vertex, met: Bool[Array, ""], u: Bounce, d: Float[Array, "3"]
) -> tuple[EmitterSample, tuple[Float[Array, "3"], Float[Array, ""]]]:
    """Draw a light sample, for a path that has met a vertex, and the background in direction d, for one that has not.

    Both share one look-up of the background: lanes would do two at each vertex and use only one.
    """
    drawn = emitters.sample(scene.emitters, scene.geometry, choice, vertex.surface.p, u.light, u.triangle, False)
    sky = compute_once(emitters.background(scene.emitters, choice, jnp.where(met, drawn.d, d)))
    return emitters.with_background(drawn, *sky), sky


def light_sample(
    scene: Scene,
    choice: Choice,
    vertex: Vertex,
    u: Bounce,
    goes_on: Bool[Array, ""],
    depth: Int[Array, ""],
    options: Options,
    medium: Int[Array, ""] | None = None,
    drawn: EmitterSample | None = None,
) -> Arrival:
    """Sample the direct light that a vertex reflects: the integral over all lights of f Le |cos theta| V.

    Args:
        choice: how lights are chosen, from `emitters.choice`.
        goes_on: whether the sample counts; if not, its shadow ray is not traced.
        depth: vertices so far.
        medium: medium in which the path arrived; None in scenes without media.
        drawn: light sample of `draw_or_meet`, if already drawn.
    """
    materials = scene.materials
    smooth = is_smooth(scene, vertex)
    passes = bsdfs.occurs(materials, "passes")

    def sample(drawn=drawn):
        if drawn is None:
            drawn = emitters.sample(scene.emitters, scene.geometry, choice, vertex.surface.p, u.light, u.triangle)
        f, pdf_bsdf = evaluate(scene, vertex, drawn.d)
        possible = (drawn.pdf > 0) & (pdf_bsdf > 0)
        scale = _weight(drawn, pdf_bsdf, options) / jnp.where(possible, drawn.pdf, 1)
        contribution = f * drawn.Le * scale
        # A shadow ray of negative length is not traced.
        useful = goes_on & smooth & possible & (options.derivative | jnp.any(contribution > 0))
        reach = jnp.where(useful, drawn.distance, -1)
        shadow_ray = spawn_ray(vertex.surface, drawn.d, vertex.hit.primitive)._replace(t_max=reach)
        if passes or medium is not None:
            most, start = scene.max_depth - 1 - depth, leaving(scene, vertex, medium, drawn.d)
            arrival = transmitted(scene, shadow_ray, drawn.primitive, most, options.derivative, start, u.along)
            return arrival._replace(light=jnp.where(useful, contribution * arrival.light, 0))
        visible = useful & ~geometry.occluded(scene.geometry, shadow_ray, drawn.primitive)
        return Arrival(jnp.where(visible, contribution, 0))

    passed = jnp.int32(0) if passes else None
    nothing = Arrival(jnp.zeros_like(vertex.wi), passed, none_passed(scene), none_dimmed(scene, u.along))
    return lax.cond(smooth, sample, lambda: nothing)


def _weight(drawn: EmitterSample, pdf_bsdf: Float[Array, ""], options: Options) -> Float[Array, ""] | int:
    """Return the MIS weight of a light sample."""
    return mis_weight(drawn.density, pdf_bsdf) if options.strategy == "mis" else 1


def share_of_bsdf_sampling(
    scene: Scene, choice: Choice | None, pdf: Float[Array, ""], pdf_light: Float[Array, ""], options: Options
) -> Real[Array, ""] | int:
    """Return the weight of bsdf sampling in light that it finds with density `pdf`, light samples with `pdf_light`."""
    if options.strategy == "mis":
        return mis_weight(pdf, pdf_light)
    if occurs(scene, choice, options):
        return jnp.where(jnp.isfinite(pdf) & (pdf_light > 0), 0, 1)
    return 1


def mis_weight(pdf: Float[Array, ""], other_pdf: Float[Array, ""]) -> Float[Array, ""]:
    """Power heuristic for a sample of density `pdf` > 0 that the other technique finds with `other_pdf`.

    It is 1 for an infinite `pdf` (only this technique finds it), even where a grazing light makes `other_pdf` overflow.
    """
    ratio = other_pdf / pdf
    return jnp.where(jnp.isinf(pdf), 1, 1 / (1 + ratio * ratio))
