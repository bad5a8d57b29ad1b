"""The camera whose rays are parallel."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.core.types import Ray
from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.sensor import Camera, Sensor


@register_dataclass
@dataclass(frozen=True)
class OrthographicCamera(Camera):
    """Parallel rays; `origin` is the start of those of the film's upper left corner, on the near clip plane."""

    across: Float[Array, "2 3"]  # from `origin` to the film's upper right corner, and to the lower left one
    direction: Float[Array, "3"]  # unit
    length: Float[Array, ""]  # of rays

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        o = self.origin + position[0] * self.across[0] + position[1] * self.across[1]
        return Ray(o, self.direction, self.length, jnp.int32(-1))


@dataclass(frozen=True)
class Orthographic(Sensor):
    """Camera along +z, x to the left, y up; the film is 2 wide before `to_world`, which may scale it, as in Mitsuba."""

    to_world: np.ndarray  # (4, 4)
    near_clip: float = 1e-2
    far_clip: float = 1e4

    unused = Sensor.unused | {"focus_distance": Unused("float", "it is sharp everywhere")}

    @classmethod
    def read(cls, loader, fields: Fields) -> Orthographic:
        return cls(fields.transform("to_world"), *cls.read_clips(fields))

    def build(self, film: HDRFilm, dtype) -> OrthographicCamera:
        aspect = film.width / film.height
        left, up, forward, middle = self.to_world[:3].T
        corner = middle + left + up / aspect + forward * self.near_clip
        numbers = corner, np.stack([-2 * left, -2 / aspect * up]), forward / np.linalg.norm(forward)
        return OrthographicCamera(*(np.asarray(x, dtype) for x in (*numbers, self.far_clip - self.near_clip)))
