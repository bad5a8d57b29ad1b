"""A point light that shines into a cone."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.core.math import cross, dot, larger, luminance, safe_atan2, safe_divide, safe_sqrt
from pathjax.emitters.point import Point
from pathjax.kinds import Angle, Color, Direction, Rotation, Row


class Spot(Point):
    """A cone of light: `intensity` up to `beam_width` off its axis, falling linearly from there to `cutoff_angle`."""

    # Over the square around the cone, as seen from the light; rows without one are white.
    texture = Color(None, bounds=(0, math.inf), radiance=True, absent=1.0)
    cutoff_angle = Angle(20.0, bounds=(0, 180))
    beam_width = Angle(None)  # by default 3/4 of the cutoff angle
    direction = Direction()
    to_world = Rotation(None)  # of the texture

    @classmethod
    def read(cls, loader, fields, name):
        to_world = fields.transform("to_world")
        axes = to_world[:3, :3] / np.linalg.norm(to_world[:3, 2])
        if not np.allclose(axes.T @ axes, np.eye(3), atol=2e-3):
            raise fields.error("to_world", "shears or scales unevenly, and its cone would not be round")
        placed = {"position": to_world[:3, 3], "direction": Direction.of(to_world[:3, 2]), "to_world": axes}
        beam = fields.float("beam_width", None, at_least=0)
        values = dict(super().read(loader, fields, name, beam_width=beam, **placed).values)
        cutoff = values["cutoff_angle"]
        if values["beam_width"] > cutoff:
            loader.note(fields.where("beam_width"), f"is wider than cutoff_angle, {cutoff:g}, where the light ends")
            values["beam_width"] = cutoff
        if values["texture"] is None:
            values["to_world"] = None
        elif cutoff >= 90:
            raise fields.error("cutoff_angle", f"must be below 90 where a texture covers the cone, is {cutoff:g}")
        return cls.instance(name, **values)

    @classmethod
    def instance(cls, name="", **values):
        if values.get("beam_width") is None:
            values["beam_width"] = values.get("cutoff_angle", cls.cutoff_angle.default) * 3 / 4
        return super().instance(name, **values)

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        """Return the power of a point light, times the root of the share of its light that is left.

        The mean square error of an image is least if lights are chosen by the root mean square of their contribution.
        """
        cutoff, beam = jnp.radians(p.cutoff_angle), jnp.radians(p.beam_width)
        middle, half = (cutoff + beam) / 2, (cutoff - beam) / 2
        # (1 - (sin c - sin b) / (c - b)) / 2. In that form rounding would make it 0 for narrow cones, which would then
        # never be chosen.
        share = jnp.sin(middle / 2) ** 2 + jnp.cos(middle) * (1 - jnp.sinc(half / math.pi)) / 2
        bright = Point.power(p) if p.texture is None else 4 * luminance(p.intensity * p.texture)
        return bright * jnp.sqrt(share)

    @staticmethod
    def sample(p: Row, ref: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        d, distance, irradiance = Point.sample(p, ref)
        axis, cutoff, beam = p.direction, p.cutoff_angle, p.beam_width
        across = cross(axis, d)
        angle = safe_atan2(safe_sqrt(dot(across, across)), -dot(axis, d)) * (180 / math.pi)
        falloff = jnp.where(angle < beam, 1, larger(safe_divide(cutoff - angle, cutoff - beam), 0))
        if p.to_world is not None:
            irradiance = irradiance * p.on(Spot.uv(p, d)).texture
        return d, distance, irradiance * falloff

    @staticmethod
    def uv(p: Row, d: Float[Array, "3"]) -> Float[Array, "2"]:
        """The texture fills the square that just holds the cone; outside of that, uv is arbitrary."""
        x, y, z = -(d @ p.to_world)
        radius = jnp.tan(p.cutoff_angle * (math.pi / 180))
        scale = 0.5 * safe_divide(1, jnp.where(x * x + y * y < 2 * (z * radius) ** 2, larger(z, 0) * radius, 0))
        return jnp.stack([x, y]) * scale + jnp.asarray(0.5, d.dtype)
