"""Ellipsoids, which instances make of spheres if they scale unevenly or shear."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from pathjax.compile import register_dataclass
from pathjax.core.math import safe_atan2, safe_sqrt, turns
from pathjax.shapes.carried import Carried, Placed, invertible
from pathjax.shapes.shape import Shape


@register_dataclass
@dataclass(frozen=True)
class Ellipsoids(Carried):
    """Ellipsoids; in object space they are the unit sphere."""

    kind = "ellipsoid"
    axes_across = 3

    @classmethod
    def bounds(cls, to_world):
        reach = np.linalg.norm(to_world[:, :, :3], axis=2)
        return to_world[:, :, 3] - reach, to_world[:, :, 3] + reach

    @classmethod
    def where(cls, to_world):
        return to_world[:, :, 3], to_world[:, :, :3]

    @staticmethod
    def meets(t, f, d):
        return t > 0

    @staticmethod
    def on(outward, along):
        return outward

    @staticmethod
    def uv(local):
        theta = safe_atan2(safe_sqrt(local[0] * local[0] + local[1] * local[1]), local[2]) / math.pi
        return jnp.stack([turns(local[1], local[0]), theta])

    def even(self):
        return np.zeros(self.count, bool)


@dataclass(frozen=True)
class Ellipsoid(Shape):
    """A unit sphere transformed by `to_world`. No scene file names it."""

    to_world: np.ndarray  # (4, 4)
    table = Ellipsoids
    closed = True

    @classmethod
    def of(cls, to_world: np.ndarray) -> Ellipsoid | None:
        return cls(to_world) if invertible(to_world) else None

    @classmethod
    def read(cls, loader, fields):
        raise NotImplementedError

    def placed(self, to_world):
        return self.of(to_world @ self.to_world)

    def primitives(self, flip):
        return Placed(self.to_world[None, :3], np.array([-1.0 if flip else 1.0]), Ellipsoids)
