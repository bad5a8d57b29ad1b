"""Instances: shapes of a group in several places. Each instance copies them, to separate rows of the tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from pathjax import description as d
from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.shapes import Shape

# More would not fit into the memory of usual machines, or indices not into 32 bits.
MOST_TRIANGLES = 1 << 28
MOST_SHAPES = 1 << 20  # inside one element
# Per triangle: vertices, normals, uv, and its share of the hierarchy.
BYTES = 200


class ShapeGroup:
    """The shapes that its instances copy; the group itself is not in the scene."""

    unused: ClassVar[Mapping[str, Unused]] = Shape.unused | {
        "to_world": Unused("transform", "its shapes and its instances are placed each by their own")
    }

    @classmethod
    def read(cls, loader, fields: Fields) -> list[d.Shape]:
        """Read its shapes, in the space of the group."""
        made = []
        for element in fields.objects("shape", limit=MOST_SHAPES):
            if element.attributes.get("type") in ("shapegroup", "instance"):
                raise element.error(f"{element} cannot stand inside {fields.element}; groups hold shapes alone")
            shapes = loader.shapes(element)
            if any(shape.emitter is not None for shape in shapes):
                raise element.error(f"{element} emits light, which instances cannot; put it outside of the group")
            if any(on is element for on, _ in loader.on_surfaces.values()):
                raise element.error(f"{element} holds a sensor, which instances cannot; put it outside of the group")
            made += shapes
        return made


class Merge:
    """Shapes that Mitsuba merges into one if they have the same bsdf, which does not change the image."""

    unused = Shape.unused

    @classmethod
    def read(cls, loader, fields: Fields) -> list[d.Shape]:
        loader.note(fields.element, "is left out, and the shapes inside are used")
        return [shape for element in fields.objects("shape", limit=MOST_SHAPES) for shape in loader.shapes(element)]


class Instance:
    unused = Shape.unused

    @classmethod
    def read(cls, loader, fields: Fields, name: str) -> list[d.Shape]:
        to_world, groups = fields.transform("to_world"), fields.objects("shape")
        if not groups or groups[0].attributes.get("type") != "shapegroup":
            raise fields.element.error(f'{fields.element} needs a <ref> to a <shape type="shapegroup">')
        shapes = [_placed(fields, shape, to_world, name) for shape in loader.group(groups[0])]
        loader.copy(fields.element, sum(len(each.geometry.faces) for each in shapes if each.geometry.triangles))
        return shapes


def _placed(fields: Fields, shape: d.Shape, to_world: np.ndarray, name: str) -> d.Shape:
    placed = shape.geometry.placed(to_world)
    if placed is None:
        raise fields.error("to_world", f'makes "{shape.name}" flat, or too large or small')
    return replace(shape, name=f"{name}.{shape.name}", geometry=placed)


# Kinds by their names in scene files.
KINDS = {"shapegroup": ShapeGroup, "instance": Instance, "merge": Merge}
