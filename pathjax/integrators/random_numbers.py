"""Random numbers of a path: four of a low-discrepancy point for each vertex, and hashed ones for its other choices.

The camera is vertex 0 of the sampler, so the vertex of a path at depth d is vertex d + 1.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax import bsdfs
from pathjax.core import sampler
from pathjax.scene.scene import Scene

# First hashed dimension for lobes: the others take two per depth, and depths end at `scene.UNBOUNDED`, 2^30.
_LOBES = 1 << 31
_LEAVES = _LOBES + (1 << 30)


class Bounce(NamedTuple):
    """Random numbers of one vertex, uniform in [0, 1)."""

    light: Float[Array, "2"]
    bsdf: Float[Array, " numbers"]  # 2 or 3, see `bsdf_dimensions`
    triangle: Float[Array, ""]  # chooses within a mesh that emits
    roulette: Float[Array, ""]
    leaf: Float[Array, ""] | None = None  # chooses among bsdfs that hold others; None: there are none
    flight: Float[Array, "2"] | None = None  # distance to a scattering event; None: no medium scatters
    # For derivatives in grids: a point of the flight, a segment of a shadow ray, a point on it; None: there are none.
    along: Float[Array, "3"] | None = None


def camera_numbers(
    scene: Scene, stream: sampler.Word, sample: sampler.Word, points: str = "lattice"
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Return the numbers for film and lens. stream: of `sampler.pixel_stream`; points: one of `options.SAMPLERS`."""
    u = sampler.POINTS[points](stream, sample, 0).astype(scene.camera.origin.dtype)
    return u[:2], u[2:]


def bounce_numbers(
    scene: Scene,
    stream: sampler.Word,
    sample: sampler.Word,
    depth: Int[Array, ""],
    points: str = "lattice",
    along: bool = False,
) -> Bounce:
    """Return the random numbers of the vertex of index `depth`. along: whether to draw `Bounce.along`."""
    dtype = scene.camera.origin.dtype
    u = sampler.POINTS[points](stream, sample, depth + 1).astype(dtype)
    key = sampler.path_key(stream, sample)
    rest = sampler.hashed(key, 2 * depth, 2).astype(dtype)
    bsdf = u[2:]
    if bsdf_dimensions(scene.materials) == 3:
        lobe = sampler.hashed(key, jnp.uint32(_LOBES) + depth.astype(jnp.uint32), 1).astype(dtype)
        bsdf = jnp.concatenate([bsdf, lobe])
    leaf = None
    if scene.materials.wrappers:
        leaf = sampler.hashed(key, jnp.uint32(_LEAVES) + depth.astype(jnp.uint32), 1)[0].astype(dtype)
    flight = None
    if scene.scatters:
        flight = sampler.hashed(sampler.hash_u32(key), 2 * depth, 2).astype(dtype)
    points_of_ways = sampler.hashed(sampler.hash_u32(~key), 3 * depth, 3).astype(dtype) if along else None
    return Bounce(u[:2], bsdf, rest[0], rest[1], leaf, flight, points_of_ways)


def bsdf_dimensions(materials: bsdfs.Materials) -> int:
    """Return how many numbers a bsdf draws: 2 for its direction, and a third if some kind chooses among lobes."""
    return 3 if bsdfs.occurs(materials, "lobes") else 2
