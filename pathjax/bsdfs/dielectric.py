"""Smooth glass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.interface import Interface
from pathjax.bsdfs.ior import IOR, LEAST_IOR
from pathjax.core.math import larger, smaller
from pathjax.core.types import BSDFSample
from pathjax.description.elements import nearest
from pathjax.kinds import Internal, Number, Row, Setting, Table

REFLECTANCES = {"exact": fresnel.dielectric, "schlick": fresnel.schlick}
# Least probability of either branch where another IOR decides the choice. With a probability that vanishes as Fresnel's
# terms do, derivatives near the critical angle have infinite variance; with this bound it grows as a logarithm.
MIN_BRANCH = 0.1


@dataclass(frozen=True)
class IndexOfRefraction(Number):
    """A positive number; files may name a material instead."""

    bounds: tuple[float, float] = (LEAST_IOR, math.inf)

    def read(self, loader, fields, name, owner):
        value = fields.float_or_name(name, self.default, at_least=self.bounds[0])
        if isinstance(value, str):
            if value.lower() not in IOR:
                use = f"use a number or one of {', '.join(IOR)}{nearest(value, IOR)}"
                raise fields.error(name, f'cannot be "{value[:40]}"; {use}')
            value = IOR[value.lower()]
        return value


class Dielectric(Interface):
    """Smooth interface; `int_ior` lies on the side that the normal points away from."""

    int_ior = IndexOfRefraction(IOR["bk7"], moves_paths=True)
    ext_ior = IndexOfRefraction(IOR["air"], moves_paths=True)
    # For derivatives: int_ior / ext_ior by which a row chooses between reflection and refraction while its own IOR
    # varies; 0: it chooses by its own. None, outside derivatives: all rows choose by their own.
    choose_by = Internal()
    fresnel = Setting("exact", options=tuple(REFLECTANCES))
    delta = branches = True

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"], other: bool = False) -> BSDFSample:
        """Reflect with probability R, else refract; where a row has `choose_by`, with the probability at that IOR.

        Args:
            wi: on either side; wi.z < 0 comes from inside.
            other: return the branch that is not drawn; its pdf is 0 where it is impossible.
        Returns:
            The sample. For both branches, pdf * weight is the share of light. Refraction scales radiance by 1/eta^2,
            with eta the IOR of the far side over that of the near side (PBRT 4 ed., 9.5.2).
        """
        ratio = fresnel.relative(p.int_ior, p.ext_ior)
        outside = wi[2] > 0
        eta = jnp.where(outside, ratio, 1 / ratio)
        cos_i = smaller(jnp.abs(wi[2]), jnp.ones_like(eta))
        reflectance = REFLECTANCES[p.fresnel]
        r, cos_t = reflectance(cos_i, eta)
        chance, choose_by = r, p.choose_by
        if choose_by is not None:
            chance = jnp.where(choose_by > 0, _frozen_choice(reflectance, cos_i, choose_by, outside, r), r)
        chance = lax.stop_gradient(chance)
        reflect = u[0] >= chance if other else u[0] < chance
        inv = 1 / eta
        refracted = jnp.stack([-wi[0] * inv, -wi[1] * inv, jnp.where(outside, -cos_t, cos_t)])
        wo = jnp.where(reflect, jnp.stack([-wi[0], -wi[1], wi[2]]), refracted)
        weight = jnp.where(reflect, 1, inv * inv)
        pdf = larger(jnp.where(reflect, chance, 1 - chance), jnp.zeros_like(chance))
        if choose_by is not None:
            share = jnp.where(reflect, r, 1 - r) / jnp.where(pdf > 0, pdf, 1)
            weight = weight * jnp.where(choose_by > 0, share, 1)
        return BSDFSample(wo, Interface.tinted(p, weight, reflect), pdf, jnp.bool_(True), weight)


def _frozen_choice(reflectance, cos_i, ratio, outside, r):
    """Return the probability of reflection at the IOR `ratio`; 1 where the reflectance r at the own IOR is 1."""
    p, _ = reflectance(cos_i, jnp.where(outside, ratio, 1 / ratio))
    return jnp.where(r < 1, jnp.clip(p, MIN_BRANCH, 1 - MIN_BRANCH), 1)


# ---- for derivatives: paths move with the relative IOR, int_ior / ext_ior -------------------------------------------


def place(materials) -> int:
    """Return the index of the table of the dielectrics."""
    return next(i for i, table in enumerate(materials.tables) if table.kind is Dielectric)


def iors(table: Table) -> tuple[Float[Array, " R"], Float[Array, " R"]]:
    """Return int_ior and ext_ior."""
    return table.column("int_ior").values, table.column("ext_ior").values


def relative_ior(table: Table) -> Float[Array, " R"]:
    """Return int_ior / ext_ior."""
    inside, outside = iors(table)
    return inside / outside


def with_relative_ior(table: Table, ratio: Float[Array, "*#R"], rows: Bool[Array, " R"]) -> Table:
    """Return the table with the relative IOR `ratio` (one, or one per row) in the selected rows."""
    inside, outside = iors(table)
    return table.with_column("int_ior", jnp.where(rows, ratio * outside, inside))


def choosing_by(table: Table, ratio: Float[Array, " R"], rows: Bool[Array, " R"]) -> Table:
    """Return the table in which the selected rows choose branches as if their relative IOR were `ratio`."""
    return table.with_column("choose_by", jnp.where(rows, ratio, 0))


def relative_ior_by(table: Table, row: int, field: str) -> Float[Array, ""]:
    """Return the derivative of the relative IOR of a row in one of its parameters."""
    inside, outside = (values[row] for values in iors(table))
    return 1 / outside if field == "int_ior" else -inside / (outside * outside)


def ior_at(table: Table, row: int, field: str, ratio: float) -> Float[Array, ""]:
    """Return the value of a parameter of a row at which its relative IOR is `ratio`."""
    inside, outside = (values[row] for values in iors(table))
    return ratio * outside if field == "int_ior" else inside / ratio
