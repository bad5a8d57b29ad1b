"""Attributes of the vertices or faces of a mesh, such as colours."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.core.math import at
from pathjax.core.types import Surface
from pathjax.kinds import Declared, Instance, Number, PerRow, Row, Setting
from pathjax.textures.texture import Texture


class MeshAttribute(Texture):
    """An attribute, by name, of the mesh that was hit: interpolated between vertices, or constant on a face.

    `Surface.attributes` has the values of all attributes that a scene uses.
    """

    names = Setting("")  # of the attributes of all rows, separated by blanks
    number = PerRow()  # () int32 index of its name
    scale = Number(1.0, bounds=(0, math.inf))
    over_uv = False

    @classmethod
    def read(cls, loader, fields, name):
        attribute = fields.string("name")
        if not attribute.startswith(("vertex_", "face_")) or len(attribute.split()) != 1:
            raise fields.error("name", f'must begin with "vertex_" or "face_", is "{attribute[:40]}"')
        return cls.instance(name, names=attribute, scale=fields.float("scale", 1.0, at_least=0))

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        table = super().build(instances, dtype, path, parameters, code)
        names = sorted({instance.values["names"] for instance in instances})
        numbers = np.array([names.index(instance.values["names"]) for instance in instances], np.int32)
        return table.with_column("number", numbers).with_setting("names", " ".join(names))

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        return _value(p, surface) * p.scale

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        names = p.names.split()
        found = [("scale", None, _value(p, surface))]
        for number, name in enumerate(names if surface.corners is not None else ()):
            first, shares = surface.corners
            scale = p.scale if len(names) == 1 else jnp.where(p.number == number, p.scale, 0)
            found += [(name, first + k, shares[k] * scale) for k in range(3)]
        return found

    @classmethod
    def attributes(cls, settings):
        return settings["names"].split()

    @classmethod
    def span(cls, texture: Instance) -> tuple[float, float]:
        """Return a placeholder: `fault` checks the meshes that it is used on."""
        return 0.0, 0.0


def _value(p: Row, surface: Surface) -> Float[Array, "3"]:
    values = [surface.attributes[name] for name in p.names.split()]
    return values[0] if len(values) == 1 else at(jnp.stack(values), p.number)


def asked(instance: Instance) -> Iterator[tuple[str, Declared, Instance]]:
    """Yield parameter, declaration and texture for each such texture in an instance."""
    for key, value in instance.values.items():
        for each in value if isinstance(value, tuple | list) else (value,):
            if isinstance(each, Instance) and each.kind is MeshAttribute:
                yield key, instance.kind.declared[key], each
            elif isinstance(each, Instance):
                yield from asked(each)


def fault(instance: Instance, attributes: Mapping[str, np.ndarray]) -> str:
    """Return why a shape with these attributes cannot have this bsdf, in words; empty: it can."""
    for key, declared, texture in asked(instance):
        name, scale = texture.values["names"], texture.values["scale"]
        if name not in attributes:
            known = ", ".join(attributes) or "none"
            return f'has no attribute "{name}", which "{key}" of its bsdf asks for; it has: {known}'
        low, high = attributes[name].min() * scale, attributes[name].max() * scale
        if not (declared.bounds[0] <= low <= high <= declared.bounds[1] and high < math.inf):  # also where one is NaN
            span = f"lie in [{declared.bounds[0]:g}, {declared.bounds[1]:g}]"
            return f'has an attribute "{name}" from {low:g} to {high:g}; as "{key}" of its bsdf it must {span}'
    return ""
