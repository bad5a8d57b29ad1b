"""The box filter: all of a pixel counts alike."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.sensors.filters.filter import Filter


@register_dataclass
@dataclass(frozen=True)
class Box(Filter):
    radius: jax.Array | float = 0.5  # () pixels

    @classmethod
    def read(cls, loader, fields) -> Box:
        return cls()

    def sample(self, u: Float[Array, "2"]) -> tuple[Float[Array, "2"], Float[Array, ""]]:
        return (2 * u - 1) * self.radius, jnp.ones_like(u[0])

    def evaluate(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return (jnp.abs(x) <= self.radius).astype(x.dtype)
