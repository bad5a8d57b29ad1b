"""Mixtures of two bsdfs."""

from __future__ import annotations

from pathjax.bsdfs.wrapper import Choosing
from pathjax.kinds import Number, Row


class BlendBSDF(Choosing):
    """The first nested bsdf at weight 0, the second at weight 1, in between their mixture."""

    nested = 2
    weight = Number(bounds=(0, 1), textured=True, required=True)

    @staticmethod
    def share(p: Row, cos):
        return p.weight
