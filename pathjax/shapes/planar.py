"""Common base of rectangles and disks: a plane with two coordinates.

A point of the plane is c + x a + y b; the shape is |x|, |y| <= 1 for a rectangle (a parallelogram where sheared) and
x^2 + y^2 <= 1 for a disk (an ellipse). One test replaces the two triangles of a rectangle, and a disk is exact.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.core.math import at, dot, safe_divide
from pathjax.core.types import Surface
from pathjax.description.fields import Fields
from pathjax.shapes.accel.leaves import numbers_of, pack, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.coincident import Faces
from pathjax.shapes.shape import Primitives, Searched, Shape, Table

# The frame, as in `Frames`, of [-1, 1]^2 in the xy plane, or of the disk in it.
FLAT = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]], float)


@dataclass
class Frames(Primitives):
    frames: np.ndarray  # (F, 4, 3) centre, directions of u and v as long as half the sides, unit normal
    areas: np.ndarray  # (F,)
    found_by: ClassVar[type[Searched] | None] = None  # intersects several faces at once; None: one by one

    def depths(self):
        """Return the depths (F,) of the body that each face bounds; inf: the face is a sheet."""
        return np.full(len(self.frames), np.inf)

    def boxes(self):
        c, a, b, _ = np.moveaxis(self.frames, 1, 0)
        reach = np.abs(a) + np.abs(b)
        return c - reach, c + reach

    def facing(self):
        return self.frames[:, 3] * self.areas[:, None]

    def faces(self, glass, lamp, dtype):
        return Faces(corners(self.frames), self.frames[:, 3], self.depths(), glass, lamp)

    def move(self, moves):
        self.frames[:, 0] += moves


@dataclass(frozen=True)
class PlanarShape(Shape):
    to_world: np.ndarray  # (4, 4)
    local: ClassVar[np.ndarray] = FLAT
    made: ClassVar[type[Frames]] = Frames

    @classmethod
    def read(cls, loader, fields: Fields):
        return cls(fields.transform("to_world"))

    def placed(self, to_world):
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = to_world @ self.to_world
        return replace(self, to_world=matrix) if (np.abs(matrix) < 3e38).all() else None

    def primitives(self, flip):
        linear = self.to_world[:3, :3]
        points = self.local[:, :1] @ linear.T + self.to_world[:3, 3]
        directions = self.local[:, 1:3] @ linear.T
        normals = self.local[:, 3:] @ np.linalg.inv(linear)
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True) * (-1 if flip else 1)
        frames = np.concatenate([points, directions, normals], 1)
        return self.made(frames, self.table.areas_of(frames))


@dataclass(frozen=True)
class Planar(Table):
    leaves: jax.Array  # of `leaf_numbers`
    tree: Tree | None
    frames: jax.Array  # (P, 4, 3): c, a, b, unit normal
    margins: jax.Array | None  # (P,) of `coincident`; None: no other primitive coincides with any of these
    more: Searched | None  # intersects the last primitives, which `leaves` lacks; None: `leaves` has all

    unit_area: ClassVar[float]  # area if a and b are unit and orthogonal

    @classmethod
    def build(cls, parts, lit, dtype, rule, margins):
        frames = np.concatenate([part.frames for part in parts])
        single = sum(len(part.frames) for part in parts if part.found_by is None)
        alone, faces = frames[:single], frames[single:]
        packed, tree, built = pack(leaf_numbers(alone), *cls.bounds(alone), dtype, rule)
        more, trees = None, {cls.kind: built}
        if len(faces):
            finder = parts[-1].found_by
            more, trees[finder.kind] = finder.build(faces, single, dtype, rule)
        return cls(packed, tree, np.asarray(frames, dtype), margins, more), trees

    @classmethod
    def bounds(cls, frames):
        """Return the bounds, two (P, 3), of frames (P, 4, 3)."""
        c, a, b, _ = np.moveaxis(frames, 1, 0)
        reach = cls.reach(a, b)
        return c - reach, c + reach

    @staticmethod
    @abstractmethod
    def reach(a, b):
        """Return the extents (P, 3) from the centre to the bounds."""

    @classmethod
    def areas_of(cls, frames):
        return np.linalg.norm(np.cross(frames[:, 1], frames[:, 2]), axis=-1) * cls.unit_area

    def areas(self):
        return self.areas_of(np.asarray(self.frames, float))

    def searched(self):
        return super().searched() + ([] if self.more is None else [self.more])

    def intersect(self, leaf, prepared, start):
        """Include the border up to the rounding error of a coordinate, so that faces sharing an edge leave no gap."""
        o, d = prepared
        block = at(self.leaves, leaf)
        leaf = numbers_of(block, d.dtype)
        c, n, dual_a, dual_b, error = leaf[0:3], leaf[3:6], leaf[6:9], leaf[9:12], leaf[12:14]
        to_c = [c[axis] - o[axis] for axis in range(3)]
        t = dot(n, to_c) / dot(n, d)
        p = [t * d[axis] - to_c[axis] for axis in range(3)]
        x, y = dot(dual_a, p), dot(dual_b, p)
        error = error * (4 * np.finfo(leaf.dtype).eps)
        inside = self.inside(x, y, (1 + error[0]) + t * error[1])
        rows = rows_of(block)
        return jnp.where(inside & (rows != start), t, jnp.inf), rows

    @staticmethod
    @abstractmethod
    def inside(x, y, reach):
        """Return (W,) bool: whether the point (x, y) lies in the shape scaled by reach, which is 1 plus rounding."""

    @property
    def count(self):
        return self.frames.shape[0]

    def surface(self, row, o, d, t):
        """Compute the surface at t.

        The margin is 0 if nothing else lies in the plane: the primitive is excluded by index, and its few neighbours
        err only within rounding of the shared edge. So a sheet of glass may be as thin as coordinates can represent.
        """
        c, a, b, n = at(self.frames, row)
        from_c = o - c
        distance = -safe_divide(dot(n, from_c), dot(n, d))
        q = from_c + distance * d
        p = c + (q - dot(n, q) * n)
        margin = jnp.zeros_like(distance) if self.margins is None else at(self.margins, row)
        return Surface(p, n, margin, n, self.uv(*_coordinates(q, a, b)))

    @staticmethod
    @abstractmethod
    def uv(x, y):
        """Return uv (2,) of the point (x, y)."""

    @staticmethod
    @abstractmethod
    def from_unit_square(u):
        """Map uniform u (2,) to coordinates x, y (2,) that are uniform in area."""

    def sample(self, row, u):
        return self.point(row, self.from_unit_square(u))

    def point(self, row, xy):
        """Return the point (3,) of coordinates xy (2,), the normal (3,), and the rounding error along it ()."""
        c, a, b, n = at(self.frames, row)
        margin = dot(jnp.abs(n), jnp.abs(c) + jnp.abs(a) + jnp.abs(b)) * (4 * np.finfo(c.dtype).eps)
        return c + xy[0] * a + xy[1] * b, n, margin

    def to_square(self, row, p):
        c, a, b, _ = at(self.frames, row)
        return self.square(*_coordinates(p - c, a, b))

    @staticmethod
    @abstractmethod
    def square(x, y):
        """Map x, y to coordinates (2,) in [0, 1] that preserve area ratios."""


def _coordinates(q, a, b):
    """Return x and y of q = x a + y b."""
    aa, ab, bb = dot(a, a), dot(a, b), dot(b, b)
    qa, qb = dot(q, a), dot(q, b)
    scale = 1 / (aa * bb - ab * ab)
    return (bb * qa - ab * qb) * scale, (aa * qb - ab * qa) * scale


def leaf_numbers(frames):
    """Return (P, 14) from frames (P, 4, 3) float64: c, normal, duals of a and b, bound on the rounding of x and y."""
    c, a, b, n = np.moveaxis(np.asarray(frames, np.float64), 1, 0)
    normal = np.cross(a, b)
    squared = (normal**2).sum(-1, keepdims=True)
    dual_a, dual_b = np.cross(b, normal) / squared, np.cross(normal, a) / squared
    # A coordinate is computed from c - o and t d, whose lengths differ by at most the radius: its error is bounded by
    # |dual| (2 t + radius) roundings.
    radius = np.sqrt((a**2).sum(-1) + (b**2).sum(-1))
    slope_a, slope_b = np.sqrt((dual_a**2).sum(-1)), np.sqrt((dual_b**2).sum(-1))
    slope = np.maximum(slope_a, slope_b)
    return np.concatenate([c, n, dual_a, dual_b, np.stack([slope * radius, 2 * slope], -1)], -1)


def corners(frames):
    """Return the corners (P, 4, 3) of the rectangle, or of that around the disk, for frames (P, 4, 3)."""
    c, a, b, _ = np.moveaxis(frames, 1, 0)
    return np.stack([c - a - b, c + a - b, c + a + b, c - a + b], 1)
