"""Two colours in squares of half a unit of uv, as in Mitsuba's `checkerboard`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.core.types import Surface
from pathjax.kinds import Color, Instance, Row
from pathjax.textures.texture import Texture


class Checkerboard(Texture):
    """Squares of two colours. At uv = (0, 0) is the first one, or the second one if it stands for a number."""

    color0 = Color(0.4)
    color1 = Color(0.2)

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        return jnp.where(_first(uv), p.color0, p.color1)

    @classmethod
    def of_number(cls, texture: Instance, held: Callable[[Instance], Instance]) -> Instance:
        """Return the board shifted by a square: Mitsuba's begins with `color1` here, and files rely on it."""
        values = {key: held(x) if isinstance(x, Instance) else x for key, x in texture.values.items()}
        to_uv = np.eye(2, 3) if values["to_uv"] is None else values["to_uv"]
        return replace(texture, values=values | {"to_uv": to_uv + np.array([[0, 0, 0.5], [0, 0, 0]])})

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        first = _first(uv).astype(uv.dtype)
        return [("color0", None, first), ("color1", None, 1 - first)]


def _first(uv):
    """Return whether the square at uv has the first colour."""
    odd = uv - jnp.floor(uv) > 0.5
    return odd[0] == odd[1]
