"""Textures that are the same everywhere."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax.core.types import Surface
from pathjax.description.fields import BAND
from pathjax.kinds import Instance, Number, Row
from pathjax.textures.texture import Texture


class Uniform(Texture):
    """One number for all channels."""

    value = Number(bounds=(0, math.inf))
    unused = BAND

    @classmethod
    def read(cls, loader, fields, name):
        return cls.instance(name, value=fields.float("value", at_least=0))

    @staticmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        return jnp.stack([p.value] * 3)

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        return [("value", None, jnp.ones_like(uv[0]))]

    @classmethod
    def parts_of_mean(cls, texture: Instance) -> list[str]:
        return ["value"]
