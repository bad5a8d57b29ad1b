"""Base of bump maps and normal maps, whose fields are not parameters of the scene."""

from __future__ import annotations

from dataclasses import dataclass

from pathjax.bsdfs.wrapper import Turning
from pathjax.kinds import Flag, Instance, Number

REFUSED = "turns shading frames, and derivatives do not follow these; change it in the scene file"


@dataclass(frozen=True)
class Heights(Number):
    """The only texture in an element, whatever its name."""

    textured: bool = True
    listed: bool = False

    def read(self, loader, fields, name, owner):
        element = fields.only_texture()
        made = loader.shared(element, owner)
        if not made.kind.follows_uv(made):
            raise element.error(f"{element} has no slope along u and v, by which heights turn normals; use a bitmap")
        return made


class Mapped(Turning):
    flip_invalid_normals = Flag(True)
    use_shadowing_function = Flag(True)

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        table = super().build(instances, dtype, path, parameters, code)
        for instance in instances:
            names = [f"{instance.name}.{key}" for key in cls.declared]
            for texture in instance.values.values():
                if isinstance(texture, Instance):
                    names += [f"{texture.name}.{key}" for key in texture.kind.declared]
            for name in names:
                parameters.known.pop(name, None)
                parameters.refused[name] = f"{name} {REFUSED}"
        return table
