"""Lambertian reflection."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from pathjax.core.math import at
from pathjax.core.types import BSDFSample
from pathjax.core.warp import square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.textures.texture import Textures, lookup


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DiffuseTable:
    reflectance: jax.Array  # (R, 3); of a textured row: ignored
    texture: jax.Array | None  # (R,) int32 row of the textures, -1: none; None: no row has one
    textures: Textures | None


SMOOTH, DELTA, TRANSMISSIVE, SIDED, BRANCHES, MOVES_PATHS = True, False, False, False, False, False


def reflectance(table: DiffuseTable, row, uv):
    """(3,) albedo."""
    constant = at(table.reflectance, row)
    if table.texture is None:
        return constant
    texture = at(table.texture, row)
    return jax.lax.cond(
        texture >= 0, lambda: lookup(table.textures, jnp.maximum(texture, 0), uv), lambda: constant
    )


def evaluate(table: DiffuseTable, row, uv, wi, wo):
    """f |cos theta_o| (3,) and pdf [1/sr] (); 0 below the surface. wi.z > 0 is the caller's to see to."""
    cos = jnp.maximum(wo[2], 0)
    return reflectance(table, row, uv) * (cos / math.pi), square_to_cosine_hemisphere_pdf(wo)


def sample(table: DiffuseTable, row, uv, wi, u) -> BSDFSample:
    """Cosine-distributed `wo`; the weight is the albedo. u: (2,)."""
    wo = square_to_cosine_hemisphere(u)
    one = jnp.ones_like(wo[2])
    return BSDFSample(wo, reflectance(table, row, uv), square_to_cosine_hemisphere_pdf(wo), jnp.bool_(False), one)
