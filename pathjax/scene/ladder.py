"""Pads the arrays of scenes of one structure to the same sizes, so that the scenes share compiled kernels.

A kernel is compiled for the sizes of a scene's arrays. Arrays with thousands of entries (triangles, nodes and leaves of
hierarchies, texels, cells of volumes) and arrays with few (shapes, bsdfs, textures, lights) are padded up to rungs of a
coarse ladder. Entries are read by index only, and nothing holds the index of a padded entry: rays do not visit it, it
is never chosen as a light, and images are those of the scene itself. Their last bits may differ, as the kernel is
another program: so `render_until` pads every scene, whether in a batch or not.

Some properties are not padded and still distinguish kernels: whether there are so many lights that a tree chooses among
them, backgrounds, and shapes of a kind with so few that rays test them all.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Int, Shaped

from pathjax.compile import SELECTED_ROWS
from pathjax.emitters import Lights, light_tree
from pathjax.kinds import Color, Table
from pathjax.media.grids import Grids
from pathjax.scene.scene import Scene
from pathjax.shapes import Geometry
from pathjax.shapes.shape import Table as ShapeTable

# The lowest rung of long arrays, in bytes: it is filled in a millisecond, and holds meshes of some 10^5 triangles. The
# lowest rung of short arrays, in rows. Each rung is STEP times the one below.
MANY_BYTES, FEW_ROWS, STEP = 1 << 22, 64, 4
# Alignment in bytes; JAX's CPU devices copy unaligned arrays.
_ALIGNED = 64
# The depth of a hierarchy is padded to a multiple of this: the stack of a search holds one index per level.
LEVELS = 16


def padded(scene: Scene) -> Scene:
    """Return the scene with arrays of the ladder's sizes, only for kernels: its tables have more rows than are real."""
    materials = scene.materials
    textures = materials.textures
    if textures is not None:
        textures = replace(textures, tables=tuple(map(_kind, textures.tables)))
    materials = replace(
        materials,
        tables=tuple(map(_kind, materials.tables)),
        wrappers=tuple(map(_kind, materials.wrappers)),
        sides=_rows(materials.sides, _few(len(materials.sides))),
        textures=textures,
    )
    media = scene.media
    if media is not None:
        phases = tuple(map(_kind, media.phases))
        phase, sides = (_rows(values, _few(len(values))) for values in (media.phase, media.sides))
        varying = {"extinctions": _grids(media.extinctions), "albedos": _grids(media.albedos)}
        media = replace(media, table=_kind(media.table), phases=phases, phase=phase, sides=sides, **varying)
    lit, emitters = _emitters(scene.emitters, np.asarray(scene.geometry.light))
    geometry = _geometry(replace(scene.geometry, light=lit))
    scene = replace(scene, geometry=geometry, materials=materials, media=media, emitters=emitters)
    return jax.device_put(scene)  # once here, instead of in each call of a kernel


def _geometry(geometry: Geometry) -> Geometry:
    tables = tuple(map(_shapes, geometry.tables))
    counts = [table.count for table in geometry.tables]
    parted = np.cumsum(counts)[:-1]

    def numbered(values):
        """Pad values of all primitives, whose indices run through the tables."""
        parts = zip(np.split(np.asarray(values), parted), tables, strict=True)
        return np.concatenate([_rows(part, table.count) for part, table in parts]) if tables else values

    return replace(geometry, tables=tables, shape=numbered(geometry.shape), light=numbered(geometry.light))


def _emitters(emitters: tuple[Lights, ...], light: Int[np.ndarray, " N"]) -> tuple[np.ndarray, tuple[Lights, ...]]:
    """Add lights of power 0 before the lights of each kind.

    The last light of all stays the last, so that the largest random number chooses it.

    Returns:
        `Geometry.light` with the new indices of the lights, and the lights.
    """
    extra = [_more_lights(lights) for lights in emitters]
    made = [_lights(lights, more) for lights, more in zip(emitters, extra, strict=True)]
    lit, first, moved = light.copy(), 0, 0
    for lights, more in zip(emitters, extra, strict=True):
        moved += more
        lit[(light >= first) & (light < first + lights.count)] += moved
        first += lights.count
    if any(lights.places is not None for lights in emitters):
        _pad_light_tree(emitters, made, extra)
    return lit, tuple(made)


def _pad_light_tree(emitters: tuple[Lights, ...], made: list[Lights], extra: list[int]) -> None:
    """Put added lights into empty leaves, with the bounds of an empty leaf, so that no node of the tree changes."""
    placed = [place for place, lights in enumerate(emitters) if lights.places is not None]
    places = np.concatenate([emitters[place].places for place in placed])
    leaf = np.concatenate([emitters[place].leaf for place in placed])
    room = light_tree.leaves(sum(made[place].count for place in placed))
    light = np.full(room, -1)
    light[leaf] = np.arange(len(leaf))
    followed = light[np.maximum.accumulate(np.where(light >= 0, np.arange(room), 0))]
    empty = iter(np.flatnonzero(light < 0))
    for place in placed:
        own = np.asarray([next(empty) for _ in range(extra[place])], np.int32)
        made[place] = replace(
            made[place],
            places=np.concatenate([places[followed[own]], emitters[place].places]),
            leaf=np.concatenate([own, emitters[place].leaf]),
        )


def _more_lights(lights: Lights) -> int:
    """Return the number of lights to add, which makes the count a power of two.

    So the tree that chooses among them has as many levels as without padding, and without a tree, where choosing takes
    time for each light, few are added. A single light stays alone: nothing is chosen there.
    """
    dark = lights.lamps is not None or any(isinstance(x, Color) and x.radiance for x in lights.kind.declared.values())
    if lights.count == 1 or not dark or _all_around(lights):
        return 0
    return light_tree.leaves(lights.count) - lights.count


def _all_around(lights: Lights) -> bool:
    """Return whether these are backgrounds, which every ray that leaves the scene evaluates."""
    return lights.kind.distant and not lights.kind.dirac


def _lights(lights: Lights, more: int) -> Lights:
    def before(values):
        values = np.asarray(values)
        return np.concatenate([np.zeros((more, *values.shape[1:]), values.dtype), values])

    if _all_around(lights):
        return lights
    if lights.textures is not None:
        lights = replace(lights, textures=replace(lights.textures, tables=tuple(map(_kind, lights.textures.tables))))
    if lights.lamps is not None:  # of area 0
        lamps = jax.tree.map(before, lights.lamps)
        return replace(lights, table=_kind(lights.table), lamps=lamps, row=before(lights.row))

    def of(declared, column):
        if column is None or declared.shared:
            return column
        values = before(column.values)
        if not (isinstance(declared, Color) and declared.radiance):
            values[:more] = values[more]
        texture = None if column.texture is None else before(column.texture)
        return replace(column, values=values, texture=texture)

    columns = tuple(map(of, lights.kind.declared.values(), lights.table.columns))
    return replace(lights, table=replace(lights.table, columns=columns))


def _shapes(table: ShapeTable) -> ShapeTable:
    """Pad the primitives of one kind. Without a tree they are not padded, as rays would test the padded leaves, too."""
    if table.tree is None:
        return table
    by_row, tree = table.by_row(), table.tree
    rows = _many(table.count, sum(map(_row_bytes, jax.tree.leaves(by_row))))
    tree = replace(tree, nodes=_many_rows(tree.nodes), depth=-(-tree.depth // LEVELS) * LEVELS)
    by_row = jax.tree.map(lambda x: _rows(x, rows), by_row)
    return replace(table, leaves=_many_rows(table.leaves), tree=tree, **by_row)


def _kind(table: Table) -> Table:
    """Pad the rows of one kind of bsdf or texture, and the texels that they share."""

    def of(declared, column):
        if column is None or (declared.shared and not declared.by_number):
            return column
        if declared.shared:
            return replace(column, values=_many_rows(column.values))
        rows = _few(len(column.values))
        texture = None if column.texture is None else _rows(column.texture, rows)
        return replace(column, values=_rows(column.values, rows), texture=texture)

    return replace(table, columns=tuple(map(of, table.kind.declared.values(), table.columns)))


def _grids(grids: Grids | None) -> Grids | None:
    """Pad the cells, which all grids share, and the arrays per grid and per medium."""
    if grids is None:
        return None
    few = {key: _rows(x, _few(len(x))) for key, x in vars(grids).items() if key != "values" and x is not None}
    return replace(grids, values=_many_rows(grids.values), **few)


def _rows(values: Shaped[np.ndarray, "R ..."], rows: int) -> Shaped[np.ndarray, "rows ..."]:
    """Pad with zeros at the end. Untouched pages take no physical memory unless JAX copies the array."""
    values = np.asarray(values)
    size = rows * _row_bytes(values)
    memory = np.zeros(size + _ALIGNED, np.uint8)
    first = -memory.ctypes.data % _ALIGNED
    whole = memory[first : first + size].view(values.dtype).reshape(rows, *values.shape[1:])
    whole[: len(values)] = values
    return whole


def _many_rows(values):
    return _rows(values, _many(len(values), _row_bytes(values)))


def _row_bytes(values) -> int:
    return int(np.prod(values.shape[1:], dtype=int)) * values.dtype.itemsize


def _many(rows: int, row_bytes: int) -> int:
    return _rung(rows, 1 << (MANY_BYTES // row_bytes).bit_length())


def _few(rows: int) -> int:
    """Return the padded number of rows of a short table: a power of two up to SELECTED_ROWS, then a rung.

    Lanes select from up to SELECTED_ROWS rows, which takes time for each row: a scene of glass and mirrors took 3 %
    longer with tables of 8 rows instead of 2 and 4, and 9 % longer with 8 lights. A table of one row stays so, as XLA
    omits its look-up. No table from which lanes select becomes one from which they gather, which takes longer.
    """
    return 1 << (rows - 1).bit_length() if rows <= SELECTED_ROWS else _rung(rows, FEW_ROWS)


def _rung(rows: int, lowest: int) -> int:
    while lowest < rows:
        lowest *= STEP
    return lowest
