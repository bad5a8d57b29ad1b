"""Surfaces with cut-outs, or that let a share of the light through."""

from __future__ import annotations

from pathjax.bsdfs.null import NOTHING
from pathjax.bsdfs.wrapper import Choosing
from pathjax.kinds import Number, Row


class Mask(Choosing):
    """The nested bsdf with the probability `opacity`, else nothing."""

    opacity = Number(0.5, bounds=(0, 1), textured=True)

    @classmethod
    def holding(cls, name, *held, **values):
        return super().holding(name, NOTHING, *held, **values)

    @staticmethod
    def share(p: Row, cos):
        return p.opacity
