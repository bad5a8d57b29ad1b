"""Named parameters as one vector, and the unbounded coordinates in which they are approached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.kinds.parameter import Parameter

# Starts this close to a bound, relative to the range, are moved inwards: beyond, unbounded coordinates hardly move.
_EDGE = 1e-3


@dataclass(frozen=True)
class Coordinates:
    """Components one after another: a number, or the r, g, b of a colour. Static and hashable."""

    parameters: tuple[tuple[str, Parameter], ...]

    @property
    def labels(self) -> list[str]:
        return [
            name if not p.shape else f"{name}.{channel}"
            for name, p in self.parameters
            for channel in ("rgb" if p.shape else " ")
        ]

    @property
    def bounds(self) -> np.ndarray:
        """(n, 2)."""
        return np.array([p.bounds for _, p in self.parameters for _ in range(p.shape[0] if p.shape else 1)])

    def pack(self, values: Mapping) -> np.ndarray:
        """(n,) float64."""
        parts = [np.broadcast_to(np.asarray(values[name]), p.shape).ravel() for name, p in self.parameters]
        return np.concatenate(parts).astype(float)

    def unpack(self, vector) -> dict:
        """(n,) -> name -> array of the parameter's shape."""
        values, first = {}, 0
        for name, p in self.parameters:
            size = p.shape[0] if p.shape else 1
            values[name] = vector[first : first + size].reshape(p.shape)
            first += size
        return values

    def columns(self, jacobian, image_shape):
        """A Jacobian by name as (*image_shape, n), 0 for names that it lacks."""
        parts = []
        for name, p in self.parameters:
            size = p.shape[0] if p.shape else 1
            if name in jacobian:
                parts.append(jacobian[name].reshape(*image_shape, size))
            else:
                parts.append(jnp.zeros((*image_shape, size)))
        return jnp.concatenate(parts, axis=-1)

    def bounded(self, x):
        """Unbounded (n,) to values: logistic between two bounds; above one, exponential where small, else linear."""
        low, high = (jnp.asarray(b, x.dtype) for b in self.bounds.T)
        two = jnp.isfinite(high)
        width = jnp.where(two, high - low, 1)
        return low + jnp.where(two, width * jax.nn.sigmoid(x), jax.nn.softplus(jnp.where(two, 0, x)))

    def unbounded(self, v) -> np.ndarray:
        """Inverse of `bounded`; values at a bound are taken a little inside."""
        low, high = self.bounds.T
        two = np.isfinite(high)
        width = np.where(two, high - low, 1)
        share = np.clip((v - low) / width, _EDGE, np.where(two, 1 - _EDGE, np.inf))
        return np.where(two, np.log(share) - np.log1p(-np.where(two, share, 0)), share + np.log(-np.expm1(-share)))

    def scale(self, v) -> np.ndarray:
        """(n,) what counts as a large change: the range between two bounds, else the value itself."""
        low, high = self.bounds.T
        return np.where(np.isfinite(high), high - low, np.maximum(np.abs(v - np.maximum(low, 0)), _EDGE))
