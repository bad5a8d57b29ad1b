"""Smooth glass."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from pathjax.bsdfs import fresnel
from pathjax.core.math import at, larger, smaller
from pathjax.core.types import BSDFSample


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DielectricTable:
    int_ior: jax.Array  # (R,) on the side that the normal points away from
    ext_ior: jax.Array  # (R,)


SMOOTH = False


def sample(table: DielectricTable, row, uv, wi, u) -> BSDFSample:
    """Reflect with probability R, else refract.

    wi may lie on either side: wi.z < 0 comes from inside. Radiance is scaled by 1/eta^2 on refraction, eta being the
    IOR of the far side over that of the near side (PBRT 4 ed., 9.5.2).
    """
    ratio = at(table.int_ior, row) / at(table.ext_ior, row)
    outside = wi[2] > 0
    eta = jnp.where(outside, ratio, 1 / ratio)
    cos_i = smaller(jnp.abs(wi[2]), jnp.ones_like(eta))
    r, cos_t = fresnel.dielectric(cos_i, eta)
    reflect = u[0] < r
    inv = 1 / eta
    refracted = jnp.stack([-wi[0] * inv, -wi[1] * inv, jnp.where(outside, -cos_t, cos_t)])
    wo = jnp.where(reflect, jnp.stack([-wi[0], -wi[1], wi[2]]), refracted)
    weight = jnp.where(reflect, 1, inv * inv)
    pdf = larger(jnp.where(reflect, r, 1 - r), jnp.zeros_like(r))
    return BSDFSample(wo, jnp.broadcast_to(weight, (3,)), pdf, jnp.bool_(True), jnp.where(reflect, 1, eta))
