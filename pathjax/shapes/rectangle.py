"""Rectangles, parallelograms where sheared."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from pathjax.compile import register_dataclass
from pathjax.core.math import at, larger
from pathjax.kinds import Unused
from pathjax.shapes.planar import Planar, PlanarShape


@register_dataclass
@dataclass(frozen=True)
class Rectangles(Planar):
    kind = "rectangle"
    polygons = True
    unit_area = 4

    @staticmethod
    def reach(a, b):
        return np.abs(a) + np.abs(b)

    @staticmethod
    def inside(x, y, reach):
        return larger(jnp.abs(x), jnp.abs(y)) <= reach

    @staticmethod
    def uv(x, y):
        return jnp.stack([(x + 1) / 2, (y + 1) / 2])

    square = uv

    def along_u(self, row, surface):
        return at(self.frames, row, 1)

    @staticmethod
    def from_unit_square(u):
        return 2 * u - 1

    def cell_lengths(self, size):
        return 2 * np.linalg.norm(np.asarray(self.frames, float)[:, 1:3], axis=-1)

    def from_square(self, row, xy):
        return self.sample(row, xy)

    def edges_and_normals(self):
        c, a, b, n = np.moveaxis(np.asarray(self.frames, float), 1, 0)
        return np.stack([c - a - b, 2 * a, 2 * b], 1), n


class Rectangle(PlanarShape):
    """[-1, 1]^2 in the xy plane, normal +z, transformed by `to_world`."""

    unused = PlanarShape.unused | {"face_normals": Unused("boolean")}  # Mitsuba makes a mesh of it
    table = Rectangles
