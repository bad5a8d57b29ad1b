"""The sensor that measures the irradiance of a shape."""

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
    """Rays from uniform points of a shape, in cosine-weighted directions on the side of its normals."""

    region: region.Region

    gain: ClassVar[float] = math.pi  # irradiance = pi times the cosine-weighted mean radiance

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        p, n, margin = self.region.sample(position)
        d = to_world(frame_from_normal(n), square_to_cosine_hemisphere(u_lens))
        return Ray(p + margin * n, d, jnp.full_like(margin, jnp.inf), jnp.int32(-1))


@dataclass(frozen=True)
class IrradianceMeter(Sensor):
    """Sensor of the mean irradiance of a shape, on the side of its normals; in files it is nested in the shape."""

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
