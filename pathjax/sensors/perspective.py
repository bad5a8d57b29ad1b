"""The pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import dot
from pathjax.core.types import Ray
from pathjax.description.fields import Fields
from pathjax.description.lens import field_of_view, half_extent
from pathjax.kinds import Unused
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.sensor import Camera, Sensor


@register_dataclass
@dataclass(frozen=True)
class PerspectiveCamera(Camera):
    axes: Float[Array, "3 3"]  # rows: unit right, up, forward in world space
    corner: Float[Array, "2"]  # x, y at distance 1 of the film's upper left corner
    extent: Float[Array, "2"]  # x, y at distance 1 from that corner to the opposite one
    near: Float[Array, ""]  # clip distances along the optical axis
    far: Float[Array, ""]

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        xy = compute_once(self.corner + position * self.extent)
        start, local = self.through_lens(jnp.stack([xy[0], xy[1], jnp.ones_like(xy[0])]), u_lens)
        right, up, forward = self.axes

        def to_world(v):
            return v[0] * right + v[1] * up + v[2] * forward

        v = compute_once(to_world(local))
        length = jnp.sqrt(dot(v, v))
        d = v / length
        along = length / local[2]
        o = self.origin + to_world(start) + d * (self.near * along)
        return Ray(o, d, (self.far - self.near) * along, jnp.int32(-1))

    def through_lens(
        self, local: Float[Array, "3"], u_lens: Float[Array, "2"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return where on the lens a ray starts, and its direction, of any length; both in the camera's axes.

        local: direction through the middle of the lens, with component 1 along the optical axis.
        """
        return jnp.zeros_like(local), local


@dataclass(frozen=True)
class Perspective(Sensor):
    """Camera along +z, x to the left, y up, as in Mitsuba."""

    to_world: np.ndarray  # (4, 4)
    fov: float  # degrees, along fov_axis
    fov_axis: str = "x"  # "x", "y", "diagonal", "smaller", "larger"
    near_clip: float = 1e-2
    far_clip: float = 1e4
    principal_point_offset: tuple[float, float] = (0.0, 0.0)

    unused = Sensor.unused | {"focus_distance": Unused("float", "a pinhole is sharp everywhere")}

    @classmethod
    def read(cls, loader, fields: Fields) -> Perspective:
        near, far = cls.read_clips(fields)
        to_world = fields.transform("to_world")
        if not np.allclose(to_world[:3, :3].T @ to_world[:3, :3], np.eye(3), atol=2e-3):
            raise fields.error("to_world", "scales or shears; a camera can be turned and moved only")
        lens = cls.read_lens(fields, far)
        offset = tuple(fields.float(f"principal_point_offset_{axis}", 0.0) for axis in "xy")
        return cls(to_world, *field_of_view(fields), near, far, offset, **lens)

    @staticmethod
    def read_lens(fields: Fields, far: float) -> dict[str, float]:
        """Read the further fields of cameras that have a lens."""
        return {}

    def build(self, film: HDRFilm, dtype) -> PerspectiveCamera:
        return PerspectiveCamera(*self.arrays(film, dtype))

    def arrays(self, film: HDRFilm, dtype):
        """Return the arrays of a `PerspectiveCamera`, in order."""
        half = half_extent(self.fov, self.fov_axis, film.width / film.height)
        # The local x axis points to the left of the image.
        axes = self.to_world[:3, :3] / np.linalg.norm(self.to_world[:3, :3], axis=0)
        shift = 2 * half * np.array([-self.principal_point_offset[0], -self.principal_point_offset[1]])
        numbers = self.to_world[:3, 3], axes.T, half + shift, -2 * half, self.near_clip, self.far_clip
        return [np.asarray(x, dtype) for x in numbers]
