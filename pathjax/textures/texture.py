"""Colours over uv: bitmaps and checkerboards."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.core.math import at

WRAPS = ("repeat", "mirror", "clamp")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bitmaps:
    texels: jax.Array  # (N, 3), all images one after another, rows from the top
    first: jax.Array  # (T,) int32 first texel
    size: jax.Array  # (T, 2) int32 height, width; 0: this row is no bitmap
    nearest: jax.Array  # (T,) bool, no interpolation
    wrap: jax.Array  # (T,) int32 into WRAPS


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Textures:
    to_uv: jax.Array  # (T, 2, 3) applied to (u, v, 1)
    colors: jax.Array | None  # (T, 2, 3) color0, color1; None: no checkerboard in the scene
    bitmaps: Bitmaps | None  # None: no bitmap in the scene


def lookup(table: Textures, row, uv):
    """(3,) colour of texture `row` at uv (2,)."""
    m = at(table.to_uv, row)
    uv = m[:, 0] * uv[0] + m[:, 1] * uv[1] + m[:, 2]

    def checkerboard():
        odd = uv - jnp.floor(uv) > 0.5
        colors = at(table.colors, row)
        return jnp.where(odd[0] == odd[1], colors[0], colors[1])

    if table.bitmaps is None:
        return checkerboard()
    if table.colors is None:
        return _bitmap(table.bitmaps, row, uv)
    is_bitmap = at(table.bitmaps.size, row, 0) > 0
    return lax.cond(is_bitmap, lambda: _bitmap(table.bitmaps, row, uv), checkerboard)


def _bitmap(table: Bitmaps, row, uv):
    size = at(table.size, row)
    vu = jnp.stack([uv[1], uv[0]])
    nearest = at(table.nearest, row)
    # Texel centres lie at (i + 1/2) / size.
    place = vu * size - jnp.where(nearest, 0, jnp.asarray(0.5, uv.dtype))
    low = jnp.floor(place)
    fraction = jnp.where(nearest, 0, place - low)
    low = low.astype(jnp.int32)

    def texel(i, j):
        y, x = _wrapped(low + jnp.array([i, j], jnp.int32), size, at(table.wrap, row))
        return at(table.texels, at(table.first, row) + y * size[1] + x)

    top = texel(0, 0) * (1 - fraction[1]) + texel(0, 1) * fraction[1]
    bottom = texel(1, 0) * (1 - fraction[1]) + texel(1, 1) * fraction[1]
    return top * (1 - fraction[0]) + bottom * fraction[0]


def _wrapped(index, size, wrap):
    size = jnp.maximum(size, 1)
    repeat = jnp.mod(index, size)
    twice = jnp.mod(index, 2 * size)
    mirror = jnp.where(twice < size, twice, 2 * size - 1 - twice)
    clamp = jnp.clip(index, 0, size - 1)
    return jnp.where(wrap == 0, repeat, jnp.where(wrap == 1, mirror, clamp))
