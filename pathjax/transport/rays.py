"""Form factors by ray casting: for any shapes, and without a number for each pair of patches."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy import sparse

from pathjax.core import sampler
from pathjax.core.math import dot, frame_from_normal, spawn_ray, to_world
from pathjax.core.types import Surface
from pathjax.core.warp import square_to_cosine_hemisphere
from pathjax.runtime import native_map
from pathjax.scene import Scene
from pathjax.shapes import geometry
from pathjax.transport.patches import Patches, patch_at, point

# Rays of one call of the kernel: what they hit takes some tens of megabytes.
_RAYS_PER_CALL = 1 << 22


def cast(scene: Scene, patches: Patches, rays: int, seed: int) -> tuple[sparse.csr_array, np.ndarray]:
    """How many of the rays that each patch sends, uniform in area and by the cosine in direction, meet each other one.

    Returns:
        counts (U, U) sparse, of rays from the patch of the row to that of the column; and lost (U,), those that met
        nothing or a side that is black.
    """
    count = patches.count
    counts = sparse.csr_array((count, count))
    lost = np.zeros(count)
    each = max(min(rays, _RAYS_PER_CALL // count), 1)
    for first in range(0, rays, each):
        sender, number = np.divmod(np.arange(count * each, dtype=np.int32), np.int32(each))
        # The last call repeats its last samples up to full length.
        number = number + np.int32(first)
        met = np.asarray(_cast(scene.geometry, patches, sender, number, np.uint32(seed)))
        valid = number < rays
        lost += np.bincount(sender[valid & (met == count)], minlength=count)
        valid &= met < count
        ones = np.ones(np.count_nonzero(valid))
        counts = counts + sparse.csr_array((ones, (sender[valid], met[valid])), shape=(count, count))
    return counts, lost


@partial(jax.jit, static_argnames=("form", "devices"))
def _cast(shapes, patches, sender, number, seed, form=None, devices=None):
    return native_map(_one, (sender, number), shapes, patches, seed, form=form, devices=devices)


def _one(work, shapes, patches, seed):
    """Patch that ray `number` of the patch `sender` meets."""
    sender, number = work
    stream = sampler.pixel_stream(seed, sender)
    numbers = (sampler.sobol_pair(stream, number, pair) for pair in (0, 1))
    u, u_direction = lax.optimization_barrier(tuple(x.astype(patches.area.dtype) for x in numbers))
    primitive, p, n, margin = point(patches, shapes, sender, u)
    d = to_world(frame_from_normal(n), square_to_cosine_hemisphere(u_direction))
    ray = lax.optimization_barrier(spawn_ray(Surface(p, n, margin, n, u), d, primitive))
    hit = geometry.closest_hit(shapes, ray)
    surface = geometry.surface(shapes, ray, hit)
    met = patch_at(patches, shapes, jnp.maximum(hit.primitive, 0), surface.p, dot(surface.n, d) > 0)
    return jnp.where(hit.primitive >= 0, met, patches.count)


def exchange(counts: sparse.csr_array, area: np.ndarray, rays: int) -> tuple[sparse.coo_array, np.ndarray]:
    """A_i F_ij, symmetric, from the rays of both patches, and its standard errors at the same places.

    Rays from i to j estimate A_i F_ij as do those from j to i; what is best known counts most, by rays per area: with
    n_i = rays / A_i, (counts_ij + counts_ji) / (n_i + n_j) is unbiased and of the least variance.
    """
    both = sparse.coo_array(counts + counts.T)
    density = rays / area
    scale = 1 / (density[both.row] + density[both.col])
    return sparse.coo_array((both.data * scale, (both.row, both.col)), shape=both.shape), np.sqrt(both.data) * scale
