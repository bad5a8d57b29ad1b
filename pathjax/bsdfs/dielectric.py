"""Smooth glass."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.bsdfs import fresnel
from pathjax.core.math import at, larger, smaller
from pathjax.core.types import BSDFSample


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DielectricTable:
    int_ior: jax.Array  # (R,) on the side that the normal points away from
    ext_ior: jax.Array  # (R,)
    # (R,) int_ior / ext_ior by which rows choose between reflection and refraction while their own IOR varies, for
    # derivatives; 0: this row chooses by its own. None, outside derivatives: all do.
    choose_by: jax.Array | None = None
    fresnel: str = field(default="exact", metadata={"static": True})  # of REFLECTANCES


SMOOTH, DELTA, TRANSMISSIVE, SIDED, BRANCHES, MOVES_PATHS = False, True, True, True, True, True
REFLECTANCES = {"exact": fresnel.dielectric, "schlick": fresnel.schlick}
# Least probability of either branch where the choice is by another IOR: with one that vanishes as Fresnel's terms do,
# derivatives near the critical angle have infinite variance; with a constant it grows as a logarithm.
MIN_BRANCH = 0.1


def sample(table: DielectricTable, row, uv, wi, u, other: bool = False) -> BSDFSample:
    """Reflect with probability R, else refract; by the probabilities of `choose_by` where a row has it.

    other: what would not have been drawn, of pdf 0 where it cannot be. For both, pdf * weight is the share of light.

    wi may lie on either side: wi.z < 0 comes from inside. Radiance is scaled by 1/eta^2 on refraction, eta being the
    IOR of the far side over that of the near side (PBRT 4 ed., 9.5.2).
    """
    ratio = at(table.int_ior, row) / at(table.ext_ior, row)
    outside = wi[2] > 0
    eta = jnp.where(outside, ratio, 1 / ratio)
    cos_i = smaller(jnp.abs(wi[2]), jnp.ones_like(eta))
    reflectance = REFLECTANCES[table.fresnel]
    r, cos_t = reflectance(cos_i, eta)
    p, choose_by = r, None
    if table.choose_by is not None:
        choose_by = at(table.choose_by, row)
        p = jnp.where(choose_by > 0, _frozen_choice(reflectance, cos_i, choose_by, outside, r), r)
    p = lax.stop_gradient(p)
    reflect = u[0] >= p if other else u[0] < p
    inv = 1 / eta
    refracted = jnp.stack([-wi[0] * inv, -wi[1] * inv, jnp.where(outside, -cos_t, cos_t)])
    wo = jnp.where(reflect, jnp.stack([-wi[0], -wi[1], wi[2]]), refracted)
    weight = jnp.where(reflect, 1, inv * inv)
    pdf = larger(jnp.where(reflect, p, 1 - p), jnp.zeros_like(p))
    if choose_by is not None:
        share = jnp.where(reflect, r, 1 - r) / jnp.where(pdf > 0, pdf, 1)
        weight = weight * jnp.where(choose_by > 0, share, 1)
    return BSDFSample(wo, jnp.broadcast_to(weight, (3,)), pdf, jnp.bool_(True), weight)


def _frozen_choice(reflectance, cos_i, ratio, outside, r):
    """Probability of reflection by another IOR `ratio`, for a path whose own reflectance is r: 1 where that is."""
    p, _ = reflectance(cos_i, jnp.where(outside, ratio, 1 / ratio))
    return jnp.where(r < 1, jnp.clip(p, MIN_BRANCH, 1 - MIN_BRANCH), 1)
