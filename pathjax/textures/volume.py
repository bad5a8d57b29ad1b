"""Volumes as textures: a point of a surface has the value of the volume there."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.compile import compute_once
from pathjax.core.math import at
from pathjax.core.types import Surface
from pathjax.kinds import Column, Parameter, PerRow, Row, Shared, Table
from pathjax.textures.bitmap import WRAPS, wrapped
from pathjax.textures.texture import Texture


class Volume(Texture):
    """A grid of values in world space. An `Instance` holds `volume`, a `media.GridVolume`."""

    volume = Shared(by_number=True)  # (N, 3) cells of all grids one after another, x running fastest
    first = PerRow()  # () int32 index of the first cell
    size = PerRow()  # (3,) int32 cells along x, y, z
    to_grid = PerRow()  # (3, 4) from world space to cell coordinates; the centre of cell i is at i
    nearest = PerRow()  # () bool, no interpolation
    wrap = PerRow()  # () int32 index into WRAPS
    over_uv = False

    @classmethod
    def read(cls, loader, fields, name):
        return cls.instance(name, volume=loader.volume(fields, "volume", 0.75))

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        volumes = [instance.values["volume"] for instance in instances]
        cells = [np.broadcast_to(volume.data, (*volume.data.shape[:3], 3)).reshape(-1, 3) for volume in volumes]
        first = np.cumsum([0, *map(len, cells[:-1])])
        columns = {
            "volume": np.asarray(np.concatenate(cells), dtype),
            "first": np.asarray(first, np.int32),
            "size": np.asarray([volume.data.shape[2::-1] for volume in volumes], np.int32),
            "to_grid": np.asarray([volume.to_grid for volume in volumes], dtype),
            "nearest": np.asarray([volume.nearest for volume in volumes]),
            "wrap": np.asarray([WRAPS.index(volume.wrap) for volume in volumes], np.int32),
        }
        where = (*path, "columns", cls.place("volume"), "values")
        for instance, volume, start in zip(instances, volumes, first.tolist(), strict=True):
            if volume.listed:
                shape = (*volume.data.shape[:3], 3)
                cells_of_it = math.prod(shape[:3])
                parameters.textures[instance] = Parameter(where, (start,), shape, (0, math.inf), rows=cells_of_it)
        values = (columns.get(key) for key in cls.declared)
        return Table(tuple(None if x is None else Column(x) for x in values), cls)

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        return Volume.with_entries(p, uv, surface)[0]

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        return Volume.with_entries(p, uv, surface)[1]

    @classmethod
    def with_entries(cls, p, uv, surface):
        corners = _corners(p, surface)
        color = sum(at(p.volume, number) * share for number, share in corners)
        return color, [("volume", number, share) for number, share in corners]

    @classmethod
    def span(cls, texture):
        data = texture.values["volume"].data
        return float(data.min()), float(data.max())

    @classmethod
    def refused(cls, name):
        return {name: f"{name} is a volume that repeats or has one value, which is no parameter"}

    @classmethod
    def mean(cls, texture):
        """Return the mean of all cells: which part a surface meets is not known, but it is above 0 if any cell is."""
        data = texture.values["volume"].data
        return np.broadcast_to(data, (*data.shape[:3], 3)).mean((0, 1, 2), dtype=np.float64)


def _corners(p: Row, surface: Surface):
    """Return the indices of the eight cells around a point, each with its weight."""
    m = p.to_grid
    place = m[:, :3] @ surface.p + m[:, 3] + jnp.where(p.nearest, jnp.asarray(0.5, m.dtype), 0)
    low = jnp.floor(place)
    share = jnp.where(p.nearest, 0, place - low)
    ends, share = compute_once(((wrapped(low, p.size, p.wrap), wrapped(low + 1, p.size, p.wrap)), share))
    found = []
    for number in range(8):
        bits = [number >> axis & 1 for axis in range(3)]
        x, y, z = (ends[bit][axis] for axis, bit in enumerate(bits))
        a, b, c = (share[axis] if bit else 1 - share[axis] for axis, bit in enumerate(bits))
        found.append((p.first + (z * p.size[1] + y) * p.size[0] + x, a * b * c))
    return found
