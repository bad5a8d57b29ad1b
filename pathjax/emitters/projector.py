"""A point light that projects an image, the reverse of a camera."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.core.math import dot, luminance, safe_divide, safe_sqrt
from pathjax.description.lens import field_of_view, half_extent
from pathjax.emitters.emitter import DiracEmitter
from pathjax.emitters.point import REACH
from pathjax.kinds import Color, Instance, Number, PerRow, Position, Rotation, Row


class Projector(DiracEmitter):
    """Looks along +z, x to the left, y up. A screen across its axis, at distance 1, receives `irradiance` times pi."""

    irradiance = Color(1.0, bounds=(0, math.inf), radiance=True)
    scale = Number(1.0, bounds=(0, math.inf))
    position = Position()
    to_world = Rotation()
    tan_x = PerRow()  # () half the width of the image at distance 1
    tan_y = PerRow()  # () half the height

    @classmethod
    def read(cls, loader, fields, name):
        to_world = fields.transform("to_world")
        if not np.allclose(to_world[:3, :3].T @ to_world[:3, :3], np.eye(3), atol=2e-3):
            raise fields.error("to_world", "scales or shears; a projector can be turned and moved only")
        placed = {"position": to_world[:3, 3], "to_world": to_world[:3, :3]}
        values = super().read(loader, fields, name, **placed).values
        return cls.instance(name, **values | _extent(*field_of_view(fields), values["irradiance"]))

    @classmethod
    def instance(cls, name="", **values):
        return super().instance(name, **_extent(90, "x", values.get("irradiance")) | values)

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        """Return the power of a point light, times the root of its share of all directions, as for a spot."""
        wide, high = p.tan_x, p.tan_y
        solid_angle = 4 * jnp.arcsin(wide * high / jnp.sqrt((1 + wide * wide) * (1 + high * high)))
        return (4 * math.pi) * luminance(p.irradiance) * p.scale * jnp.sqrt(solid_angle / (4 * math.pi))

    @staticmethod
    def sample(p: Row, ref: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        to_light = p.position - ref
        squared = dot(to_light, to_light)
        distance = safe_sqrt(squared)
        d = to_light * safe_divide(1, distance)
        z, uv = _screen(p, d)
        ahead = safe_divide(1, jnp.where(z > 0, z, 0))
        inside = (z > 0) & jnp.all((uv >= 0) & (uv <= 1))
        seen = p.on(jnp.where(inside, uv, 0)).irradiance * p.scale
        # Light meets the screen at the cosine z, and the screen is 1 / z times as far away as along the axis.
        arriving = seen * (math.pi * ahead**3 * safe_divide(1, squared))
        return d, distance * REACH, jnp.where(inside, arriving, 0)

    @staticmethod
    def uv(p: Row, d: Float[Array, "3"]) -> Float[Array, "2"]:
        _, uv = _screen(p, d)
        return uv


def _screen(p: Row, d: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """Return the cosine between the axis and -d, and the uv on the screen in the direction -d."""
    x, y, z = -(d @ p.to_world)
    ahead = safe_divide(1, jnp.where(z > 0, z, 0))
    return z, jnp.asarray(0.5, d.dtype) * (1 - jnp.stack([x / p.tan_x, y / p.tan_y]) * ahead)


def _extent(fov: float, fov_axis: str, irradiance) -> dict[str, float]:
    """Return half the size of the image at distance 1; its aspect is that of its texels, or else a square."""
    height, width = irradiance.kind.resolution(irradiance) if isinstance(irradiance, Instance) else (1, 1)
    return dict(zip(("tan_x", "tan_y"), half_extent(fov, fov_axis, width / height).tolist(), strict=True))
