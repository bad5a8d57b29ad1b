"""The surface of a shape for sensors: uniform points of it."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.core.cumulated import cumulated, search
from pathjax.errors import InputError
from pathjax.shapes.shape import SurfacePoint, Table


@register_dataclass
@dataclass(frozen=True)
class Region:
    table: Table  # of this shape alone
    before: Float[Array, " N"]  # cumulated shares of the area before each primitive, and 1

    def sample(self, u: Float[Array, "2"]) -> SurfacePoint:
        """Sample a point, uniform in area."""
        u = jnp.clip(u, 0, float(1 - jnp.finfo(u.dtype).eps))
        row, across = search(self.before, 0, self.before.shape[0] - 1, u[0])
        return self.table.sample(row, jnp.stack([across, u[1]]))


def build(shape, dtype) -> Region:
    """Build the Region of a `description.Shape`."""
    table, _ = shape.geometry.table.build([shape.geometry.primitives(shape.flip_normals)], [False], dtype, "sah", None)
    if not table.even().all():
        what = f"shape {shape.name!r} is round and scaled unevenly"
        raise InputError(f"{what}; no points are drawn evenly on it, so give the sensor a mesh")
    return Region(table, np.asarray(cumulated(table.areas()), dtype))
