"""Round primitives with an object space in which their radius is 1, mapped to the world by any affine map."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import compute_once
from pathjax.core.math import at, dot, normalize, safe_divide, safe_sqrt
from pathjax.core.types import Surface
from pathjax.shapes import coincident
from pathjax.shapes.accel.leaves import numbers_of, pack, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.shape import Primitives, Table


@dataclass
class Placed(Primitives):
    to_world: np.ndarray  # (1, 3, 4) from object space
    sign: np.ndarray  # (1,)
    table: type[Carried]

    @property
    def count(self):
        return len(self.sign)

    @property
    def areas(self):
        return self.table.areas_of(self.to_world)

    def boxes(self):
        return self.table.bounds(self.to_world)


@dataclass(frozen=True)
class Carried(Table):
    """Primitives that are intersected, and whose points and normals are computed, in object space; t is the same there.

    The first `axes_across` coordinates span the round cross-section.
    """

    leaves: jax.Array  # the origin of object space, and `duals`
    tree: Tree | None
    to_world: jax.Array  # (P, 3, 4) from object space
    duals: jax.Array  # (P, 3, 3) to object space: the inverse of the linear part
    sign: jax.Array  # (P,) -1 where the normal points inwards
    margins: jax.Array | None  # (P,) of `coincident`; None: no two of these primitives coincide

    axes_across: ClassVar[int]

    @classmethod
    def build(cls, parts, lit, dtype, rule, margins):
        to_world, sign = (np.concatenate([getattr(part, name) for part in parts]) for name in ("to_world", "sign"))
        duals = np.linalg.inv(to_world[:, :, :3])
        numbers = np.concatenate([to_world[:, :, 3], duals.reshape(-1, 9)], 1)
        packed, tree, built = pack(numbers, *cls.bounds(to_world), dtype, rule)
        rows = (np.asarray(x, dtype) for x in (to_world, duals, sign))
        return cls(packed, tree, *rows, margins), {cls.kind: built}

    @classmethod
    def own_margins(cls, parts, dtype):
        """Return margins (P,): 0 for primitives that coincide with no other one."""
        to_world = np.concatenate([part.to_world for part in parts])
        where, across = cls.where(to_world)
        directions, sizes, _ = np.linalg.svd(across, full_matrices=False)
        shape = (directions * sizes[:, None]) @ directions.swapaxes(1, 2)  # independent of rotations of object space
        low, high = cls.bounds(to_world)
        reach = np.linalg.norm(np.maximum(np.abs(low), np.abs(high)), axis=1)
        return coincident.margins_of_alike(np.concatenate([where, shape.reshape(-1, 9)], 1), reach, dtype)

    # ---- defined by each kind

    @classmethod
    @abstractmethod
    def bounds(cls, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds, two (P, 3), for to_world (P, 3, 4)."""

    @classmethod
    @abstractmethod
    def where(cls, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return keys (P, K), equal for primitives that may coincide, and the axes across (P, 3, A)."""

    @classmethod
    def areas_of(cls, to_world: np.ndarray) -> np.ndarray:
        """Return the areas (P,) for to_world (P, 3, 4). Only kinds that may be lamps implement it."""
        raise NotImplementedError

    @staticmethod
    @abstractmethod
    def meets(t, f, d):
        """Return whether the ray f + t d in object space is on the primitive at t, a root of its round surface."""

    @staticmethod
    @abstractmethod
    def on(outward, along):
        """Return the point in object space; outward: (A,) unit; along: () the third coordinate, where A is 2."""

    @staticmethod
    @abstractmethod
    def uv(local): ...

    # ---- one ray

    def intersect(self, leaf, prepared, start):
        """Intersect as spheres do (see `sphere`), in object space. The primitive of the start has a root exactly 0."""
        block = at(self.leaves, leaf)
        numbers = numbers_of(block, prepared[0].dtype)
        o, d = prepared
        from_origin = [o[i] - numbers[i] for i in range(3)]
        f, d = ([dot(numbers[3 + 3 * i : 6 + 3 * i], v) for i in range(3)] for v in (from_origin, d))
        f_across, d_across = f[: self.axes_across], d[: self.axes_across]
        speed = jnp.sqrt(_squared(d_across))  # 0 along a cylinder: comparisons drop the inf and NaN that follow
        e = [each / speed for each in d_across]
        b = -_product(f_across, e)
        closest = [each + b * along for each, along in zip(f_across, e, strict=True)]
        half_chord = jnp.sqrt(1 - _squared(closest))  # NaN: a miss
        distance = jnp.sqrt(_squared(f_across))
        rows = rows_of(block)
        c = jnp.where(rows == start, 0, (distance - 1) * (distance + 1))
        q = b + jnp.copysign(half_chord, b)
        other = c / q
        near, far = jnp.where(q < other, q, other) / speed, jnp.where(q < other, other, q) / speed
        met = [jnp.where(self.meets(t, f, d), t, jnp.inf) for t in (near, far)]
        return jnp.where(met[0] < jnp.inf, met[0], met[1]), rows

    @property
    def count(self):
        return self.sign.shape[0]

    def surface(self, row, o, d, t):
        """Compute the surface at t; the margin is 0 unless primitives coincide."""
        f, d = self.local(row, o), at(self.duals, row) @ d
        f_across, d_across = f[: self.axes_across], d[: self.axes_across]
        speed = safe_sqrt(_squared(d_across))
        e = d_across * safe_divide(1, speed)
        b = -_product(f_across, e)
        closest = f_across + b * e
        # t tells which of the two roots was hit.
        half_chord = jnp.copysign(safe_sqrt(1 - _squared(closest)), t * speed - b)
        outward = closest + half_chord * e
        outward = compute_once(outward * safe_divide(1, safe_sqrt(_squared(outward))))
        local = compute_once(self.on(outward, f[2] + d[2] * safe_divide(b + half_chord, speed)))
        n = self.normal(row, outward)
        margin = jnp.zeros_like(t) if self.margins is None else at(self.margins, row)
        return Surface(self.point(row, local), n, margin, n, self.uv(local))

    def local(self, row, p):
        """Transform a point from the world to object space."""
        return at(self.duals, row) @ (p - at(self.to_world, row)[:, 3])

    def point(self, row, local):
        to_world = at(self.to_world, row)
        return to_world[:, 3] + to_world[:, :3] @ local

    def normal(self, row, outward):
        """Return the unit normal in the world; outward: (A,) in object space."""
        return normalize(outward @ at(self.duals, row)[: self.axes_across]) * at(self.sign, row)

    def along_u(self, row, surface):
        local, axes = self.local(row, surface.p), at(self.to_world, row)
        return local[0] * axes[:, 1] - local[1] * axes[:, 0]


def _product(a, b):
    """Return the scalar product of two or three components."""
    return sum(a[i] * b[i] for i in range(1, len(a))) + a[0] * b[0]


def _squared(v):
    return _product(v, v)


def invertible(to_world: np.ndarray) -> bool:
    """Return whether kernels can invert to_world (4, 4) beyond rounding error, whatever the lengths of its axes."""
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(to_world[:3, :3], axis=0)
        sizes = np.float32(lengths)
        if not ((sizes > 0) & (sizes < np.inf)).all():
            return False
        return bool(np.linalg.cond(to_world[:3, :3] / lengths) < 1 / np.finfo(np.float32).eps)
