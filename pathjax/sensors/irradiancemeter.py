"""The sensor that measures how much light falls on a shape."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.core.math import frame_from_normal, to_world
from pathjax.core.types import Ray
from pathjax.core.warp import square_to_cosine_hemisphere
from pathjax.description.fields import Fields
from pathjax.sensors import region
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.sensor import Camera, Sensor


@register_dataclass
@dataclass(frozen=True)
class Skin(Camera):
    """Looks from all points of a shape, evenly, in all directions before it, by the cosine."""

    region: region.Region

    gain: ClassVar[float] = math.pi  # the mean radiance by the cosine times pi is the irradiance

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        p, n, margin = self.region.sample(position)
        d = to_world(frame_from_normal(n), square_to_cosine_hemisphere(u_lens))
        return Ray(p + margin * n, d, jnp.full_like(margin, jnp.inf), jnp.int32(-1))


@dataclass(frozen=True)
class IrradianceMeter(Sensor):
    """The mean irradiance of a shape, on the side of its normals; in files it stands inside of the shape."""

    shape: object  # `description.Shape`

    one_pixel: ClassVar[bool] = True
    inner: ClassVar[bool] = False

    @classmethod
    def read(cls, loader, fields: Fields) -> IrradianceMeter:
        shape = loader.measured(fields.element)
        if shape is None:
            raise fields.element.error(f"{fields.element} stands inside of the <shape> on which it measures light")
        return cls(shape)

    def build(self, film: HDRFilm, dtype) -> Skin:
        return Skin(np.zeros(3, dtype), region.build(self.shape, dtype))
