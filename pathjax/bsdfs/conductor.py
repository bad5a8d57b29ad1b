"""Smooth metals and ideal mirrors."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from pathjax.bsdfs import fresnel
from pathjax.core.math import at
from pathjax.core.types import BSDFSample


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ConductorTable:
    specular_reflectance: jax.Array  # (R, 3)
    eta: jax.Array | None  # (R, 3); None: no row is a metal, all reflect ideally
    k: jax.Array | None  # (R, 3)
    ideal: jax.Array | None  # (R,) bool, this row has no Fresnel term


SMOOTH, DELTA, TRANSMISSIVE, SIDED, BRANCHES, MOVES_PATHS = False, True, False, False, False, False


def sample(table: ConductorTable, row, uv, wi, u) -> BSDFSample:
    """Mirror direction; the weight is the Fresnel reflectance times `specular_reflectance`."""
    weight = at(table.specular_reflectance, row)
    if table.eta is not None:
        f = fresnel.conductor(wi[2], at(table.eta, row), at(table.k, row))
        weight = weight * jnp.where(at(table.ideal, row), 1, f)
    one = jnp.ones_like(wi[2])
    return BSDFSample(jnp.stack([-wi[0], -wi[1], wi[2]]), weight, one, jnp.bool_(True), one)
