"""A reflector for each side of a surface; the same one twice where the file names one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pathjax.bsdfs.bsdf import BSDF
from pathjax.kinds import Instance, Unused


class TwoSided(BSDF):
    """Mitsuba's `twosided`: no bsdf of its own, but where others go."""

    # What lets light pass cannot stand inside here.
    unused: ClassVar[Mapping[str, Unused]] = {"allow_transmission": Unused("boolean")}

    @classmethod
    def read(cls, loader, fields, name):
        nested = fields.objects("bsdf", limit=2)
        if not nested:
            raise fields.element.error(f"{fields.element} needs a <bsdf> inside")
        names = [name] if len(nested) == 1 else [loader.unique(f"{name}_{side}") for side in ("front", "back")]
        made = [loader.bsdf(element, side) for element, side in zip(nested, names, strict=True)]
        for element, side in zip(nested, made, strict=True):
            if side.kind.sided or side.kind is cls:
                raise element.error(f"{element} cannot stand inside {fields.element}; it has two sides of its own")
        return cls.of(name, made[0], made[-1])

    @classmethod
    def of(cls, name: str, front: Instance, back: Instance) -> Instance:
        return Instance(cls, name, {"front": front, "back": back})

    @classmethod
    def sides(cls, instance):
        return instance.values["front"], instance.values["back"]
