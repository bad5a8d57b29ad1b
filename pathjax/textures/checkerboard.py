"""Two colours in squares of half a unit of uv, as Mitsuba's `checkerboard` has them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax.core.types import Surface
from pathjax.kinds import Color, Row
from pathjax.textures.texture import Texture


class Checkerboard(Texture):
    """Squares of two colours; the first one lies at uv = (0, 0)."""

    color0 = Color(0.4)
    color1 = Color(0.2)

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        return jnp.where(_first(uv), p.color0, p.color1)

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        first = _first(uv).astype(uv.dtype)
        return [("color0", None, first), ("color1", None, 1 - first)]


def _first(uv):
    """Whether the square has the first colour."""
    odd = uv - jnp.floor(uv) > 0.5
    return odd[0] == odd[1]
