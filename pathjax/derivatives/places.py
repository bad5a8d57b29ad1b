"""Where the parameters that a path meets stand in one list of derivatives, and derivatives in what is looked up there.

The list holds the entries of all arrays that are differentiated, one array after another: the row of a constant, a
texel. A vertex of a path looks up a few numbers, each of one entry, or the sum of some (of four texels, say). A slot is
one such number: the first that a bsdf looks up, or the second, whatever the kind of the bsdf is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax import emitters
from pathjax.core.math import at
from pathjax.core.types import Hit
from pathjax.emitters import Choice
from pathjax.integrators.random_numbers import Bounce
from pathjax.integrators.vertex import Vertex
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Of the arrays that are differentiated, where they are in the scene.
Paths = tuple[tuple, ...]
# Of a table, where the values of its columns are in the scene -> place of the column.
Columns = dict[tuple, int]
# Of one number: places in the list, and their shares where there are several.
Entries = tuple[tuple[Int[Array, ""], ...], tuple[Float[Array, ""], ...] | None]


@dataclass(frozen=True)
class Slots:
    """What is differentiated, by slot: of each table (of bsdfs; of lights), the column that is looked up."""

    materials: tuple[tuple[int, ...], ...]  # by table of bsdfs
    lights: tuple[tuple[int, ...], ...]  # by table of lights

    @property
    def of_bsdfs(self) -> int:
        return max(map(len, self.materials), default=0)

    @property
    def of_lights(self) -> int:
        return max(map(len, self.lights), default=0)


def columns_of_bsdfs(scene: Scene) -> list[Columns]:
    """By table."""
    return [_columns(table, ("materials", "tables", i)) for i, table in enumerate(scene.materials.tables)]


def columns_of_textures(scene: Scene) -> list[Columns]:
    textures = scene.materials.textures
    tables = textures.tables if textures else ()
    return [_columns(table, ("materials", "textures", "tables", i)) for i, table in enumerate(tables)]


def columns_of_lights(scene: Scene) -> list[Columns]:
    return [_columns(lights.table, ("emitters", i, "table")) for i, lights in enumerate(scene.emitters)]


def _columns(table, path):
    return {(*path, "columns", i, "values"): i for i, column in enumerate(table.columns) if column is not None}


def slots(scene: Scene, paths: Paths) -> Slots:
    textured = any(path in columns for columns in columns_of_textures(scene) for path in paths)

    def looked_up(table, columns, textured):
        held = ((i, table.columns[i]) for i in columns.values())
        colors = [i for i, column in held if column.texture is not None and column.values.ndim == 2]
        return tuple(i for path, i in columns.items() if path in paths or (textured and i in colors))

    bsdfs = zip(scene.materials.tables, columns_of_bsdfs(scene), strict=True)
    lights = zip(scene.emitters, columns_of_lights(scene), strict=True)
    return Slots(
        tuple(looked_up(table, columns, textured) for table, columns in bsdfs),
        tuple(looked_up(each.table, columns, False) for each, columns in lights),  # their textures are their own
    )


def nudged(scene: Scene, slots: Slots, nudges: Float[Array, " slots"]) -> Scene:
    """The scene where each slot's number is larger by its nudge, of bsdfs first, in all channels."""

    def of(table, columns, nudges):
        shape = [table.columns[place].values.shape[1:] for place in columns]
        return table.nudged({place: jnp.broadcast_to(nudges[s], shape[s]) for s, place in enumerate(columns)})

    bsdfs = tuple(map(of, scene.materials.tables, slots.materials, [nudges] * len(slots.materials)))
    beyond = nudges[slots.of_bsdfs :]
    lights = tuple(
        replace(lights, table=of(lights.table, columns, beyond))
        for lights, columns in zip(scene.emitters, slots.lights, strict=True)
    )
    return replace(scene, materials=replace(scene.materials, tables=bsdfs), emitters=lights)


def firsts(scene: Scene, paths: Paths) -> tuple[dict[tuple, int], int]:
    """Where each array begins in the list, and the length of the list."""
    ends = np.cumsum([0, *(len(named.get(scene, path)) for path in paths)]).tolist()
    return dict(zip(paths, ends[:-1], strict=True)), ends[-1]


class LightPlaces(NamedTuple):
    """Of the numbers of lights, by slot."""

    on_surfaces: list[Int[Array, " R"]]  # by the number that `Geometry.light` has
    sampled: list[Int[Array, " R"]]  # by the number that is chosen
    background: list[int]


def of_lights(scene: Scene, choice: Choice | None, paths: Paths, slots: Slots) -> LightPlaces:
    first, _ = firsts(scene, paths)

    def rows(number, lights, slot):
        columns = slots.lights[number]
        begins = first["emitters", number, "table", "columns", columns[slot], "values"] if slot < len(columns) else 0
        return begins + (jnp.arange(lights.count, dtype=jnp.int32) if lights.row is None else lights.row)

    def listed(slot, wanted):
        found = [rows(number, lights, slot) for number, lights in enumerate(scene.emitters) if wanted(number, lights)]
        return jnp.concatenate(found) if found else jnp.zeros((1,), jnp.int32)

    def backgrounds(slot):
        found = [rows(number, scene.emitters[number], slot)[0] for number in emitters.backgrounds(scene.emitters)]
        return found[0] if found else jnp.int32(0)

    each = range(slots.of_lights)
    return LightPlaces(
        [listed(slot, lambda number, lights: lights.lamps is not None) for slot in each],
        [listed(slot, lambda number, lights: choice and choice.first[number] is not None) for slot in each],
        [backgrounds(slot) for slot in each],
    )


def of_hit(scene: Scene, places: LightPlaces, slot: int, hit: Hit) -> Int[Array, ""]:
    """Of the light that a ray meets; of any, where it meets none."""
    if not scene.geometry.tables:
        return places.background[slot]
    number = jnp.maximum(at(scene.geometry.light, jnp.maximum(hit.primitive, 0)), 0)
    return jnp.where(hit.primitive >= 0, at(places.on_surfaces[slot], number), places.background[slot])


def of_light_sample(
    choice: Choice, places: LightPlaces, slot: int, ref: Float[Array, "3"], u: Bounce
) -> Int[Array, ""]:
    number, _, _ = emitters.choose(choice, ref, u.light)
    return at(places.sampled[slot], number)


def of_bsdf(scene: Scene, paths: Paths, slots: Slots, slot: int, here: Vertex) -> Entries:
    """Of the number that the bsdf of a vertex looks up for a slot; of any, where it looks up none."""
    first, _ = firsts(scene, paths)
    materials = scene.materials
    textures = {
        (table, column): first[path]
        for table, columns in enumerate(columns_of_textures(scene))
        for path, column in columns.items()
        if path in first
    }
    zero = jnp.zeros_like(here.wi[0])
    most = max((table.kind.parts for table in materials.textures.tables), default=1) if textures else 1

    def of(number, table):
        def constant(column):
            begins = first.get(("materials", "tables", number, "columns", column, "values"))
            place = jnp.int32(0) if begins is None else begins + here.row
            none = (jnp.int32(0),) * (most - 1), (zero,) * (most - 1)
            return (place, *none[0]), (zero if begins is None else zero + 1, *none[1])

        def entries():
            if slot >= len(slots.materials[number]):
                return (jnp.int32(0),) * most, (zero,) * most
            column = slots.materials[number][slot]
            codes = table.columns[column].texture
            if not textures or codes is None:
                return constant(column)
            code = at(codes, here.row)

            def textured():
                return materials.textures.entries(code, here.surface, textures)

            return lax.cond(code[0] >= 0, textured, lambda: constant(column))

        return entries

    calls = [of(*each) for each in enumerate(materials.tables)]
    places, shares = calls[0]() if len(calls) == 1 else lax.switch(jnp.maximum(here.kind, 0), calls)
    return places, shares if most > 1 else None
