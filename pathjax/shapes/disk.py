"""Disks, ellipses where scaled unevenly or sheared."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from pathjax.compile import register_dataclass
from pathjax.core.math import at, cos_sin_turns, safe_sqrt, turns
from pathjax.core.warp import square_to_disk
from pathjax.shapes.planar import Planar, PlanarShape


@register_dataclass
@dataclass(frozen=True)
class Disks(Planar):
    kind = "disk"
    unit_area = math.pi

    @staticmethod
    def reach(a, b):
        return np.sqrt(a**2 + b**2)

    @staticmethod
    def inside(x, y, reach):
        return x * x + y * y <= reach * reach

    @staticmethod
    def uv(x, y):
        return jnp.stack([safe_sqrt(x * x + y * y), turns(y, x)])

    def along_u(self, row, surface):
        return surface.p - at(self.frames, row, 0)

    @staticmethod
    def square(x, y):
        return jnp.stack([x * x + y * y, turns(y, x)])

    @staticmethod
    def from_unit_square(u):
        return square_to_disk(u)

    def cell_lengths(self, size):
        area = self.areas()
        rings = np.maximum(np.rint(np.sqrt(area / math.pi) / size), 1)
        return np.stack([rings * size, area / (rings * size)], -1)

    def from_square(self, row, xy):
        return self.point(row, safe_sqrt(xy[0]) * jnp.stack(cos_sin_turns(xy[1])))


class Disk(PlanarShape):
    """Unit disk in the xy plane, normal +z, transformed by `to_world`."""

    table = Disks
