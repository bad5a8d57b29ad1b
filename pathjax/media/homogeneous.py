"""A medium that is the same everywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pathjax.kinds import Color, Instance, Kind, Number, Unused
from pathjax.media.isotropic import Isotropic

EVEN = Isotropic.instance("isotropic")


class ConstVolume:
    """What Mitsuba calls a volume of one value: the value."""

    unused: ClassVar[Mapping[str, Unused]] = {"to_world": Unused("transform", "it is the same everywhere")}

    @classmethod
    def read(cls, loader, fields, high: float) -> np.ndarray:
        return fields.color("value", at_most=high)


# By the name that scene files give them.
VOLUMES = {"constvolume": ConstVolume}


@dataclass(frozen=True)
class VolumeColor(Color):
    """A colour; in files a volume may stand in its place."""

    textured: bool = False

    def read(self, loader, fields, name, owner):
        element = fields.texture(name, "volume")
        if element is not None:
            return loader.make(element, VOLUMES, self.bounds[1])
        return super().read(loader, fields, name, owner)


class Homogeneous(Kind):
    """Absorbs and scatters alike in all places and directions.

    sigma_t times `scale` is the extinction: how much of the light each unit of length takes out of a ray. The share
    `albedo` of it is scattered, the rest absorbed. It emits nothing. Distances are drawn by the extinction, detached,
    and all its colours are parameters, of which weights carry the derivatives.

    An `Instance` holds the phase function under "phase".
    """

    sigma_t = VolumeColor(1.0, bounds=(0, math.inf))
    albedo = VolumeColor(0.75)
    scale = Number(1.0, bounds=(0, math.inf))
    unused: ClassVar[Mapping[str, Unused]] = {
        "sample_emitters": Unused("boolean", "lights are always sampled, which changes noise alone")
    }

    @classmethod
    def read(cls, loader, fields, name):
        made, phases = super().read(loader, fields, name), fields.objects("phase")
        grey = np.ptp(made.values["sigma_t"]) == 0
        if not fields.boolean("has_spectral_extinction", True) and not grey:
            raise fields.error("has_spectral_extinction", "is false, but sigma_t has a colour; leave it out")
        return cls.scattering(made, loader.shared(phases[0], name) if phases else EVEN)

    @staticmethod
    def scattering(made: Instance, phase: Instance) -> Instance:
        """The medium with a phase function."""
        return Instance(made.kind, made.name, {**made.values, "phase": phase})
