"""The path tracer: L = Le + T L, estimated along one path at a time (Kajiya 1986; Veach 1997, chapter 10)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax import bsdfs, emitters
from pathjax.core import sampler
from pathjax.core.math import dot, larger, safe_divide, shading_frame, smaller, spawn_ray, to_local, to_world
from pathjax.core.types import Ray
from pathjax.emitters import Choice
from pathjax.errors import InputError
from pathjax.integrators import splitting
from pathjax.shapes import geometry

STRATEGIES = ("mis", "light", "bsdf")
SAMPLERS = tuple(sampler.POINTS)
# Branches double with each.
MOST_SPLITS = 8
# Roulette never spares a path for certain, so that every path ends even between perfect mirrors; and never ends one for
# certain, so that what is black keeps its derivative.
MIN_SURVIVAL, MAX_SURVIVAL = 0.05, 0.95


class Gain(NamedTuple):
    """Radiance that a path gathers at one vertex, by the term of L = Le + T Le + T^2 Le + ... that it belongs to."""

    emission: jax.Array  # (3,) of the term T^depth Le, depth being that of the path before the vertex
    light: jax.Array  # (3,) of the next one: the light sample


class Path(NamedTuple):
    """What a path carries from one vertex to the next."""

    ray: Ray  # from the last vertex to the next
    L: jax.Array | Gain  # (3,) radiance gathered so far; a Gain: at the last vertex alone
    throughput: jax.Array  # (3,) product of the weights so far
    pdf: jax.Array  # () density [1/sr] of ray.d by bsdf sampling; inf from a camera or a Dirac lobe
    passive: jax.Array | None  # () what glass did to the throughput, which roulette takes out; None: there is no glass
    depth: jax.Array  # () int32 vertices so far
    alive: jax.Array  # () bool
    glass: jax.Array | None  # () int32 bit r % 31 is set once the path met row r of the dielectrics; None: not asked
    splits: jax.Array | None = None  # () int32 how many dielectrics may still split it; None: none ever
    pending: Path | None = None  # (split_depth, ...) branches that wait, those alive; see `splitting`
    expected: jax.Array | None = None  # () what a control expects of it, all channels; None: there is no control


class Bounce(NamedTuple):
    """Random numbers of one vertex."""

    light: jax.Array  # (2,)
    bsdf: jax.Array  # (2,)
    triangle: jax.Array  # () chooses within a mesh that emits
    roulette: jax.Array  # ()


def check_sampling(strategy, spp, seed, fresnel="exact", split_depth=0, points="lattice") -> None:
    """Refuse, with an InputError, what no path tracer can do; numbers that are traced pass. points: of SAMPLERS."""
    named = ("strategy", strategy, STRATEGIES), ("fresnel", fresnel, bsdfs.FRESNEL), ("sampler", points, SAMPLERS)
    for name, value, known in named:
        if value not in known:
            raise InputError(f"{name} {value!r} is unknown; use one of {', '.join(known)}")
    if not isinstance(split_depth, int) or not 0 <= split_depth <= MOST_SPLITS:
        raise InputError(f"split_depth = {split_depth!r}; it must be an integer in [0, {MOST_SPLITS}]")
    if points == "subpixel" and not isinstance(spp, jax.core.Tracer) and np.any(np.asarray(spp) % sampler.SUBPIXELS):
        raise InputError(f"spp = {spp}; sampler='subpixel' takes samples by fours, so make it a multiple of 4")
    for name, value, least in (("spp", spp, 1), ("seed", seed, 0)):
        if isinstance(value, int) and not least <= value < 2**31:
            raise InputError(f"{name} = {value}; it must lie in [{least}, 2^31)")


def trace(scene, choice: Choice | None, ray: Ray, numbers, strategy: str) -> Path:
    """Follow a path from a camera ray to its end; numbers: depth -> Bounce. For the rest see `extend`."""

    def on(path: Path) -> Path:
        return extend(scene, choice, path, numbers(path.depth), strategy)

    return lax.while_loop(lambda path: path.alive, on, start(scene, ray))


def start(
    scene,
    ray: Ray,
    watch_glass: bool = False,
    split_depth: int = 0,
    by_vertex: bool = False,
    controlled: bool = False,
) -> Path:
    """A path that has its camera ray.

    Args:
        watch_glass: tell which dielectrics it meets.
        split_depth: of so many dielectrics, the first that it meets, follow both branches.
        by_vertex: `L` is the Gain of each vertex.
        controlled: `extend` is given a control.
    """
    one, zero3 = jnp.ones_like(ray.t_max), jnp.zeros_like(ray.o)
    passive = one if bsdfs.occurs(scene.materials, "transmissive") else None
    glass = jnp.int32(0) if watch_glass else None
    throughput = zero3 + (scene.max_depth > 0)
    L = Gain(zero3, zero3) if by_vertex else zero3
    expected = jnp.zeros_like(one) if controlled else None
    path = Path(
        ray, L, throughput, one * jnp.inf, passive, jnp.int32(0), scene.max_depth > 0, glass, expected=expected
    )
    return splitting.start(path, split_depth) if split_depth and passive is not None else path


def extend(
    scene, choice: Choice | None, path: Path, u: Bounce, strategy: str, derivative: bool = False, control=None
) -> Path:
    """Follow a path to its next vertex.

    Args:
        choice: how lights are chosen, of `emitters.choice`.
        path: Path, alive.
        u: Bounce, the vertex's own.
        strategy: "mis", or for experiments "light" (next-event estimation alone) or "bsdf" (without it).
        derivative: follow also what carries nothing, since its derivative may; the value is the same.
        control: `transport.Control` whose roulette takes the place of the usual one, or None.
    Returns:
        Path; once it is not alive, `L` is the radiance that arrives, unbiased up to max_depth.
    Gradient: what is drawn is detached from albedos and radiances, so weights carry the derivative, unbiased. Where the
    IOR of glass moves the path, the derivative is that of the moving points (attached), and edges are missing from it.
    """
    shapes, materials = scene.geometry, scene.materials
    least, most = (jnp.full_like(path.ray.t_max, x) for x in (MIN_SURVIVAL, MAX_SURVIVAL))
    has_glass = bsdfs.occurs(materials, "transmissive")
    sample_lights = strategy != "bsdf" and choice is not None and bsdfs.occurs(materials, "smooth")

    def end(path: Path) -> Path:
        return path._replace(alive=jnp.bool_(False))

    ray = path.ray
    hit = geometry.closest_hit(shapes, ray)
    found = hit.primitive >= 0

    goes_on = found & (path.depth + 1 < scene.max_depth)
    surface = frame = wi = kind = row = None
    if shapes.tables:
        surface = geometry.surface(shapes, ray, hit)  # of a miss: not used
        frame, wi, kind, row = shading(materials, ray, hit, surface)
    # What many results share is computed once.
    u, surface, frame, wi, kind, row = lax.optimization_barrier((u, surface, frame, wi, kind, row))

    # ---- emission: bsdf sampling's share of the light that the ray ends on ------------------------------------------
    def emission():
        def at_surface():
            arrival = hit._replace(t=dot(surface.p - ray.o, ray.d)) if derivative else hit
            return emitters.hit(scene.emitters, shapes, choice, ray, arrival, surface)

        def at_infinity():
            return emitters.background(scene.emitters, choice, ray.d)

        Le, pdf_light = lax.cond(found, at_surface, at_infinity) if shapes.tables else at_infinity()
        if strategy == "mis":
            share = mis_weight(path.pdf, pdf_light)
        else:
            share = jnp.where(
                (strategy == "light") & sample_lights & jnp.isfinite(path.pdf) & (pdf_light > 0), 0, 1
            )
        if scene.hide_emitters:
            # What emits lets camera rays through, as in Mitsuba; the background is black to them.
            share = jnp.where(path.depth == 0, 0, share)
        return path.throughput * Le * share

    # Most surfaces are dark.
    bright = ~found | geometry.emits(shapes, hit) if shapes.tables else True
    emitted = lax.cond(bright, emission, lambda: jnp.zeros_like(path.throughput))
    L = Gain(emitted, jnp.zeros_like(emitted)) if isinstance(path.L, Gain) else path.L + emitted
    if scene.hide_emitters:
        hidden = found & (path.depth == 0) & geometry.emits(shapes, hit)
    path = path._replace(L=L, depth=path.depth + 1)

    def scatter(path: Path) -> Path:
        # ---- light sample -----------------------------------------------------------------------------------------
        L = path.L
        if sample_lights:

            smooth = bsdfs.has(materials, kind, "smooth")

            def direct():
                drawn = emitters.sample(scene.emitters, shapes, choice, surface.p, u.light, u.triangle)
                drawn = lax.optimization_barrier(drawn)
                wo = to_local(frame, drawn.d)
                f, pdf_bsdf = bsdfs.evaluate(materials, kind, row, surface, wi, wo)
                share = mis_weight(drawn.density, pdf_bsdf) if strategy == "mis" else 1
                possible = (drawn.pdf > 0) & (pdf_bsdf > 0)
                scale = lax.optimization_barrier(share / jnp.where(possible, drawn.pdf, 1))
                contribution = f * drawn.Le * scale
                # A shadow ray of negative length is not traced.
                useful = goes_on & smooth & possible & (derivative | jnp.any(contribution > 0))
                reach = jnp.where(useful, drawn.distance, -1)
                shadow_ray = spawn_ray(surface, drawn.d, hit.primitive)._replace(t_max=reach)
                shadow_ray, contribution = lax.optimization_barrier((shadow_ray, contribution))
                visible = useful & ~geometry.occluded(shapes, shadow_ray, drawn.primitive)
                return jnp.where(visible, contribution, 0)

            light = path.throughput * lax.cond(smooth, direct, lambda: jnp.zeros_like(path.throughput))
            L = L._replace(light=light) if isinstance(L, Gain) else L + light

        # ---- bsdf sample ------------------------------------------------------------------------------------------
        drawn = bsdfs.sample(materials, kind, row, surface, wi, u.bsdf)
        d = to_world(frame, drawn.wo)
        drawn, d = lax.optimization_barrier((drawn, d))
        if path.pending is not None:
            splits = bsdfs.has(materials, kind, "branches") & (path.splits > 0)
            drawn = drawn._replace(weight=jnp.where(splits, drawn.pdf, 1) * drawn.weight)
        throughput = path.throughput * drawn.weight

        # ---- roulette ---------------------------------------------------------------------------------------------
        largest = lax.stop_gradient(larger(larger(throughput[0], throughput[1]), throughput[2]))
        left, passive, glass = largest, None, None
        if has_glass:
            # Refraction scales radiance, not importance: without this, paths in glass would end too soon.
            passive = lax.stop_gradient(path.passive * drawn.passive)
            left = safe_divide(largest, passive)
        survival = larger(smaller(left, most), least)
        survival = jnp.where(path.depth >= scene.rr_depth, survival, 1) if control is None else jnp.ones_like(left)
        survival = lax.optimization_barrier(survival)
        # A direction of density 0 (in the surface, by rounding; a branch of glass that cannot be) carries nothing.
        alive = (kind >= 0) & (drawn.pdf > 0) & (derivative | (largest > 0)) & (u.roulette < survival)
        pdf = jnp.where(drawn.delta, jnp.inf, drawn.pdf)
        if path.glass is not None:
            glass = path.glass | bsdfs.moving_bit(materials, kind, row)
        ray_on = spawn_ray(surface, d, hit.primitive)
        on = Path(ray_on, L, throughput / survival, pdf, passive, path.depth, alive, glass, expected=path.expected)
        if path.pending is None:
            return on
        on = on._replace(splits=path.splits - splits.astype(jnp.int32), pending=path.pending)
        return lax.cond(splits, split, lambda path, on: on, path, on)

    def split(path: Path, on: Path) -> Path:
        other = bsdfs.sample_other(materials, row, surface, wi, u.bsdf)
        branch = on._replace(
            ray=spawn_ray(surface, to_world(frame, other.wo), hit.primitive),
            throughput=path.throughput * other.weight * other.pdf,  # roulette comes at the next vertex
            passive=path.passive * other.passive,
            alive=other.pdf > 0,
        )
        return splitting.push(on, branch)

    if not shapes.tables:
        return end(path)
    if control is not None:
        path, goes_on = lax.cond(
            goes_on,
            lambda path: control.roulette(shapes, path, hit, surface, u.roulette, least, most),
            lambda path: (path, goes_on),
            path,
        )
    if scene.hide_emitters:
        beyond = spawn_ray(surface, ray.d, hit.primitive)._replace(t_max=ray.t_max - hit.t)
        through = path._replace(ray=beyond, depth=jnp.int32(0))
        path = lax.cond(hidden, lambda path: through, lambda path: lax.cond(goes_on, scatter, end, path), path)
    else:
        path = lax.cond(goes_on, scatter, end, path)
    return path if path.pending is None else splitting.resume(path)


def shading(materials, ray: Ray, hit, surface):
    """What scatters a ray at its hit.

    Returns:
        frame around the shading normal, wi (3,) in it, kind and row () int32 of the bsdf. Reflectors see either side as
        their front, so their frame is turned towards the ray; glass tells its sides apart.
    """
    frame = shading_frame(surface)
    wi = to_local(frame, -ray.d)
    kind, row = bsdfs.select(materials, hit.shape, wi[2] > 0)
    side = jnp.where(bsdfs.has(materials, kind, "sided") | (wi[2] > 0), 1, -1).astype(wi.dtype)
    return frame._replace(n=frame.n * side), jnp.stack([wi[0], wi[1], wi[2] * side]), kind, row


def mis_weight(pdf, other_pdf):
    """Power heuristic for a sample of density `pdf` > 0 that the other technique finds with `other_pdf`.

    1 for an infinite `pdf`, what cannot be found otherwise, even where a grazing light makes the other one overflow.
    """
    ratio = other_pdf / pdf
    return jnp.where(jnp.isinf(pdf), 1, 1 / (1 + ratio * ratio))


# The camera is vertex 0 of the sampler, so what a path meets at depth d is vertex d + 1.


def camera_numbers(scene, stream, sample, points="lattice"):
    """Film (2,) and lens (2,).

    Args:
        stream: () uint32 of `sampler.pixel_stream`; sample: () uint32 number of the sample; points: of SAMPLERS.
    """
    u = sampler.POINTS[points](stream, sample, 0).astype(scene.camera.origin.dtype)
    return u[:2], u[2:]


def bounce_numbers(scene, stream, sample, depth, points="lattice") -> Bounce:
    """Random numbers of the vertex number depth."""
    dtype = scene.camera.origin.dtype
    u = sampler.POINTS[points](stream, sample, depth + 1).astype(dtype)
    rest = sampler.hashed(sampler.path_key(stream, sample), 2 * depth, 2).astype(dtype)
    return Bounce(u[:2], u[2:], rest[0], rest[1])
