"""Two colours in squares of half a unit of uv, as Mitsuba's `checkerboard` has them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.types import Surface
from pathjax.kinds import Color, Row
from pathjax.textures.texture import Texture


class Checkerboard(Texture):
    """Squares of two colours; the first one lies at uv = (0, 0)."""

    color0 = Color(0.4, textured=False)
    color1 = Color(0.2, textured=False)

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        odd = uv - jnp.floor(uv) > 0.5
        return jnp.where(odd[0] == odd[1], p.color0, p.color1)
