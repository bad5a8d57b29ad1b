"""Form factors by ray casting, for any shapes, without storing a value for each pair of patches."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from pathjax.compile import compute_once, native_map
from pathjax.core import sampler
from pathjax.core.math import dot, frame_from_normal, spawn_ray, to_world
from pathjax.core.types import Surface
from pathjax.core.warp import square_to_cosine_hemisphere
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry
from pathjax.transport.patches import Patches, patch_at, point

# Rays per call of the kernel: their results take some tens of megabytes.
_RAYS_PER_CALL = 1 << 22


def cast(scene: Scene, patches: Patches, rays: int, seed: int) -> tuple[sparse.csr_array, np.ndarray, np.ndarray]:
    """Count the rays from each patch, uniform in area and cosine-weighted in direction, that meet each other patch.

    Args:
        rays: mean number per patch. Half of them are distributed equally and half in proportion to area, so that the
            patches of a fine mesh do not take all.
    Returns:
        counts (U, U) sparse, of rays from the patch of the row to that of the column; sent (U,), rays of each patch;
        and lost (U,), those that met nothing or a black side.
    """
    count, area = patches.count, np.asarray(patches.area, float)
    sent = np.maximum(np.rint(rays / 2 * (1 + area / area.mean())), 1).astype(int)
    first = np.cumsum([0, *sent])
    counts, lost = sparse.csr_array((count, count)), np.zeros(count)
    each = min(_RAYS_PER_CALL, first[-1])
    for start in range(0, first[-1], each):
        # The last call repeats its last ray up to full length.
        ray = np.minimum(np.arange(start, start + each), first[-1] - 1)
        sender = np.searchsorted(first, ray, side="right") - 1
        work = (x.astype(np.int32) for x in (sender, ray - first[sender]))
        met = np.asarray(_cast(scene.geometry, patches, *work, np.uint32(seed)))
        sender, met = (x[: first[-1] - start] for x in (sender, met))
        found = met < count
        lost += np.bincount(sender[~found], minlength=count)
        ones = np.ones(np.count_nonzero(found))
        counts = counts + sparse.csr_array((ones, (sender[found], met[found])), shape=(count, count))
    return counts, sent, lost


@jax.jit
def _cast(shapes, patches, sender, number, seed):
    return native_map(_one, (sender, number), shapes, patches, seed)


def _one(work, shapes, patches, seed):
    """Return the patch that ray `number` of the patch `sender` meets; `patches.count` for none."""
    sender, number = work
    stream = sampler.pixel_stream(seed, sender)
    numbers = compute_once(sampler.lattice_point(stream, number, 0).astype(patches.area.dtype))
    u, u_direction = numbers[:2], numbers[2:]
    primitive, p, n, margin = point(patches, shapes, sender, u)
    d = to_world(frame_from_normal(n), square_to_cosine_hemisphere(u_direction))
    ray = compute_once(spawn_ray(Surface(p, n, margin, n, u), d, primitive))
    hit = geometry.closest_hit(shapes, ray)
    surface = geometry.surface(shapes, ray, hit)
    met = patch_at(patches, shapes, jnp.maximum(hit.primitive, 0), surface.p, dot(surface.n, d) > 0)
    return jnp.where(hit.primitive >= 0, met, patches.count)


def exchange(counts: sparse.csr_array, density: np.ndarray) -> tuple[sparse.coo_array, np.ndarray]:
    """Return A_i F_ij, symmetric, from the rays of both patches, and the standard errors of its entries.

    Rays from i to j and rays from j to i both estimate A_i F_ij. With n_i = rays / A_i, the density (U,),
    (counts_ij + counts_ji) / (n_i + n_j) is unbiased and, since counts are Poisson-distributed, of least variance.
    """
    both = sparse.coo_array(counts + counts.T)
    scale = 1 / (density[both.row] + density[both.col])
    return sparse.coo_array((both.data * scale, (both.row, both.col)), shape=both.shape), np.sqrt(both.data) * scale
