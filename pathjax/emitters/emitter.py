"""What an emitter is: three kinds of kinds, by where their light is met."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.kinds import Declared, Kind, Row


@dataclass(frozen=True)
class Weight(Declared):
    """How often lights are sampled, relative to their `power`. No parameter: it changes noise alone."""

    absent: object = 1.0

    def read(self, loader, fields, name, owner):
        return fields.float(name, None, at_least=self.bounds[0])


class Emitter(Kind):
    """A kind of light: `SurfaceEmitter`, `Background` or `DiracEmitter`.

    A class declares its parameters. Colours that are 0 where it is dark are declared with `radiance=True`. Directions
    are unit and in world space. Nothing may be NaN; where no light arrives it is 0. All is differentiated as it is
    written, so the derivative in a parameter that moves a light lacks the edges of shadows. The choice is detached.
    """

    sampling_weight = Weight(None, bounds=(0, math.inf))
    on_surfaces: ClassVar[bool] = False  # stands inside a shape
    distant: ClassVar[bool] = False  # infinitely far
    dirac: ClassVar[bool] = False  # shines from one direction at each point
    single: ClassVar[bool] = False  # a scene takes one of the kind

    @classmethod
    def tells_entries(cls) -> bool:
        """Whether `entries` of what it looks up in `Shared` arrays are known."""
        return False

    @staticmethod
    @abstractmethod
    def power(p) -> Float[Array, " R"]:
        """How bright lights are, by which one of them is chosen: relative to others that are distant or not.

        Of a surface its power for each area, of other lights their power, of distant ones the irradiance; each over pi.

        p: the parameters of all R rows, (R, *shape).
        """


class SurfaceEmitter(Emitter):
    """What stands inside a shape and shines from its front. Points on it are drawn by the shape."""

    on_surfaces = True
    even: ClassVar[bool] = False  # its parameter `radiance` is all that it emits, in all directions

    @staticmethod
    @abstractmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        """Radiance that leaves the front of the surface in the direction -d."""


class Background(Emitter):
    """Radiance from all directions in which nothing is hit. Several of them add up, and are sampled as one mixture."""

    distant = True
    left_to_bsdfs: ClassVar[bool] = False  # which find it with less noise: it is sampled by strategy "light" alone

    @staticmethod
    @abstractmethod
    def sample(p: Row, u: Float[Array, "2"], u_part: Float[Array, ""]) -> Float[Array, "3"]:
        """Draw a direction by its `density`. u, u_part: uniform in [0, 1)."""

    @staticmethod
    @abstractmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        """Radiance that comes from the direction d."""

    @staticmethod
    def entries(p: Row, d: Float[Array, "3"]) -> list[tuple[str, Int[Array, ""], Float[Array, ""]]]:
        """Return the colours of `Shared` arrays whose sum `emitted` is, for derivatives: parameter, entry, share.

        `emitted` adds `p.nudge(parameter)` to the sum.
        """
        return []

    @classmethod
    def tells_entries(cls):
        return cls.entries is not Background.entries

    @staticmethod
    @abstractmethod
    def density(p: Row, d: Float[Array, "3"]) -> Float[Array, ""]:
        """1/sr, with which `sample` draws d."""

    @classmethod
    def met(cls, p: Row, d: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """`emitted` and `density`, for kinds whose two have something in common."""
        return cls.emitted(p, d), cls.density(p, d)


class DiracEmitter(Emitter):
    """What shines from one direction at each point: no ray hits it, and no bsdf finds it."""

    dirac = True
    # With the weight 0 nothing would find it.
    sampling_weight = Weight(None, bounds=(float(np.finfo(np.float32).tiny), math.inf))

    @staticmethod
    @abstractmethod
    def sample(p: Row, ref: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        """What arrives at the point ref.

        Returns:
            direction towards the light; distance at which its shadow ray ends, inf if it is distant; and irradiance of
            a surface that faces it.
        """

    @staticmethod
    def uv(p: Row, d: Float[Array, "3"]) -> Float[Array, "2"]:
        """Where its textures are looked up for what it throws in the direction -d; of kinds that may have some."""
        raise NotImplementedError
