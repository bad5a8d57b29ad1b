"""Cubes (boxes, parallelepipeds where sheared): six rectangles that one test intersects.

Only the search is here; hits are rows of `Rectangles`. A ray that starts outside a cube enters through one of its
faces, a ray that starts inside or on it leaves through one, so its edges have no gaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import at, dot, larger, smaller
from pathjax.kinds import Unused
from pathjax.shapes.accel.leaves import numbers_of, pack, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.planar import Frames, PlanarShape
from pathjax.shapes.rectangle import Rectangles
from pathjax.shapes.shape import Searched

FACES = 6
# The faces of [-1, 1]^3 in the order of `Cubes`: centre, directions of u and v, normal; uv as in Mitsuba's cube.
_CUBE = np.array(
    [
        [[-1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -1], [1, 0, 0]],
        [[0, -1, 0], [0, 0, 1], [1, 0, 0], [0, -1, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 0, -1]],
        [[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 1]],
    ],
    float,
)


@register_dataclass
@dataclass(frozen=True)
class Cubes(Searched):
    """Cubes whose face at coordinate `axis` = -1 or 1 is their rectangle 2 axis + 0 or 1."""

    kind = "cube"

    leaves: jax.Array  # of `leaf_numbers`; the row is that of the first rectangle
    tree: Tree | None

    @classmethod
    def build(cls, frames, first, dtype, rule):
        """Build cubes from faces (6 B, 4, 3), which begin at row `first` of their table; also return the built tree."""
        *found, built = pack(leaf_numbers(frames), *bounds(frames), dtype, rule, first=first, step=FACES)
        return cls(*found), built

    def intersect(self, leaf, prepared, start):
        """Test the slabs between opposite faces, and return for each cube the face that the ray meets first."""
        o, d = prepared
        block = at(self.leaves, leaf)
        leaf, first = numbers_of(block, d.dtype), rows_of(block)
        from_c = [o[axis] - leaf[axis] for axis in range(3)]
        started = start - first
        x, inverse = [], []
        for axis in range(3):
            dual = leaf[3 + 3 * axis : 6 + 3 * axis]
            # On the face where the ray starts, its coordinate is known exactly, so the distance to it is exactly 0.
            exact = (2 * (started & 1) - 1).astype(leaf.dtype)
            x.append(jnp.where(started >> 1 == axis, exact, dot(dual, from_c)))
            inverse.append(1 / dot(dual, d))
        x, inverse = compute_once((x, inverse))
        end = [jnp.copysign(jnp.ones_like(i), i) for i in inverse]  # side of each slab through which the ray leaves
        near = [(-end[axis] - x[axis]) * inverse[axis] for axis in range(3)]
        far = [(end[axis] - x[axis]) * inverse[axis] for axis in range(3)]
        # If the ray lies in the boundary plane of a slab, one distance is NaN (0 / 0): a first argument drops out.
        enter, leave = jnp.full_like(near[0], -jnp.inf), jnp.full_like(far[0], jnp.inf)
        for axis in range(3):
            enter, leave = larger(near[axis], enter), smaller(far[axis], leave)
        # A box is convex: a ray that starts on its surface does not enter it from outside.
        outside = (enter > 0) & ((started < 0) | (started >= FACES))
        t = jnp.where(outside, enter, leave)
        by = [jnp.where(outside, near[axis], far[axis]) == t for axis in range(2)]
        leaves_by = [2 * axis + (inverse[axis] > 0).astype(jnp.int32) for axis in range(3)]
        face = jnp.where(by[0], leaves_by[0], jnp.where(by[1], leaves_by[1], leaves_by[2])) ^ outside.astype(jnp.int32)
        return jnp.where(enter <= leave, t, jnp.inf), first + face


class CubeFaces(Frames):
    found_by = Cubes

    def depths(self):
        """Return the distance of each face from the opposite one."""
        from_center = self.frames[:, 0] - np.repeat(_axes(self.frames)[0], FACES, 0)
        return np.abs(np.sum(self.frames[:, 3] * from_center, -1)) * 2


class Cube(PlanarShape):
    """[-1, 1]^3, normals outwards, transformed by `to_world`."""

    unused = PlanarShape.unused | {"face_normals": Unused("boolean")}  # Mitsuba makes a mesh of it
    table = Rectangles
    comes_last = closed = True
    local = _CUBE
    made = CubeFaces


def leaf_numbers(frames):
    """Return (B, 12) from frames (6 B, 4, 3) float64: center, and three vectors v with coordinates v . (p - center)."""
    center, axes = _axes(frames)
    return np.concatenate([center, np.linalg.inv(axes).swapaxes(1, 2).reshape(-1, 9)], -1)


def bounds(frames):
    """Return the bounds, two (B, 3), of frames (6 B, 4, 3)."""
    center, axes = _axes(frames)
    reach = np.abs(axes).sum(1)
    return center - reach, center + reach


def _axes(frames):
    """Return centers (B, 3) and half axes (B, 3, 3), as rows."""
    centers = frames[:, 0].reshape(-1, 3, 2, 3)  # cube, axis, end, xyz
    return centers.mean((1, 2)), (centers[:, :, 1] - centers[:, :, 0]) / 2
