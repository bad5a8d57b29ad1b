"""The infinitely distant sensor: it measures the radiance that leaves a scene in one direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.core.math import dot
from pathjax.core.types import Ray
from pathjax.core.warp import square_to_disk
from pathjax.description.fields import Fields
from pathjax.kinds import Direction
from pathjax.sensors import region
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.radiancemeter import OneRay
from pathjax.sensors.sensor import Sensor


@register_dataclass
@dataclass(frozen=True)
class ParallelRays(OneRay):
    """Parallel rays with origins uniform on a disk around `origin`."""

    across: Float[Array, "2 3"]  # two radii of the disk

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        ray, offset = super().sample_ray(position, u_lens), square_to_disk(u_lens)
        return ray._replace(o=ray.o + offset[0] * self.across[0] + offset[1] * self.across[1])


@register_dataclass
@dataclass(frozen=True)
class ParallelsOntoShape(OneRay):
    """Parallel rays towards uniform points of a shape; they start outside the sphere around `origin`."""

    region: region.Region
    radius: Float[Array, ""]

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        ray, (p, _, _) = super().sample_ray(position, u_lens), self.region.sample(u_lens)
        off = p - self.origin
        return ray._replace(o=p - ray.d * (jnp.sqrt(dot(off, off)) + self.radius))


@dataclass(frozen=True)
class Distant(Sensor):
    """Sensor that looks in one direction: at a point, uniformly at a shape, or at the disk that the sphere around the
    scene's box covers.

    Files give the direction, or `to_world`, which rotates z to it and whose scale is that of the disk.
    """

    direction: np.ndarray  # (3,) unit
    across: np.ndarray  # (2, 3) x and y of `to_world`
    target: np.ndarray | object | None  # (3,), or a `description.Shape`; None: the whole scene
    center: np.ndarray  # (3,) of the sphere around the scene's box
    radius: float

    one_pixel: ClassVar[bool] = True

    @classmethod
    def read(cls, loader, fields: Fields) -> Distant:
        direction = Direction().read(loader, fields, "direction", "")
        shape = fields.object("shape", "target")
        target = fields.point("target", None) if shape is None else loader.surface(shape)
        if fields.has("to_world"):
            across = fields.transform("to_world")[:3, :2].T
        else:
            _, _, (_, *across) = np.linalg.svd(direction[None])  # any two unit vectors at right angles
        return cls(direction, np.stack(across), target, *loader.around(fields.element))

    def build(self, film: HDRFilm, dtype) -> OneRay:
        if isinstance(self.target, np.ndarray):
            start = self.target - self.direction * (np.linalg.norm(self.target - self.center) + self.radius)
            return OneRay(np.asarray(start, dtype), np.asarray(self.direction, dtype))
        if self.target is not None:
            numbers = (np.asarray(x, dtype) for x in (self.center, self.direction))
            return ParallelsOntoShape(*numbers, region.build(self.target, dtype), np.asarray(self.radius, dtype))
        numbers = self.center - self.direction * self.radius, self.direction, self.radius * self.across
        return ParallelRays(*(np.asarray(x, dtype) for x in numbers))
