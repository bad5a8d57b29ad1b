"""Images over uv in [0, 1)^2; v points downwards, as in Mitsuba's loader."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.compile import compute_once
from pathjax.core.math import at
from pathjax.core.types import Surface
from pathjax.images import read_rgb
from pathjax.images.read import decoded
from pathjax.kinds import Column, Instance, Parameter, PerRow, Row, Shared, Table, Unused
from pathjax.textures.texture import Texture

WRAPS = ("repeat", "mirror", "clamp")
FILTERS = ("bilinear", "nearest")
# From here on float32 does not distinguish texels.
_FAR = 2.0**24


class Bitmap(Texture):
    """An image. An `Instance` holds `texels` (H, W, 3), linear, `to_uv`, `nearest` and `wrap`."""

    texels = Shared(by_number=True, wider=True)  # (N, 3), all images one after another, rows from the top
    first = PerRow()  # () int32 index of the first texel
    size = PerRow()  # (2,) int32 height, width
    nearest = PerRow()  # () bool, no interpolation
    wrap = PerRow()  # () int32 index into WRAPS
    unused: ClassVar[Mapping[str, Unused]] = {
        "accel": Unused("boolean"),
        "format": Unused("string", "texels have the precision of the scene", choices=("variant", "fp16", "auto")),
    }

    @classmethod
    def read(cls, loader, fields, name):
        raw, data = fields.boolean("raw", False), fields.array("data", None)
        texels = read_rgb(loader.find(fields, "filename"), raw) if data is None else texels_of(fields, data, raw)
        interpolation = fields.string("filter_type", "bilinear", choices=FILTERS)
        wrap = fields.string("wrap_mode", "repeat", choices=WRAPS)
        to_uv = cls.to_uv.read(loader, fields, "to_uv", name)
        return cls.instance(name, texels=texels, to_uv=to_uv, nearest=interpolation == "nearest", wrap=wrap)

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        def all_of(key):
            return [instance.values[key] for instance in instances]

        images = all_of("texels")
        counts = [image.shape[0] * image.shape[1] for image in images]
        columns = {
            "to_uv": np.asarray([np.eye(2, 3) if m is None else m for m in all_of("to_uv")], dtype),
            "texels": np.asarray(_joined([image.reshape(-1, 3) for image in images]), dtype),
            "first": np.asarray(np.cumsum([0, *counts[:-1]]), np.int32),
            "size": np.asarray([image.shape[:2] for image in images], np.int32),
            "nearest": np.asarray([bool(nearest) for nearest in all_of("nearest")]),
            "wrap": np.asarray([WRAPS.index(wrap or "repeat") for wrap in all_of("wrap")], np.int32),
        }
        where = (*path, "columns", cls.place("texels"), "values")
        for instance, image, first in zip(instances, images, columns["first"].tolist(), strict=True):
            rows = image.shape[0] * image.shape[1]
            parameters.textures[instance] = Parameter(where, (first,), image.shape, (0, math.inf), rows=rows)
        return Table(tuple(Column(columns[key]) for key in cls.declared), cls)

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        return _between(p, *_corners(p, uv))

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        return _entries(*_corners(p, uv))

    @classmethod
    def with_entries(cls, p, uv, surface):
        corners = _corners(p, uv)
        return _between(p, *corners), _entries(*corners)

    @classmethod
    def span(cls, texture: Instance) -> tuple[float, float]:
        return float(texture.values["texels"].min()), float(texture.values["texels"].max())

    @classmethod
    def mean(cls, texture):
        return texture.values["texels"].mean((0, 1), dtype=np.float64)

    @classmethod
    def resolution(cls, texture):
        return texture.values["texels"].shape[:2]


def _joined(arrays: list[np.ndarray]) -> np.ndarray:
    """Concatenate arrays; a single one is not copied, as it may be large."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def texels_of(fields, data: np.ndarray, raw: bool) -> np.ndarray:
    """Return an array as (H, W, 3) float32: bytes and 16-bit integers are encoded as in a PNG, floats are linear."""
    if fields.has("filename"):
        raise fields.error("data", "excludes filename; give one or the other")
    if data.ndim not in (2, 3) or data.ndim == 3 and data.shape[2] not in (1, 3) or 0 in data.shape:
        raise fields.error("data", f"must have the shape (H, W), (H, W, 1) or (H, W, 3), has {data.shape}")
    colors = np.broadcast_to(data.reshape(*data.shape[:2], -1), (*data.shape[:2], 3))
    if data.dtype in (np.uint8, np.uint16):
        return decoded(colors, raw)
    return np.asarray(colors, np.float32)


def _corners(p, uv):
    """Return (0 or 1 down, 0 or 1 right) -> index of a texel around a point; and the position (2,) between texels."""
    size = p.size
    vu = jnp.stack([uv[1], uv[0]])
    # Texel centres lie at (i + 1/2) / size.
    place = compute_once(vu * size - jnp.where(p.nearest, 0, jnp.asarray(0.5, uv.dtype)))
    low = jnp.floor(place)
    fraction = jnp.where(p.nearest, 0, place - low)
    # Twelve numbers are read at these indices.
    corners = wrapped(low, size, p.wrap), wrapped(low + 1, size, p.wrap)
    corners, fraction = compute_once((corners, fraction))

    def index(i, j):
        return p.first + corners[i][0] * size[1] + corners[j][1]

    return index, fraction


def _between(p, index, fraction):
    def texel(i, j):
        return at(p.texels, index(i, j))[:3]

    top = texel(0, 0) * (1 - fraction[1]) + texel(0, 1) * fraction[1]
    bottom = texel(1, 0) * (1 - fraction[1]) + texel(1, 1) * fraction[1]
    return top * (1 - fraction[0]) + bottom * fraction[0]


def _entries(index, fraction):
    shares = [[1 - part, part] for part in fraction]
    return [("texels", index(i, j), shares[0][i] * shares[1][j]) for i in (0, 1) for j in (0, 1)]


def wrapped(low, size, wrap):
    """Return row and column (2,) int32 in the image, or indices along three axes. low: any integers, as floats."""
    size = jnp.maximum(size, 1)
    folded = _modulo(low, jnp.where(wrap == 1, 2 * size, size))
    folded = jnp.where(folded < size, folded, 2 * size - 1 - folded)
    return jnp.where(wrap == 2, jnp.clip(low.astype(jnp.int32), 0, size - 1), folded)


def _modulo(a, b):
    """Return a mod b, int32, for integers a and b > 0, without integer division, for which there is no SIMD."""
    a = jnp.where(jnp.abs(a) < _FAR, a, 0)
    quotient = jnp.floor(a / b.astype(a.dtype)).astype(jnp.int32)
    rest = a.astype(jnp.int32) - quotient * b  # by rounding of the quotient off by b, at most
    rest = jnp.where(rest < 0, rest + b, rest)
    return jnp.where(rest >= b, rest - b, rest)
