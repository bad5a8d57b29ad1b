"""Filters whose running integral has no simple inverse: it is tabulated, and its density sampled exactly."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.core.math import at
from pathjax.sensors.filters.filter import Filter

_STEPS = 1024
Shape = TypeVar("Shape", bound="float | np.ndarray | jax.Array")


@dataclass(frozen=True)
class Tabulated(Filter):
    """A filter of which a subclass gives the `radius` and the `height`. Where it is negative, so are weights."""

    # Once it is built: offsets (_STEPS + 1,) between which equal shares of |filter| lie, and 1 over its integral ().
    knots: jax.Array | None = field(default=None, kw_only=True)
    scale: jax.Array | None = field(default=None, kw_only=True)

    @abstractmethod
    def height(self, x: Shape, xp) -> Shape:
        """At |x| <= radius, in pixels, up to a factor. xp: NumPy or jax.numpy."""

    def build(self, dtype) -> Tabulated:
        x = np.linspace(-self.radius, self.radius, 16 * _STEPS + 1)
        f = self.height(x, np)
        running = np.concatenate([[0], np.cumsum((np.abs(f[1:]) + np.abs(f[:-1])) / 2 * np.diff(x))])
        knots = np.interp(np.linspace(0, running[-1], _STEPS + 1), running, x)
        integral = ((f[1:] + f[:-1]) / 2 * np.diff(x)).sum()
        made = replace(self, knots=knots, scale=1 / integral)
        return jax.tree.map(lambda x: np.asarray(x, dtype), made)

    def sample(self, u: Float[Array, "2"]) -> tuple[Float[Array, "2"], Float[Array, ""]]:
        step = jnp.minimum((u * _STEPS).astype(jnp.int32), _STEPS - 1)
        low = jnp.stack([at(self.knots, step[0]), at(self.knots, step[1])])
        high = jnp.stack([at(self.knots, step[0] + 1), at(self.knots, step[1] + 1)])
        x = low + (u * _STEPS - step) * (high - low)
        density = 1 / (_STEPS * (high - low))
        weights = self.height(x, jnp) * self.scale / density
        return x, weights[0] * weights[1]

    def evaluate(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jnp.where(jnp.abs(x) <= self.radius, self.height(x, jnp), 0)
