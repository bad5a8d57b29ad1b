"""The IORs of smooth glass in a scene: parameters that move paths."""

from __future__ import annotations

from jaxtyping import Array, Float

from pathjax.bsdfs import dielectric
from pathjax.kinds import Table
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene


def table(scene: Scene) -> Table:
    """Return the table of dielectrics. The scene must have some."""
    return scene.materials.tables[dielectric.place(scene.materials)]


def with_table(scene: Scene, table: Table) -> Scene:
    return named.put(scene, ("materials", "tables", dielectric.place(scene.materials)), table)


def ratio_by(scene: Scene, parameter: Parameter) -> Float[Array, ""]:
    """Return the derivative of the relative IOR int_ior / ext_ior in one of the two."""
    return dielectric.relative_ior_by(table(scene), parameter.index[0], parameter.field)


def at_ratio(scene: Scene, name: str, ratio: float) -> Float[Array, ""]:
    """Return the value of the IOR `name` at which int_ior / ext_ior of its glass is `ratio`."""
    parameter = named.find(scene, name)
    return dielectric.ior_at(table(scene), parameter.index[0], parameter.field, ratio)
