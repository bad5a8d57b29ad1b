"""The interface of emitters: on surfaces, backgrounds, and Dirac lights."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.kinds import Declared, Instance, Kind, Row


@dataclass(frozen=True)
class Weight(Declared):
    """How often a light is sampled, relative to its `power`. It is no parameter, since it only changes noise."""

    absent: object = 1.0

    def read(self, loader, fields, name, owner):
        return fields.float(name, None, at_least=self.bounds[0])


class Emitter(Kind):
    """A kind of light: `SurfaceEmitter`, `Background` or `DiracEmitter`.

    A class declares its parameters. Colours that are 0 if the light is dark are declared with `radiance=True`.
    Directions are unit and in world space. Results are never NaN, and 0 where no light arrives. Methods are
    differentiated as written, so the derivative in a parameter that moves a light lacks the edges of shadows. The
    choice of a light is detached.
    """

    sampling_weight = Weight(None, bounds=(0, math.inf))
    on_surfaces: ClassVar[bool] = False  # nested in a shape
    distant: ClassVar[bool] = False  # infinitely far
    dirac: ClassVar[bool] = False  # shines from one direction at each point
    single: ClassVar[bool] = False  # a scene may have only one of the kind

    @classmethod
    def has_entries(cls) -> bool:
        """Return whether `entries` lists what it looks up in `Shared` arrays."""
        return False

    @staticmethod
    @abstractmethod
    def power(p) -> Float[Array, " R"]:
        """Return the brightness by which a light is chosen among the near, or among the distant lights.

        It is the power per area of surfaces, the power of other near lights, and the irradiance of distant ones, each
        divided by pi.

        p: the parameters of all R rows, (R, *shape).
        """


class SurfaceEmitter(Emitter):
    """An emitter of a shape, which shines from its front. The shape samples points on it."""

    on_surfaces = True
    even: ClassVar[bool] = False  # emits its parameter `radiance` in all directions, and nothing else

    @staticmethod
    @abstractmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the radiance that leaves the front of the surface in the direction -d."""


class Background(Emitter):
    """Radiance from all directions in which nothing is hit. Several backgrounds add up and are sampled as a mixture."""

    distant = True
    left_to_bsdfs: ClassVar[bool] = False  # bsdf samples find it with less noise; only strategy "light" samples it

    @staticmethod
    @abstractmethod
    def sample(p: Row, u: Float[Array, "2"], u_part: Float[Array, ""]) -> Float[Array, "3"]:
        """Sample a direction by `density`. u, u_part: uniform in [0, 1)."""

    @staticmethod
    @abstractmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the radiance from the direction d."""

    @staticmethod
    def entries(p: Row, d: Float[Array, "3"]) -> list[tuple[str, Int[Array, ""], Float[Array, ""]]]:
        """Return the colours in `Shared` arrays that `emitted` is a weighted sum of: parameter, entry, weight.

        They serve derivatives: `emitted` adds `p.nudge(parameter)` to the sum.
        """
        return []

    @classmethod
    def has_entries(cls):
        return cls.entries is not Background.entries

    @staticmethod
    @abstractmethod
    def density(p: Row, d: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the density [1/sr] of d in `sample`."""

    @classmethod
    def met(cls, p: Row, d: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Return `emitted` and `density`, for kinds whose two share computations."""
        return cls.emitted(p, d), cls.density(p, d)


class DiracEmitter(Emitter):
    """A light that shines from one direction at each point: no ray hits it, and no bsdf sample finds it."""

    dirac = True
    # With weight 0 it would never be sampled.
    sampling_weight = Weight(None, bounds=(float(np.finfo(np.float32).tiny), math.inf))

    @classmethod
    def read(cls, loader, fields, name, **known):
        made = super().read(loader, fields, name, **known)
        for key, texture in made.values.items():
            if isinstance(texture, Instance) and not texture.kind.follows_uv(texture):
                raise fields.error(key, "is a texture that depends on more than uv; use a bitmap")
        return made

    @staticmethod
    @abstractmethod
    def sample(p: Row, ref: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        """Return the light that arrives at the point ref.

        Returns:
            The direction towards the light; the distance at which its shadow ray ends, inf if it is distant; and the
            irradiance of a surface that faces it.
        """

    @staticmethod
    def uv(p: Row, d: Float[Array, "3"]) -> Float[Array, "2"]:
        """Return where its textures are looked up for light in the direction -d; for kinds that may have textures."""
        raise NotImplementedError
