"""One bsdf for each side of a surface, or the same one for both."""

from __future__ import annotations

from pathjax.bsdfs.bsdf import BSDF
from pathjax.kinds import Instance


class TwoSided(BSDF):
    """Mitsuba's `twosided`, which puts other bsdfs on the two sides. Each sees light as on a front."""

    turns_back = True

    @classmethod
    def read(cls, loader, fields, name):
        nested = fields.objects("bsdf", limit=2)
        if not nested:
            raise fields.element.error(f"{fields.element} needs a <bsdf> inside")
        names = [name] if len(nested) == 1 else [loader.unique(f"{name}_{side}") for side in ("front", "back")]
        made = [loader.bsdf(element, side) for element, side in zip(nested, names, strict=True)]
        through = fields.boolean("allow_transmission", False)
        for element, side in zip(nested, made, strict=True):
            leaves = [leaf.kind for leaf in side.kind.leaves(side)]
            if any(leaf.sided for leaf in leaves):
                raise element.error(f"{element} cannot stand inside {fields.element}; it has two sides of its own")
            if any(leaf.passes for leaf in leaves) and not through:
                allow = '<boolean name="allow_transmission" value="true"/>'
                raise element.error(f"{element} lets light through; {fields.element} takes it with {allow}")
        return cls.of(name, made[0], made[-1])

    @classmethod
    def of(cls, name: str, front: Instance, back: Instance) -> Instance:
        return Instance(cls, name, {"front": front, "back": back})

    @classmethod
    def sides(cls, instance):
        front, back = instance.values["front"], instance.values["back"]
        return front.kind.sides(front)[0], back.kind.sides(back)[0]

    @classmethod
    def leaves(cls, instance):
        return tuple(leaf for each in instance.values.values() for leaf in each.kind.leaves(each))
