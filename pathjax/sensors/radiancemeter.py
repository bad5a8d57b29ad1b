"""The sensor that measures the radiance along one ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.core.types import Ray
from pathjax.description.fields import Fields
from pathjax.kinds import Direction
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.sensor import Camera, Sensor


@register_dataclass
@dataclass(frozen=True)
class OneRay(Camera):
    direction: Float[Array, "3"]  # unit

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        return Ray(self.origin, self.direction, jnp.full_like(position[0], jnp.inf), jnp.int32(-1))


@dataclass(frozen=True)
class RadianceMeter(Sensor):
    """Sensor of one ray. Files give origin and direction, or `to_world`, which maps origin and z axis to them."""

    origin: np.ndarray  # (3,)
    direction: np.ndarray  # (3,) unit

    one_pixel: ClassVar[bool] = True

    @classmethod
    def read(cls, loader, fields: Fields) -> RadianceMeter:
        direction = Direction().read(loader, fields, "direction", "")
        if fields.has("to_world"):
            if fields.has("origin"):
                raise fields.error("origin", "excludes to_world; give one or the other")
            return cls(fields.transform("to_world")[:3, 3], direction)
        if fields.has("origin") != fields.has("direction"):
            raise fields.element.error(f"{fields.element} needs both origin and direction, or to_world")
        return cls(fields.point("origin", np.zeros(3)), direction)

    def build(self, film: HDRFilm, dtype) -> OneRay:
        return OneRay(np.asarray(self.origin, dtype), np.asarray(self.direction, dtype))
