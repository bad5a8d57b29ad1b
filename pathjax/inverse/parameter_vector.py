"""Named parameters as one vector, and the unbounded coordinates in which they are approached."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.kinds.parameter import Parameter

# Starts this close to a bound, relative to the range, are moved inwards: beyond, unbounded coordinates hardly move.
_EDGE = 1e-3


@dataclass(frozen=True)
class ParameterVector:
    """The components of parameters one after another, such as the r, g, b of a colour. Static and hashable."""

    parameters: tuple[tuple[str, Parameter], ...]

    @property
    def labels(self) -> list[str]:
        """Of the components: `glass.int_ior`, `white.reflectance.r`, `wall.reflectance[0, 2].r`."""
        return [f"{name}{suffix}" for name, p in self.parameters for suffix in _suffixes(p.shape)]

    @property
    def bounds(self) -> np.ndarray:
        """(n, 2)."""
        return np.array([p.bounds for _, p in self.parameters for _ in range(math.prod(p.shape))])

    def pack(self, values: Mapping) -> np.ndarray:
        """(n,) float64."""
        parts = [np.broadcast_to(np.asarray(values[name]), p.shape).ravel() for name, p in self.parameters]
        return np.concatenate(parts).astype(float)

    def unpack(self, vector) -> dict:
        """(n,) -> name -> array of the parameter's shape."""
        values, first = {}, 0
        for name, p in self.parameters:
            size = math.prod(p.shape)
            values[name] = vector[first : first + size].reshape(p.shape)
            first += size
        return values

    def columns(self, jacobian: Mapping, image_shape: tuple[int, ...]) -> jax.Array:
        """A Jacobian by name as (*image_shape, n), 0 for names that it lacks."""
        parts = []
        for name, p in self.parameters:
            shape = *image_shape, math.prod(p.shape)
            parts.append(jacobian[name].reshape(shape) if name in jacobian else jnp.zeros(shape))
        return jnp.concatenate(parts, axis=-1)

    def bounded(self, x):
        """Unbounded (n,) to values: logistic between two bounds; above one, exponential where small, else linear."""
        low, high = (jnp.asarray(b, x.dtype) for b in self.bounds.T)
        two = jnp.isfinite(high)
        width = jnp.where(two, high - low, 1)
        return low + jnp.where(two, width * jax.nn.sigmoid(x), jax.nn.softplus(jnp.where(two, 0, x)))

    def unbounded(self, values) -> np.ndarray:
        """Inverse of `bounded`; values at a bound are taken a little inside."""
        low, high = self.bounds.T
        two = np.isfinite(high)
        width = np.where(two, high - low, 1)
        share = np.clip((values - low) / width, _EDGE, np.where(two, 1 - _EDGE, np.inf))
        return np.where(two, np.log(share) - np.log1p(-np.where(two, share, 0)), share + np.log(-np.expm1(-share)))

    def scale(self, values) -> np.ndarray:
        """(n,) what counts as a large change: the range between two bounds, else the value itself."""
        low, high = self.bounds.T
        return np.where(np.isfinite(high), high - low, np.maximum(np.abs(values - np.maximum(low, 0)), _EDGE))


def _suffixes(shape: tuple[int, ...]) -> list[str]:
    """Of the components of a parameter; where the last of several axes has the length 3, it is r, g, b."""
    channels = [".r", ".g", ".b"] if shape[-1:] == (3,) else [""]
    places = np.ndindex(shape[:-1] if shape[-1:] == (3,) else shape)
    return [f"{list(place) if place else ''}{channel}" for place in places for channel in channels]
