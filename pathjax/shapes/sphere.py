"""Spheres, from marbles to the walls of radius 1e5 of the classic boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import (
    at,
    cos_sin_turns,
    cross,
    dot,
    frame_from_normal,
    larger,
    normalize,
    safe_divide,
    safe_sqrt,
    to_world,
    turns,
)
from pathjax.core.types import Surface
from pathjax.core.warp import SPHERE_PDF, cone_pdf, square_to_cone, square_to_sphere
from pathjax.description.fields import Fields
from pathjax.shapes import coincident
from pathjax.shapes.accel.leaves import numbers_of, pack, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.ellipsoid import Ellipsoid, Ellipsoids
from pathjax.shapes.shape import ROUND, LampSample, Primitives, Shape, Table


@dataclass
class Ball(Primitives):
    balls: np.ndarray  # (1, 4) center, radius
    to_local: np.ndarray  # (1, 3, 3)
    sign: np.ndarray  # (1,)

    @property
    def areas(self):
        return _areas(self.balls)

    def boxes(self):
        return bounds(self.balls)


@register_dataclass
@dataclass(frozen=True)
class Spheres(Table):
    leaves: jax.Array  # center, radius
    tree: Tree | None
    balls: jax.Array  # (P, 4) center, radius
    to_local: jax.Array  # (P, 3, 3) rotation into the frame of its uv
    sign: jax.Array  # (P,) -1 where the normal points inwards
    margins: jax.Array | None  # (P,) of `coincident`; None: no two spheres coincide

    kind = "sphere"
    even_chords = True

    @classmethod
    def build(cls, parts, lit, dtype, rule, margins):
        rows = [np.concatenate([getattr(part, name) for part in parts]) for name in ("balls", "to_local", "sign")]
        packed, tree, built = pack(rows[0], *bounds(rows[0]), dtype, rule)
        return cls(packed, tree, *(np.asarray(x, dtype) for x in rows), margins), {cls.kind: built}

    @classmethod
    def own_margins(cls, parts, dtype):
        """Return margins (P,): 0 for spheres that coincide with no other one."""
        balls = np.concatenate([part.balls for part in parts])
        return coincident.margins_of_alike(balls, np.linalg.norm(balls[:, :3], axis=1) + balls[:, 3], dtype)

    def intersect(self, leaf, prepared, start):
        """Compute the discriminant from the vector of closest approach, and the roots without cancellation (Haines,
        Gunther, Akenine-Moller 2019, "Precision improvements for ray/sphere intersection"). The sphere that the ray
        starts on has a root that is exactly 0.
        """
        o, d = prepared
        block = at(self.leaves, leaf)
        leaf = numbers_of(block, d.dtype)
        radius = leaf[3]
        f = [o[axis] - leaf[axis] for axis in range(3)]
        b = -dot(f, d)
        closest = [f[axis] + b * d[axis] for axis in range(3)]
        half_chord = jnp.sqrt(radius * radius - dot(closest, closest))  # NaN: a miss, which every comparison drops
        f_length = jnp.sqrt(dot(f, f))
        rows = rows_of(block)
        c = jnp.where(rows == start, 0, (f_length - radius) * (f_length + radius))
        q = b + jnp.copysign(half_chord, b)
        other = c / q
        near, far = jnp.where(q < other, q, other), jnp.where(q < other, other, q)
        return jnp.where(near > 0, near, far), rows

    @property
    def count(self):
        return self.balls.shape[0]

    def surface(self, row, o, d, t):
        """Compute the surface at t; the margin is 0 unless spheres coincide."""
        ball = at(self.balls, row)
        center, radius = ball[:3], ball[3]
        f = o - center
        b = -dot(f, d)
        closest = f + b * d
        half_chord = safe_sqrt(radius * radius - dot(closest, closest))
        # t tells which of the two roots was hit.
        outward = compute_once(normalize(closest + jnp.copysign(half_chord, t - b) * d))
        local = compute_once(at(self.to_local, row) @ outward)
        n = outward * at(self.sign, row)
        margin = jnp.zeros_like(radius) if self.margins is None else at(self.margins, row)
        return Surface(center + radius * outward, n, margin, n, Ellipsoids.uv(local))

    def along_u(self, row, surface):
        return cross(at(self.to_local, row)[2], surface.p - at(self.balls, row)[:3])

    def sample_lamp(self, lamps, lamp, ref, u, u_part):
        """Sample uniformly the cone that the sphere subtends at `ref`; from inside, uniformly its area."""
        row = at(lamps.first, lamp)
        ball = at(self.balls, row)
        center, radius = ball[:3], ball[3]
        one_minus_cos, outside = _one_minus_cos(ball, ref)
        to_center = center - ref
        axis = normalize(to_center)
        frame = frame_from_normal(axis)
        # Five results read d: without the barrier each would compute it again.
        d = compute_once(to_world(frame, square_to_cone(u, one_minus_cos)))
        b = dot(to_center, d)
        closest = b * d - to_center
        distance = larger(b - safe_sqrt(radius * radius - dot(closest, closest)), jnp.zeros_like(b))
        outward = normalize(ref + distance * d - center)

        from_inside = square_to_sphere(u)
        to_p = center + radius * from_inside - ref
        d_inside = normalize(to_p)
        distance_inside = jnp.sqrt(dot(to_p, to_p))

        outward = jnp.where(outside, outward, from_inside)
        d = jnp.where(outside, d, d_inside)
        distance = jnp.where(outside, distance, distance_inside)
        n, pdf = outward * at(self.sign, row), _pdf(ball, one_minus_cos, outside, outward, d, distance)
        return LampSample(*compute_once((d, distance, n, pdf)), row)

    def sample(self, row, u):
        return self.from_square(row, u)

    def lamp_density(self, lamps, lamp, first, ray, hit, surface):
        ball = at(self.balls, hit.primitive - first)
        one_minus_cos, outside = _one_minus_cos(ball, ray.o)
        return _pdf(ball, one_minus_cos, outside, surface.n, ray.d, hit.t)

    @property
    def turned_inwards(self):
        """Whether each normal points inwards, (P,) bool."""
        return np.asarray(self.sign) < 0

    def areas(self):
        return _areas(np.asarray(self.balls, float))

    def cell_lengths(self, size):
        area = self.areas()
        belts = np.maximum(np.rint(np.sqrt(area / math.pi) / size), 1)
        return np.stack([area / (belts * size), belts * size], -1)

    def to_square(self, row, p):
        local = at(self.to_local, row) @ normalize(p - at(self.balls, row)[:3])
        return jnp.stack([turns(local[1], local[0]), (1 - local[2]) / 2])

    def from_square(self, row, xy):
        center, radius = at(self.balls, row)[:3], at(self.balls, row)[3]
        z = 1 - 2 * xy[1]
        r = safe_sqrt(1 - z * z)
        cos, sin = cos_sin_turns(xy[0])
        outward = at(self.to_local, row).T @ jnp.stack([r * cos, r * sin, z])
        reach, n = jnp.abs(center) + radius, outward * at(self.sign, row)
        return center + radius * outward, n, dot(jnp.abs(n), reach) * (4 * jnp.finfo(radius.dtype).eps)


@dataclass(frozen=True)
class Sphere(Shape):
    center: np.ndarray  # (3,) world
    radius: float
    to_world: np.ndarray  # (4, 4) maps the unit sphere at the origin; in kernels only its rotation matters (uv)
    table = Spheres
    closed = True

    @classmethod
    def read(cls, loader, fields: Fields):
        local = np.eye(4)
        local[:3, 3] = fields.point("center", np.zeros(3))
        local[:3, :3] *= fields.float("radius", 1.0, above=0)
        to_world = fields.transform("to_world") @ local
        made = cls.of(to_world)
        if made is None:
            made = cls.of(_rounded(to_world))
            if made is None:
                raise fields.error("to_world", "makes a sphere that is too large or too small")
            why = "scales unevenly or shears; as in Mitsuba it stays a sphere, of the scale along x"
            loader.note(fields.where("to_world"), f"{why}; textures lie on it as on any other")
        return made

    @classmethod
    def of(cls, to_world: np.ndarray) -> Sphere | None:
        """Return the transformed unit sphere; None if it is not a sphere."""
        radius = float(np.linalg.norm(to_world[:3, 0]))
        with np.errstate(all="ignore"):
            unit = to_world[:3, :3] / radius
            round_enough = np.allclose(unit.T @ unit, np.eye(3), atol=ROUND)
            return cls(to_world[:3, 3], radius, to_world) if round_enough and 0 < np.float32(radius) < np.inf else None

    def placed(self, to_world):
        to_world = to_world @ self.to_world
        return self.of(to_world) or Ellipsoid.of(to_world)

    @property
    def mirrored(self):
        return bool(np.linalg.det(self.to_world[:3, :3]) < 0)

    def primitives(self, flip):
        linear = self.to_world[:3, :3]
        rotation = linear / np.linalg.norm(linear, axis=0)
        balls = np.array([[*self.center, self.radius]])
        return Ball(balls, rotation.T[None], np.array([-1.0 if flip else 1.0]))


def _rounded(to_world):
    """Return a transform of the same rotation and translation that scales all axes as `to_world` scales x."""
    with np.errstate(all="ignore"):
        u, _, vt = np.linalg.svd(to_world[:3, :3])
        made = np.eye(4)
        made[:3, :3] = u @ vt * np.linalg.norm(to_world[:3, 0])
        made[:3, 3] = to_world[:3, 3]
        return made


def bounds(balls):
    """Return the bounds, two (P, 3), of balls (P, 4)."""
    return balls[:, :3] - balls[:, 3:], balls[:, :3] + balls[:, 3:]


def _areas(balls):
    return 4 * math.pi * balls[:, 3] ** 2


def _one_minus_cos(ball, ref):
    """Return 1 - cos of the half angle that the ball subtends at a point, and whether the point is outside."""
    f = ref - ball[:3]
    squared, radius2 = dot(f, f), ball[3] * ball[3]
    outside = squared > radius2 * (1 + 4 * np.finfo(ball.dtype).eps)
    sin2 = jnp.where(outside, radius2 / jnp.where(outside, squared, 1), 1)
    return sin2 / (1 + safe_sqrt(1 - sin2)), outside


def _pdf(ball, one_minus_cos, outside, n, d, distance):
    by_area = SPHERE_PDF * safe_divide(distance * distance, jnp.abs(dot(n, d)) * ball[3] * ball[3])
    return jnp.where(outside, cone_pdf(one_minus_cos), by_area)
