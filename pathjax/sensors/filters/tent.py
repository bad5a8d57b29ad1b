"""A tent: weights fall from the middle of a pixel to 0."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.compile import register_dataclass
from pathjax.core.warp import tent
from pathjax.sensors.filters.filter import Filter


@register_dataclass
@dataclass(frozen=True)
class Tent(Filter):
    radius: jax.Array | float = 1.0  # () pixels

    @classmethod
    def read(cls, loader, fields) -> Tent:
        return cls(fields.float("radius", 1.0, above=0, below=100))

    def sample(self, u: Float[Array, "2"]) -> tuple[Float[Array, "2"], Float[Array, ""]]:
        return tent(u) * self.radius, jnp.ones_like(u[0])

    def evaluate(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jnp.maximum(1 - jnp.abs(x) / self.radius, 0)
