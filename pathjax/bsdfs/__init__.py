"""How surfaces scatter: a file a kind, and the dispatch over the kinds that a scene holds.

A material has a front and a back, each a bsdf or nothing (which absorbs). A bsdf is a kind and a row in the table of
that kind. Reflectors see `wi` in a frame turned towards it; a dielectric keeps the frame, whose normal tells inside
from outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.bsdfs import conductor, dielectric, diffuse
from pathjax.bsdfs.conductor import ConductorTable
from pathjax.bsdfs.dielectric import DielectricTable
from pathjax.bsdfs.diffuse import DiffuseTable
from pathjax.core.math import at
from pathjax.core.types import BSDFSample

FRESNEL = tuple(dielectric.REFLECTANCES)
MODULES = {DiffuseTable: diffuse, DielectricTable: dielectric, ConductorTable: conductor}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Materials:
    tables: tuple  # one entry per kind of bsdf present
    sides: jax.Array  # (S, 2, 2) int32 of each shape: front and back; kind (-1: absorbs), row


def occurs(materials: Materials, capability: str) -> bool:
    """Whether some kind present is capable of it, of CAPABILITIES."""
    return any(getattr(MODULES[type(table)], capability.upper()) for table in materials.tables)


def with_fresnel(materials: Materials, fresnel: str) -> Materials:
    """The same, whose dielectrics reflect by one of `dielectric.REFLECTANCES`."""
    tables = (replace(t, fresnel=fresnel) if isinstance(t, DielectricTable) else t for t in materials.tables)
    return replace(materials, tables=tuple(tables))


def select(materials: Materials, shape, front):
    """Kind and row, () int32 each, of the side of a shape; where there is none, -1, those of some shape."""
    kind, row = at(materials.sides, jnp.maximum(shape, 0), jnp.where(front, 0, 1))
    return kind, row


def has(materials: Materials, kind, capability: str):
    """() bool: whether this kind of bsdf is capable of it, of CAPABILITIES; nothing is where there is no bsdf."""
    flags = [getattr(MODULES[type(table)], capability.upper()) for table in materials.tables]
    if not any(flags):
        return jnp.bool_(False)
    if all(flags):
        return kind >= 0
    return at(jnp.array(flags), jnp.maximum(kind, 0)) & (kind >= 0)


def moving_bit(materials: Materials, kind, row):
    """() int32: bit row % 31 where parameters of the bsdf move paths, else 0."""
    return jnp.where(has(materials, kind, "moves_paths"), jnp.left_shift(jnp.int32(1), row % 31), 0)


def evaluate(materials: Materials, kind, row, surface, wi, wo):
    """f |cos theta_o| (3,) and pdf () of a smooth bsdf; 0 for the others."""
    smooth = [(i, table) for i, table in enumerate(materials.tables) if MODULES[type(table)].SMOOTH]

    def of(table):
        return lambda: MODULES[type(table)].evaluate(table, row, surface.uv, wi, wo)

    if len(smooth) == 1:
        return of(smooth[0][1])()
    index = sum((kind >= i).astype(jnp.int32) for i, _ in smooth[1:])
    return lax.switch(index, [of(table) for _, table in smooth])


def sample(materials: Materials, kind, row, surface, wi, u) -> BSDFSample:
    """Draw `wo` and its weight from the bsdf. u: (2,)."""

    def of(table):
        return lambda: MODULES[type(table)].sample(table, row, surface.uv, wi, u)

    if len(materials.tables) == 1:
        return of(materials.tables[0])()
    return lax.switch(jnp.maximum(kind, 0), [of(table) for table in materials.tables])


def sample_other(materials: Materials, row, surface, wi, u) -> BSDFSample:
    """The branch of a dielectric that `sample` leaves out."""
    table = next(table for table in materials.tables if isinstance(table, DielectricTable))
    return dielectric.sample(table, row, surface.uv, wi, u, other=True)
