"""Media whose extinction and albedo are the same everywhere, or are grids."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pathjax.kinds import Color, Instance, Kind, Number, Unused
from pathjax.media.gridvolume import GridVolume, boxed
from pathjax.media.isotropic import Isotropic

EVEN = Isotropic.instance("isotropic")


class ConstVolume:
    """Mitsuba's volume of one value, read as the value."""

    unused: ClassVar[Mapping[str, Unused]] = {"to_world": Unused("transform", "it is the same everywhere")}

    @classmethod
    def read(cls, loader, fields, high: float) -> np.ndarray:
        return fields.color("value", at_most=high)


# Kinds by their names in scene files.
VOLUMES = {"constvolume": ConstVolume, "gridvolume": GridVolume}


@dataclass(frozen=True)
class VolumeColor(Color):
    """A colour; files may give a volume instead."""

    textured: bool = False
    kinds: Mapping[str, type] = field(default_factory=lambda: VOLUMES)

    def read(self, loader, fields, name, owner):
        element = fields.texture(name, "volume")
        if element is not None:
            return loader.make(element, self.kinds, self.bounds[1])
        return super().read(loader, fields, name, owner)


class BoxedVolume:
    """A constant volume as a grid: the unit cube, which `to_world` places."""

    unused: ClassVar[Mapping[str, Unused]] = {}

    @classmethod
    def read(cls, loader, fields, high: float) -> GridVolume:
        return boxed(ConstVolume.read(loader, fields, high), fields.transform("to_world"))


@dataclass(frozen=True)
class BoxedColor(VolumeColor):
    """A volume bounded by its box; a colour fills the unit cube, as in Mitsuba."""

    kinds: Mapping[str, type] = field(default_factory=lambda: VOLUMES | {"constvolume": BoxedVolume})

    def read(self, loader, fields, name, owner):
        made = super().read(loader, fields, name, owner)
        return made if isinstance(made, GridVolume) else boxed(made, np.eye(4))


class Homogeneous(Kind):
    """A medium with the same extinction in all places and directions. Its `albedo` may be a grid.

    sigma_t times `scale` is the extinction, which a ray loses of its light per unit of length. The share `albedo` of it
    is scattered, the rest absorbed. The medium emits nothing. Distances are drawn by the extinction, detached. All its
    colours are parameters, whose derivatives the weights carry.

    The values of an `Instance` have the phase function under "phase".
    """

    sigma_t = VolumeColor(1.0, bounds=(0, math.inf), kinds={"constvolume": ConstVolume})
    albedo = VolumeColor(0.75)
    scale = Number(1.0, bounds=(0, math.inf))
    unused: ClassVar[Mapping[str, Unused]] = {
        "sample_emitters": Unused("boolean", "lights are always sampled, which changes noise alone")
    }

    @classmethod
    def read(cls, loader, fields, name):
        made, phases = super().read(loader, fields, name), fields.objects("phase")
        extinction = made.values["sigma_t"]
        grey = np.ptp(extinction.data if isinstance(extinction, GridVolume) else extinction, -1).max() == 0
        if not fields.boolean("has_spectral_extinction", True) and not grey:
            raise fields.error("has_spectral_extinction", "is false, but sigma_t has a colour; leave it out")
        for key in ("sigma_t", "albedo"):
            if isinstance(value := made.values[key], GridVolume) and value.repeats:
                if not isinstance(extinction, GridVolume):
                    raise fields.error(key, "repeats without end; only that of a heterogeneous medium may, in its box")
                made = replace(made, values={**made.values, key: value.repeated(extinction.box)})
        return cls.scattering(made, loader.shared(phases[0], name) if phases else EVEN)

    @staticmethod
    def scattering(made: Instance, phase: Instance) -> Instance:
        """Return the medium with a phase function."""
        return Instance(made.kind, made.name, {**made.values, "phase": phase})


class Heterogeneous(Homogeneous):
    """A medium whose extinction is a volume, and 0 outside of the box of the volume."""

    sigma_t = BoxedColor(1.0, bounds=(0, math.inf))
