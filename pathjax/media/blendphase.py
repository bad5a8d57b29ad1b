"""Mixtures of two phase functions."""

from __future__ import annotations

from pathjax.kinds import Instance, Number, PerRow
from pathjax.media.phase import Phase


class BlendPhase(Phase):
    """The first nested phase function at weight 0, the second at weight 1, in between their mixture.

    The values of an `Instance` have both under "held". One of them scatters: see `media.sample`.
    """

    weight = Number(bounds=(0, 1), required=True)
    codes = PerRow()  # (2, 2) int32: kind and row of each

    @classmethod
    def read(cls, loader, fields, name):
        elements = fields.objects("phase", limit=2)
        if len(elements) < 2:
            raise fields.element.error(f"{fields.element} needs two <phase>s inside, and has {len(elements)}")
        made = super().read(loader, fields, name)
        held = tuple(loader.shared(each, loader.unique(f"{name}_{place}")) for place, each in enumerate(elements))
        for each, element in zip(held, elements, strict=True):
            if issubclass(each.kind, cls):
                raise element.error(f"{element} cannot stand inside another one; blend two that are no blends")
        return Instance(cls, name, {**made.values, "held": held})

    @staticmethod
    def evaluate(p, wo):
        raise NotImplementedError("the phase functions that a blend holds scatter")

    sample = evaluate
