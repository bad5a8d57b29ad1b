"""Cylinders without caps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import register_dataclass
from pathjax.core.math import at, cos_sin_turns, dot, normalize, safe_divide, safe_sqrt, turns
from pathjax.core.types import Surface
from pathjax.description.fields import Fields
from pathjax.shapes import coincident
from pathjax.shapes.accel.leaves import numbers_of, pack, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.shape import ROUND, Primitives, Shape, Table

# Share of the way to a lamp: what lies in its last part, seen from a point on the lamp itself, is that point.
CLEAR = 1e-3


@dataclass
class Tube(Primitives):
    tubes: np.ndarray  # (1, 8): middle of the end where v = 0, unit axis to the other end, radius, length
    across: np.ndarray  # (1, 2, 3): unit vectors across the axis, from the first of which u turns to the second
    sign: np.ndarray  # (1,)

    @property
    def areas(self):
        return _areas(self.tubes)

    def boxes(self):
        return bounds(self.tubes)


@register_dataclass
@dataclass(frozen=True)
class Cylinders(Table):
    leaves: jax.Array  # of `tubes`
    tree: Tree | None
    tubes: jax.Array  # (P, 8) as in `Tube`
    across: jax.Array  # (P, 2, 3)
    sign: jax.Array  # (P,) -1 where the normal points inwards
    margins: jax.Array | None  # (P,) of `coincident`; None: no two of these coincide

    kind = "cylinder"

    @classmethod
    def build(cls, parts, lit, dtype, rule, margins):
        rows = [np.concatenate([getattr(part, name) for part in parts]) for name in ("tubes", "across", "sign")]
        packed, tree, built = pack(rows[0], *bounds(rows[0]), dtype, rule)
        return cls(packed, tree, *(np.asarray(x, dtype) for x in rows), margins), {cls.kind: built}

    @classmethod
    def own_margins(cls, parts, dtype):
        """0 for cylinders that lie in no other one of the same radius."""
        tubes = np.concatenate([part.tubes for part in parts])
        start, axis, radius, length = tubes[:, :3], tubes[:, 3:6], tubes[:, 6], tubes[:, 7]
        reach = np.linalg.norm(start, axis=1) + radius + length
        # The line of the axis by its direction, whichever way, and its point nearest to the origin.
        axis = axis * np.copysign(1, axis[np.arange(len(axis)), np.abs(axis).argmax(1)])[:, None]
        nearest = start - (start * axis).sum(1, keepdims=True) * axis
        keys = np.concatenate([axis * reach.max(), nearest, radius[:, None]], 1)
        return coincident.margins_of_alike(keys, reach, dtype)

    def intersect(self, leaf, prepared, start):
        """Across the axis, where it is a circle, as spheres are; then along it. The cylinder that the ray starts on has
        a root there that is exactly 0. The ends are inclusive by rounding, so that disks close them without a gap.
        """
        o, d = prepared
        block = at(self.leaves, leaf)
        numbers = numbers_of(block, d.dtype)
        axis, radius, length = numbers[3:6], numbers[6], numbers[7]
        f = [o[i] - numbers[i] for i in range(3)]
        height, rise = dot(f, axis), dot(d, axis)
        f_across = [f[i] - height * axis[i] for i in range(3)]
        d_across = [d[i] - rise * axis[i] for i in range(3)]
        speed = jnp.sqrt(dot(d_across, d_across))  # along the axis: 0, and every comparison below drops what follows
        e = [each / speed for each in d_across]
        b = -dot(f_across, e)
        closest = [f_across[i] + b * e[i] for i in range(3)]
        half_chord = jnp.sqrt(radius * radius - dot(closest, closest))  # NaN: a miss
        distance = jnp.sqrt(dot(f_across, f_across))
        rows = rows_of(block)
        c = jnp.where(rows == start, 0, (distance - radius) * (distance + radius))
        q = b + jnp.copysign(half_chord, b)
        other = c / q
        near, far = jnp.where(q < other, q, other) / speed, jnp.where(q < other, other, q) / speed
        error = (8 * np.finfo(d.dtype).eps) * (jnp.abs(height) + length)

        def meets(t):
            along = height + t * rise
            slack = error + (8 * np.finfo(d.dtype).eps) * jnp.abs(t * rise)
            return (t > 0) & (along >= -slack) & (along <= length + slack)

        return jnp.where(meets(near), near, jnp.where(meets(far), far, jnp.inf)), rows

    @property
    def count(self):
        return self.tubes.shape[0]

    def surface(self, row, o, d, t):
        """No margin but where two coincide."""
        tube = at(self.tubes, row)
        start, axis, radius, length = tube[:3], tube[3:6], tube[6], tube[7]
        f = o - start
        height, rise = dot(f, axis), dot(d, axis)
        f_across, d_across = f - height * axis, d - rise * axis
        speed = safe_sqrt(dot(d_across, d_across))
        e = d_across * safe_divide(1, speed)
        b = -dot(f_across, e)
        closest = f_across + b * e
        # t says which of the two roots was found.
        half_chord = jnp.copysign(safe_sqrt(radius * radius - dot(closest, closest)), t * speed - b)
        outward = normalize(closest + half_chord * e)
        along = jnp.clip(height + rise * safe_divide(b + half_chord, speed), 0, length)
        x, y = self._across(row, outward)
        n = outward * at(self.sign, row)
        margin = jnp.zeros_like(radius) if self.margins is None else at(self.margins, row)
        uv = jnp.stack([turns(y, x), along / length])
        return Surface(start + along * axis + radius * outward, n, margin, n, uv)

    def _across(self, row, v):
        x, y = at(self.across, row)
        return dot(x, v), dot(y, v)

    def along_u(self, row, surface):
        x, y = at(self.across, row)
        outward = surface.n * at(self.sign, row)
        return dot(x, outward) * y - dot(y, outward) * x

    def sample(self, row, u):
        return self.from_square(row, u)

    def sample_lamp(self, lamps, lamp, ref, u, u_part):
        """Draw as for any lamp; of an inner wall only what is seen through the ends: a shadow ray passes its lamp."""
        drawn = super().sample_lamp(lamps, lamp, ref, u, u_part)
        tube = at(self.tubes, drawn.primitive)
        start, axis, radius, length = tube[:3], tube[3:6], tube[6], tube[7]
        rise = dot(drawn.d, axis)
        outward = drawn.n * at(self.sign, drawn.primitive)
        # How far back along the ray the wall is met again; as far as `ref`, or farther, where that lies inside.
        chord = safe_divide(2 * radius * dot(drawn.d, outward), 1 - rise * rise)
        along = dot(ref - start, axis) + (drawn.distance - chord) * rise
        enters = (chord > 0) & (chord < drawn.distance * (1 - CLEAR)) & (along > 0) & (along < length)
        return drawn._replace(pdf=jnp.where(enters, 0, drawn.pdf))

    def areas(self):
        return _areas(np.asarray(self.tubes, float))

    def cell_lengths(self, size):
        tubes = np.asarray(self.tubes, float)
        return np.stack([2 * math.pi * tubes[:, 6], tubes[:, 7]], -1)

    def to_square(self, row, p):
        tube = at(self.tubes, row)
        q = p - tube[:3]
        x, y = self._across(row, q)
        return jnp.stack([turns(y, x), dot(q, tube[3:6]) / tube[7]])

    def from_square(self, row, xy):
        tube, (x, y) = at(self.tubes, row), at(self.across, row)
        start, axis, radius, length = tube[:3], tube[3:6], tube[6], tube[7]
        cos, sin = cos_sin_turns(xy[0])
        outward = cos * x + sin * y
        n = outward * at(self.sign, row)
        reach = jnp.abs(start) + radius + length
        p = start + (xy[1] * length) * axis + radius * outward
        return p, n, dot(jnp.abs(n), reach) * (4 * jnp.finfo(radius.dtype).eps)


@dataclass(frozen=True)
class Cylinder(Shape):
    to_world: np.ndarray  # (4, 4) carries the unit circles around the z axis at z = 0 and at z = 1 to the two ends
    table = Cylinders

    @classmethod
    def read(cls, loader, fields: Fields):
        p0, p1 = fields.point("p0", np.zeros(3)), fields.point("p1", np.array([0.0, 0.0, 1.0]))
        radius = fields.float("radius", 1.0, above=0)
        length = np.linalg.norm(p1 - p0)
        if not 0 < length < 3e38:
            raise fields.error("p1", "is where p0 is; the two are the ends of the axis")
        axis = (p1 - p0) / length
        # The frame that Mitsuba takes, so that u begins where it does.
        sign = math.copysign(1, axis[2])
        s = [1 - sign * axis[0] ** 2 / (sign + axis[2]), -sign * axis[0] * axis[1] / (sign + axis[2]), -sign * axis[0]]
        local = np.eye(4)
        local[:3] = np.stack([radius * np.array(s), radius * np.cross(axis, s), p1 - p0, p0], axis=1)
        made = cls.of(fields.transform("to_world") @ local)
        if made is None:
            raise fields.error("to_world", "scales unevenly across the axis or shears; a cylinder must stay round")
        return made

    @classmethod
    def of(cls, to_world: np.ndarray) -> Cylinder | None:
        """What the unit cylinder becomes, if it is round and its axis upright."""
        x, y, z = to_world[:3, :3].T
        with np.errstate(all="ignore"):
            radius, length = np.linalg.norm(x), np.linalg.norm(z)
            unit = np.stack([x / radius, y / radius, z / length])
            round_enough = np.allclose(unit @ unit.T, np.eye(3), atol=ROUND)
            sizes = np.float32([radius, length])
        return cls(to_world) if round_enough and (sizes > 0).all() and (sizes < np.inf).all() else None

    def placed(self, to_world):
        return self.of(to_world @ self.to_world)

    def primitives(self, flip):
        x, y, z, start = self.to_world[:3].T
        radius, length = np.linalg.norm(x), np.linalg.norm(z)
        tubes = np.concatenate([start, z / length, [radius, length]])[None]
        return Tube(tubes, np.stack([x / radius, y / radius])[None], np.array([-1.0 if flip else 1.0]))


def bounds(tubes):
    """(P, 8) -> two (P, 3)."""
    one, axis, radius, length = tubes[:, :3], tubes[:, 3:6], tubes[:, 6:7], tubes[:, 7:]
    other = one + length * axis
    reach = radius * np.sqrt(np.maximum(1 - axis**2, 0))
    return np.minimum(one, other) - reach, np.maximum(one, other) + reach


def _areas(tubes):
    return 2 * math.pi * tubes[:, 6] * tubes[:, 7]
