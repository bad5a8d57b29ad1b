"""Round primitives carried from a space of their own, in which their radius is 1, by any linear map."""

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
    to_world: np.ndarray  # (1, 3, 4) from its own space
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
    """A primitive is met, and its point and normal are found, in its own space; distances are the same there.

    The first `axes_across` coordinates are of the round cross-section.
    """

    leaves: jax.Array  # of the origin of the own space, and of `duals`
    tree: Tree | None
    to_world: jax.Array  # (P, 3, 4) from the own space
    duals: jax.Array  # (P, 3, 3) to it: the inverse of the linear part
    sign: jax.Array  # (P,) -1 where the normal points inwards
    margins: jax.Array | None  # (P,) of `coincident`; None: no two of these coincide

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
        """0 for those that lie in no other one."""
        to_world = np.concatenate([part.to_world for part in parts])
        where, across = cls.where(to_world)
        directions, sizes, _ = np.linalg.svd(across, full_matrices=False)
        shape = (directions * sizes[:, None]) @ directions.swapaxes(1, 2)  # the same however the own space is turned
        low, high = cls.bounds(to_world)
        reach = np.linalg.norm(np.maximum(np.abs(low), np.abs(high)), axis=1)
        return coincident.margins_of_alike(np.concatenate([where, shape.reshape(-1, 9)], 1), reach, dtype)

    # ---- of each kind

    @classmethod
    @abstractmethod
    def bounds(cls, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(P, 3, 4) -> two (P, 3)."""

    @classmethod
    @abstractmethod
    def where(cls, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(P, 3, 4) -> the same numbers (P, K) for what may coincide, and the axes across (P, 3, A)."""

    @classmethod
    def areas_of(cls, to_world: np.ndarray) -> np.ndarray:
        """(P, 3, 4) -> (P,); of kinds that shine."""
        raise NotImplementedError

    @staticmethod
    @abstractmethod
    def meets(t, f, d):
        """Whether the ray from f along d, in the own space, is on the primitive at t, where it meets what is round."""

    @staticmethod
    @abstractmethod
    def on(outward, along):
        """The point in the own space; outward: (A,) unit; along: () beyond those coordinates."""

    @staticmethod
    @abstractmethod
    def uv(local): ...

    # ---- of a ray

    def intersect(self, leaf, prepared, start):
        """As spheres are (see `sphere`), in the own space. What the ray starts on has a root that is exactly 0."""
        block = at(self.leaves, leaf)
        numbers = numbers_of(block, prepared[0].dtype)
        o, d = prepared
        from_origin = [o[i] - numbers[i] for i in range(3)]
        f, d = ([dot(numbers[3 + 3 * i : 6 + 3 * i], v) for i in range(3)] for v in (from_origin, d))
        f_across, d_across = f[: self.axes_across], d[: self.axes_across]
        speed = jnp.sqrt(_squared(d_across))  # 0 along a cylinder: comparisons drop what follows
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
        """No margin but where two coincide."""
        f, d = self.local(row, o), at(self.duals, row) @ d
        f_across, d_across = f[: self.axes_across], d[: self.axes_across]
        speed = safe_sqrt(_squared(d_across))
        e = d_across * safe_divide(1, speed)
        b = -_product(f_across, e)
        closest = f_across + b * e
        # t says which of the two roots was found.
        half_chord = jnp.copysign(safe_sqrt(1 - _squared(closest)), t * speed - b)
        outward = closest + half_chord * e
        outward = compute_once(outward * safe_divide(1, safe_sqrt(_squared(outward))))
        local = compute_once(self.on(outward, f[2] + d[2] * safe_divide(b + half_chord, speed)))
        n = self.normal(row, outward)
        margin = jnp.zeros_like(t) if self.margins is None else at(self.margins, row)
        return Surface(self.point(row, local), n, margin, n, self.uv(local))

    def local(self, row, p):
        """A point of the world in the own space."""
        return at(self.duals, row) @ (p - at(self.to_world, row)[:, 3])

    def point(self, row, local):
        to_world = at(self.to_world, row)
        return to_world[:, 3] + to_world[:, :3] @ local

    def normal(self, row, outward):
        """Unit; outward: (A,) of the own space."""
        return normalize(outward @ at(self.duals, row)[: self.axes_across]) * at(self.sign, row)

    def along_u(self, row, surface):
        local, axes = self.local(row, surface.p), at(self.to_world, row)
        return local[0] * axes[:, 1] - local[1] * axes[:, 0]


def _product(a, b):
    """Scalar product of two or three components."""
    return sum(a[i] * b[i] for i in range(1, len(a))) + a[0] * b[0]


def _squared(v):
    return _product(v, v)


def invertible(to_world: np.ndarray) -> bool:
    """Whether the inverse of (4, 4) is more than rounding in kernels, whatever the lengths of its axes are."""
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(to_world[:3, :3], axis=0)
        sizes = np.float32(lengths)
        if not ((sizes > 0) & (sizes < np.inf)).all():
            return False
        return bool(np.linalg.cond(to_world[:3, :3] / lengths) < 1 / np.finfo(np.float32).eps)
