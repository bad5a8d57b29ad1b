"""Shapes: one file per kind, a bounding volume hierarchy over any of them, and `geometry`, which other rooms use.

A kind is a subclass of `shape.Shape`, the record of a shape in a scene file. It names the `shape.Table` that stores its
primitives. Kinds may share a table, as cubes and rectangles do. One row in `KINDS` registers a kind for scene files,
builders and kernels.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pathjax.kinds import Fixed, Parameter, Parameters
from pathjax.shapes import coincident
from pathjax.shapes.accel.build import Tree
from pathjax.shapes.cube import Cube
from pathjax.shapes.cylinder import Cylinder
from pathjax.shapes.disk import Disk
from pathjax.shapes.ellipsoid import Ellipsoid
from pathjax.shapes.geometry import Geometry
from pathjax.shapes.rectangle import Rectangle
from pathjax.shapes.shape import Lamps, Primitives, Shape, Table
from pathjax.shapes.sphere import Sphere
from pathjax.shapes.triangle import FORMATS, ArrayMesh, Mesh, SerializedMesh
from pathjax.textures import mesh_attribute

__all__ = [
    "KINDS",
    "Cube",
    "Cylinder",
    "Disk",
    "Geometry",
    "Lamp",
    "Lamps",
    "Mesh",
    "Rectangle",
    "Shape",
    "Sphere",
    "Table",
    "build",
    "lamp_table",
]

# Kinds by their names in scene files. The name of a mesh is the format of its file.
KINDS: dict[str, type[Shape]] = {
    "sphere": Sphere,
    "rectangle": Rectangle,
    "disk": Disk,
    "cube": Cube,
    **dict.fromkeys(FORMATS, Mesh),
    "serialized": SerializedMesh,
    "mesh": ArrayMesh,
    "cylinder": Cylinder,
}
# Kinds of tables, in the order in which scenes hold them. No file names an ellipsoid: only instances create them.
TABLES = tuple(dict.fromkeys(kind.table for kind in (*KINDS.values(), Ellipsoid)))


class Lamp(NamedTuple):
    """Primitives of one shape that emit as one light."""

    shape: int  # index among the shapes
    table: int  # index among the tables of the geometry
    first: int  # first row in that table
    count: int
    area: float
    primitive: int  # index of the first primitive, over all tables of the geometry
    place: np.ndarray  # (3, 3) lower and upper corner of its bounding box, and mean of the normals


class _Part(NamedTuple):
    shape: int
    primitives: Primitives
    glass: bool  # an interface between two media
    lamp: bool


def build(
    shapes,
    dtype,
    rule: str,
    path: tuple = (),
    parameters: Parameters | None = None,
    tangents: bool = False,
    along: bool = False,
) -> tuple[Geometry, list[Lamp], dict[str, Tree]]:
    """Return the geometry, without the indices of its lights; its lamps; and hierarchies by `kind`, for reports.

    Args:
        shapes: records `description.Shape`; rule: of `accel.build`.
        path: path of the geometry in the scene; parameters: receives the mesh attributes that bsdfs read.
        tangents, along: whether a bsdf reads these fields of `Surface`.
    """
    by_table: dict[type[Table], list[_Part]] = {table: [] for table in TABLES}
    asked = {t.values["names"] for shape in shapes for _, _, t in mesh_attribute.asked(shape.bsdf)}
    numbers = sorted(range(len(shapes)), key=lambda number: shapes[number].geometry.comes_last)
    for number in numbers:
        shape = shapes[number]
        geometry = shape.geometry
        if geometry.attributes:
            kept = {name: values for name, values in geometry.attributes.items() if name in asked}
            geometry = replace(geometry, attributes=kept)
        primitives = geometry.primitives(shape.flip_normals)
        glass = any(leaf.kind.sided for leaf in shape.bsdf.kind.leaves(shape.bsdf))
        part = _Part(number, primitives, glass, shape.emitter is not None)
        by_table[shape.geometry.table].append(part)
    by_table = {table: parts for table, parts in by_table.items() if parts}

    margins = _part_coincident(by_table, dtype)
    tables, trees, lamps, shape_of = [], {}, [], []
    for table, parts in by_table.items():
        lamps += _lamps(parts, len(tables), sum(map(len, shape_of)))
        counts = [part.primitives.count for part in parts]
        shape_of.append(np.repeat([part.shape for part in parts], counts))
        if parameters is not None:
            first = 0
            for part, count in zip(parts, counts, strict=True):
                where = *path, "tables", len(tables), "attributes"
                _enter_attributes(parameters, where, shapes[part.shape], part.primitives, first)
                first += count
        primitives, lit = [part.primitives for part in parts], [part.lamp for part in parts]
        made, built = table.build(primitives, lit, dtype, rule, margins.get(table))
        tables.append(made)
        trees |= built
    lamps.sort(key=lambda lamp: (shapes[lamp.shape].geometry.comes_last, lamp.shape))
    shape = np.concatenate([np.zeros(0, int), *shape_of]).astype(np.int32)
    geometry = Geometry(tuple(tables), shape, None, tangents, along)
    return geometry, lamps, {kind: tree for kind, tree in trees.items() if tree is not None}


def _enter_attributes(parameters: Parameters, path: tuple, shape, primitives: Primitives, first: int) -> None:
    """Enter the attributes that the bsdf of a shape reads. first: row of the shape's first primitive."""
    for key, declared, texture in mesh_attribute.asked(shape.bsdf):
        attribute, scale = texture.values["names"], texture.values["scale"]
        name, values = f"{shape.name}.{attribute}", shape.geometry.attributes[attribute]
        if not declared.listed:
            parameters.refused[name] = f"{name} stands in {key} of its bsdf, which is no parameter"
        if "." in shape.name:  # loaders name shapes of instances so
            parameters.refused[name] = f"{name} is of a mesh that an instance shows, as others may"
        if name in parameters.refused:
            parameters.known.pop(name, None)
            continue
        low, high = (bound / scale if scale else math.inf * np.sign(bound) for bound in declared.bounds)
        known = parameters.known.get(name)
        bounds = (low, high) if known is None else (max(low, known.bounds[0]), min(high, known.bounds[1]))
        corners = primitives.entries[attribute]
        where = (*path, attribute), (first,)
        parameters.known[name] = Parameter(*where, values.shape, bounds, rows=len(corners), corners=Fixed(corners))


def lamp_table(lamps: list[Lamp], dtype) -> Lamps:
    """Return the lamps as arrays for kernels."""
    _, table, first, count, area, *_ = zip(*lamps, strict=True)
    tables = tuple(sorted(set(table)))
    integers = (np.asarray(x, np.int32) for x in ([tables.index(each) for each in table], first, count))
    return Lamps(*integers, np.asarray(area, dtype), tables)


def _lamps(parts: list[_Part], table, primitive):
    """Yield the lamps of one table, whose first primitive has the index `primitive`."""
    first = 0
    for shape, primitives, _, lamp in parts:
        if lamp:
            areas = primitives.areas
            (lo, hi), facing = primitives.boxes(), primitives.facing()
            if primitives.one_lamp:
                place = np.stack([lo.min(0), hi.max(0), facing.sum(0) / areas.sum()])
                yield Lamp(shape, table, first, len(areas), areas.sum(), primitive + first, place)
            else:
                each = enumerate(zip(areas, np.stack([lo, hi, facing / areas[:, None]], 1), strict=True), first)
                yield from (Lamp(shape, table, row, 1, area, primitive + row, place) for row, (area, place) in each)
        first += primitives.count


def _part_coincident(by_table: dict[type[Table], list[_Part]], dtype):
    """Move coincident faces apart, in place, and return margins (P,) by table, for tables with nonzero ones."""
    margins: dict[type[Table], list] = {table: [] for table in by_table}
    flat = []
    for table, parts in by_table.items():
        faces = [part.primitives.faces(part.glass, part.lamp, dtype) for part in parts]
        if None in faces:
            margins[table].append(table.own_margins([part.primitives for part in parts], dtype))
        else:
            flat += [(table, part.primitives, each) for part, each in zip(parts, faces, strict=True)]
    contacts = coincident.contacts([faces for *_, faces in flat], dtype)
    for (table, primitives, _), moves, found in zip(flat, *contacts, strict=True):
        primitives.move(moves)
        margins[table].append(np.broadcast_to(found, primitives.count))
    joined = {table: np.concatenate(each) for table, each in margins.items()}
    return {table: np.asarray(each, dtype) for table, each in joined.items() if each.any()}
