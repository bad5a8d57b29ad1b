"""Patches: every primitive divided into cells of equal area, and a look-up of the cell of a point.

A side of a cell is a patch if it reflects or emits; other sides are black, as in the renderer. Rectangles are divided
into parallelograms, disks by radius squared and angle, spheres by angle and height, triangles into similar ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import bsdfs, emitters
from pathjax.compile import register_dataclass
from pathjax.core.math import at
from pathjax.core.warp import square_to_triangle
from pathjax.errors import InputError
from pathjax.scene.scene import Scene
from pathjax.shapes import Geometry, geometry


@register_dataclass
@dataclass(frozen=True)
class Patches:
    """U patches: the non-black sides of C cells of Q primitives."""

    first: jax.Array  # (Q,) int32 first cell of each primitive
    grid: jax.Array  # (Q, 2) int32 cells along its two coordinates; for a triangle cells along an edge, twice
    primitive: jax.Array  # (C,) int32
    place: jax.Array  # (C, 2) int32 position in the grid; for a triangle strip, and position in the strip
    patch: jax.Array  # (2, C) int32 patch of the front and of the back of each cell; U: black
    cell: jax.Array  # (U,) int32
    back: jax.Array  # (U,) bool: the patch lies on the side that the normal points away from
    area: jax.Array  # (U,)
    row: jax.Array  # (U,) int32 row of the diffuse reflectances; -1: reflects nothing
    emitter: jax.Array  # (U,) int32 row of the radiances of area lights; -1: emits nothing

    @property
    def count(self) -> int:
        return self.cell.shape[0]


def cut_scene(scene: Scene, count: int, faceted: bool = False) -> Patches:
    """Divide a scene into about `count` cells of about equal area, at least one for each primitive.

    Raises:
        InputError: there is nothing to divide, or a shape, which is named, has a part of area 0 or is not diffuse.
    """
    if not isinstance(count, int) or count < 1:
        raise InputError(f"patches = {count!r}; it is the number of patches, an integer of at least 1")
    shapes = scene.geometry
    if not shapes.tables:
        raise InputError("a scene without shapes has no patches")
    refuse_media(scene)
    rows = _diffuse_rows(scene, faceted)
    shape, light = np.asarray(shapes.shape), np.asarray(shapes.light)

    even = np.concatenate([table.even() for table in shapes.tables])
    if not even.all():
        raise InputError(
            f"{_name(scene, shape[np.argmin(even)])} is round and scaled unevenly, which is not cut into patches of "
            "equal area. Give it a mesh, or use pathjax.render"
        )
    area = np.concatenate([table.areas() for table in shapes.tables])
    if not (area > 0).all():
        worst = _name(scene, shape[np.argmin(area > 0)])
        raise InputError(f"{worst} has a part of area 0, which neither sends nor receives light; remove it")
    size = math.sqrt(area.sum() / count)
    grid = np.concatenate([_grid(table, size) for table in shapes.tables])
    triangular = np.concatenate([np.full(t.count, t.triangular) for t in shapes.tables])
    cells = np.prod(grid, axis=1)
    first = np.cumsum([0, *cells])[:-1]
    primitive = np.repeat(np.arange(len(cells)), cells)
    local = np.arange(cells.sum()) - first[primitive]
    place = np.stack([local // grid[primitive, 1], local % grid[primitive, 1]], -1)
    # Strip a of a triangle with k cells per edge holds 2 (k - a) - 1 cells; the strips before it hold a (2 k - a).
    k = grid[primitive, 0]
    strip = k - np.ceil(np.sqrt(np.maximum(k * k - local, 0))).astype(int)
    place = np.where(triangular[primitive, None], np.stack([strip, local - strip * (2 * k - strip)], -1), place)

    row = rows[shape[primitive]].T  # (2, C)
    emitter = np.full_like(row, -1)
    if lights := emitters.even_lights(scene.emitters):
        emitter[0] = np.where(light >= 0, np.asarray(lights.row)[light], -1)[primitive]
    back, cell = np.nonzero((row >= 0) | (emitter >= 0))
    if not len(cell):
        raise InputError("everything in this scene is black: there is no light to transport")
    patch = np.full(row.shape, len(cell))
    patch[back, cell] = np.arange(len(cell))
    dtype = scene.camera.origin.dtype
    integers = (np.asarray(x, np.int32) for x in (first, grid, primitive, place, patch, cell))
    rest = (area / cells)[primitive][cell].astype(dtype), row[back, cell], emitter[back, cell]
    return jax.device_put(Patches(*integers, back.astype(bool), rest[0], *(x.astype(np.int32) for x in rest[1:])))


def refuse_media(scene: Scene) -> None:
    """Refuse, with an InputError, a scene with media, which attenuate light between patches."""
    if scene.media is not None:
        raise InputError(
            "the scene has participating media, and light between patches goes through nothing. Use pathjax.render, or "
            'load it with <integrator type="path">, which takes no notice of media'
        )


def _name(scene, shape) -> str:
    if scene.about is None:
        return f"shape number {shape}"
    return f"shape {scene.about.description.shapes[shape].name!r}"


def _diffuse_rows(scene: Scene, faceted) -> np.ndarray:
    """Return rows (S, 2) of the reflectances of the front and the back of each shape; -1: reflects nothing."""
    materials = scene.materials
    diffuse, column = bsdfs.reflectances(materials) or (None, None)
    sides = np.asarray(materials.sides)
    rows = np.full(sides.shape[:2], -1)
    for shape, side in np.ndindex(rows.shape):
        kind, row = sides[shape, side]
        if kind < 0:
            continue
        if kind != diffuse:
            raise InputError(
                f"{_name(scene, shape)} is a {bsdfs.name(materials, kind)}; patches send the same radiance in all "
                "directions, so all must be diffuse. Use pathjax.render"
            )
        if column.texture is not None and column.texture[row, 0] >= 0:
            raise InputError(
                f"{_name(scene, shape)} has a texture; a patch has one reflectance. Give it a constant one"
            )
        rows[shape, side] = row
    if not faceted and scene.about is not None:
        for number, shape in enumerate(scene.about.description.shapes):
            if shape.geometry.smooth:
                raise InputError(
                    f"{_name(scene, number)} has smooth normals, and patches are flat; load it with face_normals, or "
                    "pass faceted=True to take its triangles as they are"
                )
    return rows


def _grid(table, size) -> np.ndarray:
    """Return the numbers of cells (P, 2) along the coordinates of each primitive, for sides of about `size`."""
    return np.maximum(np.rint(table.cell_lengths(size) / size), 1).astype(int)


# ---- look-ups for one point -----------------------------------------------------------------------------------------


def patch_at(patches: Patches, shapes: Geometry, primitive, p, back):
    """Return the patch of a surface point.

    Args:
        primitive: () int32, of a hit.
        p: (3,) the point.
        back: () bool, true for the side that the normal points away from.
    Returns:
        () int32; `patches.count` if that side is black.
    """
    grid = at(patches.grid, primitive)

    def place(table, row):
        xy = table.to_square(row, p)
        if table.triangular:
            k = grid[0]
            a = jnp.clip(jnp.floor(xy[0] * k).astype(jnp.int32), 0, k - 1)
            b = jnp.clip(jnp.floor(xy[1] * k).astype(jnp.int32), 0, k - 1 - a)
            upper = (xy[0] + xy[1]) * k >= a + b + 1
            return a * (2 * k - a) + jnp.minimum(2 * b + upper, 2 * (k - a - 1))
        a, b = (jnp.clip(jnp.floor(xy[i] * grid[i]).astype(jnp.int32), 0, grid[i] - 1) for i in (0, 1))
        return a * grid[1] + b

    cell = at(patches.first, primitive) + _of_table(shapes, primitive, place)
    return at(patches.patch, back.astype(jnp.int32), cell)


def point(patches: Patches, shapes: Geometry, patch, u):
    """Sample a uniform point of a patch.

    Args:
        patch: () int32.
        u: (2,) uniform.
    Returns:
        primitive () int32, point (3,), unit normal (3,) on the patch's side, rounding error of the point along it ().
    """
    cell = at(patches.cell, patch)
    primitive, place = at(patches.primitive, cell), at(patches.place, cell)
    grid = at(patches.grid, primitive)

    def place_of(table, row):
        if not table.triangular:
            return table.from_square(row, (place + u) / grid)
        # Every other cell of a strip is turned around.
        corner = jnp.stack([place[0], place[1] // 2])
        b, turned = square_to_triangle(u), place[1] % 2 == 1
        return table.from_square(row, (corner + jnp.where(turned, 1 - b, b)) / grid)

    p, n, margin = _of_table(shapes, primitive, place_of)
    return primitive, p, jnp.where(at(patches.back, patch), -n, n), margin


def _of_table(shapes, primitive, f):
    """Return f(table, row) for the table that holds the primitive."""
    first = geometry.firsts(shapes)

    def of(table, start):
        return lambda: f(table, jnp.maximum(primitive - start, 0))

    return geometry.switch_by_range(primitive, first, [of(*pair) for pair in zip(shapes.tables, first, strict=True)])
