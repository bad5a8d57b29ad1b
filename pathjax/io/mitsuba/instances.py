"""Instances: shapes of a group that stand in several places, each a copy with a row of its own in the tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from pathjax import description as d
from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.shapes import Shape

# Above, the tables of a scene would not fit into the memory of usual machines, or its numbers into 32 bits.
MOST_TRIANGLES = 1 << 28
MOST_SHAPES = 1 << 20  # inside one element
# Vertices, normals, uv, and what searches keep of a triangle.
BYTES = 200


class ShapeGroup:
    """What its instances show. It is not seen itself."""

    unused: ClassVar[Mapping[str, Unused]] = Shape.unused | {
        "to_world": Unused("transform", "its shapes and its instances are placed each by their own")
    }

    @classmethod
    def read(cls, loader, fields: Fields) -> list[d.Shape]:
        """Its shapes, in its own space."""
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
    """Shapes that Mitsuba searches as one, where they have the same bsdf; the image is the same."""

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


# By the name that scene files give them.
KINDS = {"shapegroup": ShapeGroup, "instance": Instance, "merge": Merge}
