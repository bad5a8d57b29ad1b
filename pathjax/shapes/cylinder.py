"""Cylinders without caps, of elliptic cross-section where scaled unevenly, oblique where sheared."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from pathjax.compile import register_dataclass
from pathjax.core.math import at, cos_sin_turns, cross, dot, safe_divide, turns
from pathjax.description.fields import Fields
from pathjax.shapes.carried import Carried, Placed, invertible
from pathjax.shapes.shape import ROUND, Shape

# Relative tolerance: a crossing of the wall that lies within this share of the distance to `ref` is `ref` itself.
CLEAR = 1e-3
# Steps of Gauss's mean, which squares the error each time: enough for the means of any two float32 values to agree.
MEANS = 12


@register_dataclass
@dataclass(frozen=True)
class Cylinders(Carried):
    """Cylinders; in object space they are the unit circles around the z axis from z = 0, where v = 0, to z = 1."""

    kind = "cylinder"
    axes_across = 2

    @classmethod
    def bounds(cls, to_world):
        reach = np.linalg.norm(to_world[:, :, :2], axis=2)
        one, other = to_world[:, :, 3], to_world[:, :, 3] + to_world[:, :, 2]
        return np.minimum(one, other) - reach, np.maximum(one, other) + reach

    @classmethod
    def where(cls, to_world):
        """Return the axis as a line: its direction, of fixed sign, and point nearest to the origin; and axes across."""
        axis, start = to_world[:, :, 2], to_world[:, :, 3]
        axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        axis = axis * np.copysign(1, axis[np.arange(len(axis)), np.abs(axis).argmax(1)])[:, None]
        size = np.abs(to_world).sum(2).max()
        nearest = start - (start * axis).sum(1, keepdims=True) * axis
        across = to_world[:, :, :2] - axis[:, :, None] * (axis[:, None] @ to_world[:, :, :2])
        return np.concatenate([axis * size, nearest], 1), across

    @classmethod
    def areas_of(cls, to_world):
        """Return areas as perimeters, by Gauss's mean, of the ellipse that gives the area per azimuth."""
        x, y, z = np.moveaxis(to_world[:, :, :3], 2, 0)
        a, b = np.linalg.svd(np.stack([np.cross(x, z), np.cross(y, z)], 2), compute_uv=False).T
        rest, weight = a * a, 0.5
        for _ in range(MEANS):
            rest, weight = rest - weight * (a * a - b * b), 2 * weight
            a, b = (a + b) / 2, np.sqrt(a * b)
        return 2 * math.pi * rest / a

    @staticmethod
    def meets(t, f, d):
        """Include the ends up to rounding, so that disks close them without a gap."""
        slack = 8 * np.finfo(t.dtype).eps
        rise = t * d[2]
        slack = slack * (jnp.abs(f[2]) + 1 + jnp.abs(rise))
        return (t > 0) & (f[2] + rise >= -slack) & (f[2] + rise <= 1 + slack)

    @staticmethod
    def on(outward, along):
        return jnp.stack([outward[0], outward[1], jnp.clip(along, 0, 1)])

    @staticmethod
    def uv(local):
        return jnp.stack([turns(local[1], local[0]), local[2]])

    # ---- light

    def sample(self, row, u):
        """Draw uniformly in the azimuth of object space and along the axis: uniformly in area, if it is round."""
        return self.from_square(row, u)

    def sample_lamp(self, lamps, lamp, ref, u, u_part):
        """Draw as for any lamp, with pdf 0 for inner points that the wall hides: shadow rays ignore their own lamp."""
        drawn = super().sample_lamp(lamps, lamp, ref, u, u_part)
        row, distance = drawn.primitive, drawn.distance
        f, d = self.local(row, ref), at(self.duals, row) @ drawn.d
        outward = f[:2] + distance * d[:2]
        # Distance back along the ray to the other crossing of the wall; at `ref` or beyond it, if `ref` lies inside.
        chord = safe_divide(2 * (d[0] * outward[0] + d[1] * outward[1]), d[0] * d[0] + d[1] * d[1])
        along = f[2] + (distance - chord) * d[2]
        enters = (chord > 0) & (chord < distance * (1 - CLEAR)) & (along > 0) & (along < 1)
        return drawn._replace(pdf=jnp.where(enters, 0, drawn.pdf * self._thinning(lamps, lamp, row, outward)))

    def lamp_density(self, lamps, lamp, first, ray, hit, surface):
        row = hit.primitive - first
        thinning = self._thinning(lamps, lamp, row, self.local(row, surface.p))
        return super().lamp_density(lamps, lamp, first, ray, hit, surface) * thinning

    def _thinning(self, lamps, lamp, row, local):
        """Return the density of sampled points of a lamp, relative to a density uniform in area."""
        axes = at(self.to_world, row)
        spread = cross(local[0] * axes[:, 1] - local[1] * axes[:, 0], axes[:, 2])
        return safe_divide(at(lamps.area, lamp) / (2 * math.pi), jnp.sqrt(dot(spread, spread)))

    # ---- patches

    def even(self):
        axes = np.asarray(self.to_world, float)[:, :, :3]
        unit = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        lengths = np.linalg.norm(axes[:, :, :2], axis=1)
        upright = np.abs(unit.swapaxes(1, 2) @ unit - np.eye(3)).max((1, 2)) < ROUND
        return upright & (np.abs(lengths[:, 0] / lengths[:, 1] - 1) < ROUND)

    def areas(self):
        return self.areas_of(np.asarray(self.to_world, float))

    def cell_lengths(self, size):
        axes = np.linalg.norm(np.asarray(self.to_world, float), axis=1)
        return np.stack([2 * math.pi * axes[:, 0], axes[:, 2]], -1)

    def to_square(self, row, p):
        local = self.local(row, p)
        return jnp.stack([turns(local[1], local[0]), local[2]])

    def from_square(self, row, xy):
        cos, sin = cos_sin_turns(xy[0])
        n = self.normal(row, jnp.stack([cos, sin]))
        reach = jnp.sum(jnp.abs(at(self.to_world, row)), axis=1)
        margin = dot(jnp.abs(n), reach) * (4 * jnp.finfo(n.dtype).eps)
        return self.point(row, jnp.stack([cos, sin, xy[1]])), n, margin


@dataclass(frozen=True)
class Cylinder(Shape):
    to_world: np.ndarray  # (4, 4) maps the unit circles around the z axis at z = 0 and z = 1 to the two ends
    table = Cylinders

    @classmethod
    def read(cls, loader, fields: Fields):
        p0, p1 = fields.point("p0", np.zeros(3)), fields.point("p1", np.array([0.0, 0.0, 1.0]))
        radius = fields.float("radius", 1.0, above=0)
        length = np.linalg.norm(p1 - p0)
        if not 0 < length < 3e38:
            raise fields.error("p1", "is where p0 is; the two are the ends of the axis")
        axis = (p1 - p0) / length
        # Mitsuba's frame, so that u begins where it does there.
        sign = math.copysign(1, axis[2])
        s = [1 - sign * axis[0] ** 2 / (sign + axis[2]), -sign * axis[0] * axis[1] / (sign + axis[2]), -sign * axis[0]]
        local = np.eye(4)
        local[:3] = np.stack([radius * np.array(s), radius * np.cross(axis, s), p1 - p0, p0], axis=1)
        made = cls.of(fields.transform("to_world") @ local)
        if made is None:
            raise fields.error("to_world", "makes a cylinder that is flat, or too large or small")
        return made

    @classmethod
    def of(cls, to_world: np.ndarray) -> Cylinder | None:
        """Return the transformed unit cylinder; None if it is flat."""
        return cls(to_world) if invertible(to_world) else None

    def placed(self, to_world):
        return self.of(to_world @ self.to_world)

    def primitives(self, flip):
        return Placed(self.to_world[None, :3], np.array([-1.0 if flip else 1.0]), Cylinders)
