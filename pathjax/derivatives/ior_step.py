"""The step of a central difference in an IOR: one that moves the image by a part of a pixel."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax import bsdfs
from pathjax.bsdfs import dielectric
from pathjax.compile import native, native_map
from pathjax.core.math import at, dot, safe_divide, spawn_ray
from pathjax.derivatives import ior
from pathjax.integrators.random_numbers import bsdf_dimensions
from pathjax.integrators.vertex import sample, vertex
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.shapes import geometry

# Median motion of the image under one step, in pixels: less adds noise, more adds bias.
STEP_PIXELS = 0.35
# Bounds of the step, relative to the IOR: float32 resolves the lower; above the upper a difference is no derivative.
MIN_STEP, MAX_STEP = 2e-4, 0.03
# Rays that are traced to measure the motion of the image, and the most vertices of each.
_PILOTS, _PILOT_DEPTH = 1024, 12


def steps(scene: Scene, rows: tuple[int, ...], step: float | Float[Array, ""] | None) -> Float[Array, " G"]:
    """Return steps of the relative IOR for some dielectrics: `step`, unless it is None or too large for the IOR."""
    if not rows:
        return jnp.asarray(np.zeros(0, scene.camera.origin.dtype))
    return _steps(scene, np.array(rows, np.int32), step)


@jax.jit
def _steps(scene, rows, step):
    ratio = dielectric.relative_ior(ior.table(scene))[rows]
    if step is not None:
        # The IOR must stay positive at twice the step.
        return jnp.minimum(jnp.asarray(step, ratio.dtype), 0.4 * ratio)
    motion = motions(scene, rows)
    wished = STEP_PIXELS / jnp.where(motion > 0, motion, 1)
    # Glass that no pilot saw (small, or met after a diffuse bounce) gets a step in the middle of the range.
    wished = jnp.where(motion > 0, wished, 0.1 * MAX_STEP * ratio)
    return jnp.clip(wished, MIN_STEP * ratio, MAX_STEP * ratio)


@jax.jit
def motions(scene: Scene, rows: Int[Array, " G"]) -> Float[Array, " G"]:
    """Return the median motion of the image seen through glass, in pixels per unit of relative IOR; 0: not seen."""
    count = film.pixel_count(scene.film)
    pilots = jnp.asarray(np.unique(np.linspace(0, count - 1, min(_PILOTS, count)).astype(np.int32)))
    # Lanes take four times as long to compile, which costs more than so few rays take in any form.
    form = "loop" if native() else None
    return jax.vmap(lambda row: _median(native_map(_motion, pilots, scene, row, form=form)))(rows)


def _median(x):
    seen = jnp.isfinite(x)
    return jnp.where(jnp.any(seen), jnp.nanmedian(jnp.where(seen, x, jnp.nan)), 0)


def _motion(pixel_number, scene, row):
    """Return the motion of the image at a pixel's centre per unit of a dielectric's relative IOR; NaN: not seen."""
    table = ior.table(scene)
    ratios = dielectric.relative_ior(table)
    ratio = at(ratios, row)
    half = jnp.full((2,), 0.5, ratio.dtype)
    middle, _ = film.sample_position(scene.film, pixel_number, half)
    size = jnp.array([scene.film.width, scene.film.height], ratio.dtype)

    def seen(x):
        """Return where a ray ends that refracts wherever it can: a point, or its direction if it hits nothing."""
        varied = ior.with_table(scene, dielectric.with_relative_ior(table, x[0], jnp.arange(len(ratios)) == row))
        ray = scene.camera.sample_ray(middle + x[1:] / size, half)
        refracts = jnp.full((bsdf_dimensions(scene.materials),), 1 - 2**-24, ratio.dtype)

        def extend(state):
            ray, _, met, depth, _ = state
            hit = geometry.closest_hit(scene.geometry, ray)
            found = hit.primitive >= 0
            here = vertex(varied, ray, hit, half[0] if scene.materials.wrappers else None)
            drawn, d = sample(varied, here, refracts)
            on = found & drawn.delta & (here.kind >= 0)
            end = jnp.where(found, here.surface.p, ray.d)
            met = met | (found & bsdfs.has(varied.materials, here.kind, "moves_paths") & (here.row == row))
            return spawn_ray(here.surface, d, hit.primitive), end, met, depth + 1, on

        start = ray, ray.o, jnp.bool_(False), jnp.int32(0), jnp.bool_(True)
        _, end, met, _, unfinished = lax.while_loop(lambda s: s[-1] & (s[-2] < _PILOT_DEPTH), extend, start)
        return end, met & ~unfinished

    start = jnp.concatenate([ratio[None], jnp.zeros((2,), ratio.dtype)])
    basis = jnp.eye(3, dtype=ratio.dtype)
    moved, met = jax.vmap(lambda t: jax.jvp(seen, (start,), (t,), has_aux=True)[1:], out_axes=(0, None))(basis)
    # Least squares: the shift in the image that would move the end as the IOR does.
    by_ior, by_x, by_y = moved
    xx, xy, yy, bx, by = dot(by_x, by_x), dot(by_x, by_y), dot(by_y, by_y), dot(by_ior, by_x), dot(by_ior, by_y)
    determinant = xx * yy - xy * xy
    shift = jnp.stack([safe_divide(yy * bx - xy * by, determinant), safe_divide(xx * by - xy * bx, determinant)])
    return jnp.where(met, jnp.hypot(shift[0], shift[1]), jnp.nan)
