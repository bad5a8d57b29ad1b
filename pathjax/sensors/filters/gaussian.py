"""Mitsuba's Gaussian: cut off at four standard deviations, and lowered so that it ends at 0."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.core.math import at
from pathjax.sensors.filters.filter import Filter

# Steps of the tabulated inverse of the running integral; its density is sampled exactly, step by step.
_STEPS = 1024


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Gaussian(Filter):
    stddev: jax.Array | float = 0.5  # () pixels
    radius: jax.Array | float = 2.0  # ()
    knots: jax.Array | None = None  # (_STEPS + 1,) offsets between which equal shares of the filter lie
    scale: jax.Array | None = None  # () 1 over the filter's integral

    @classmethod
    def read(cls, loader, fields) -> Gaussian:
        stddev = fields.float("stddev", 0.5, above=0, below=25)
        return cls(stddev, 4 * stddev)

    def build(self, dtype) -> Gaussian:
        x = np.linspace(-self.radius, self.radius, 16 * _STEPS + 1)
        f = self._height(x, np)
        running = np.concatenate([[0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(x))])
        knots = np.interp(np.linspace(0, running[-1], _STEPS + 1), running, x)
        return Gaussian(*(np.asarray(x, dtype) for x in (self.stddev, self.radius, knots, 1 / running[-1])))

    def sample(self, u: Float[Array, "2"]) -> tuple[Float[Array, "2"], Float[Array, ""]]:
        step = jnp.minimum((u * _STEPS).astype(jnp.int32), _STEPS - 1)
        low = jnp.stack([at(self.knots, step[0]), at(self.knots, step[1])])
        high = jnp.stack([at(self.knots, step[0] + 1), at(self.knots, step[1] + 1)])
        x = low + (u * _STEPS - step) * (high - low)
        density = 1 / (_STEPS * (high - low))
        weights = self._height(x, jnp) * self.scale / density
        return x, weights[0] * weights[1]

    def _height(self, x, xp):
        lowest = xp.exp(-(self.radius**2) / (2 * self.stddev**2))
        return xp.maximum(xp.exp(-(x**2) / (2 * self.stddev**2)) - lowest, 0)
