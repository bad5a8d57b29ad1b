"""Base of sheets that change polarisation. Light has none here, so a share of it just goes straight on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.null import NOTHING
from pathjax.bsdfs.wrapper import Choosing
from pathjax.kinds import Number, Row

# Why fields about polarisation have no effect.
UNPOLARISED = "light has no polarisation here"


class Opaque(BSDF):
    """A surface that absorbs all light."""

    @classmethod
    def sides(cls, instance):
        return None, None


@dataclass(frozen=True)
class Transmittance(Number):
    """A number in [0, 1], or a grey colour."""

    bounds: tuple[float, float] = (0, 1)

    def read(self, loader, fields, name, owner):
        if not fields.gives_color(name):
            return super().read(loader, fields, name, owner)
        color = fields.color(name, at_most=1)
        if np.ptp(color):
            raise fields.error(name, "has a colour; only a number, or a grey, is modelled here")
        return float(color[0])


class Sheet(Choosing):
    """Passes the share `passes_of * transmittance` of light straight on, and absorbs the rest."""

    nested = 0
    passes_of: ClassVar[float]
    transmittance = Transmittance(1.0)

    @classmethod
    def holding(cls, name, *held, **values):
        return super().holding(name, Opaque.instance("opaque"), NOTHING, **values)

    @classmethod
    def share(cls, p: Row, cos):
        return cls.passes_of * p.transmittance
