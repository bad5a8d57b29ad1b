"""Named parameters as one vector, and the unbounded coordinates in which they are approached."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.kinds.parameter import Parameter

# Starts closer to a bound than this, relative to the range, are moved inwards: there unbounded coordinates hardly move.
_EDGE = 1e-3


@dataclass(frozen=True)
class ParameterVector:
    """The components of parameters in one vector, such as the r, g, b of a colour. Static and hashable."""

    parameters: tuple[tuple[str, Parameter], ...]

    @property
    def count(self) -> int:
        """The number n of components."""
        return sum(math.prod(p.shape) for _, p in self.parameters)

    @property
    def labels(self) -> list[str]:
        """Names of the components: `glass.int_ior`, `white.reflectance.r`, `wall.reflectance[0, 2].r`."""
        return [f"{name}{suffix}" for name, p in self.parameters for suffix in _suffixes(p)]

    @property
    def bounds(self) -> np.ndarray:
        """(n, 2) bounds between which values have an effect."""
        limits = [(max(p.bounds[0], p.least), p.bounds[1]) for _, p in self.parameters]
        return np.repeat(limits, [math.prod(p.shape) for _, p in self.parameters], axis=0)

    def pack(self, values: Mapping) -> np.ndarray:
        """Return the vector (n,), float64, of values by name."""
        parts = [np.broadcast_to(np.asarray(values[name]), p.shape).ravel() for name, p in self.parameters]
        return np.concatenate(parts).astype(float)

    def unpack(self, vector) -> dict:
        """Return the parts of a vector (n,) by name, each of its parameter's shape."""
        values, first = {}, 0
        for name, p in self.parameters:
            size = math.prod(p.shape)
            values[name] = vector[first : first + size].reshape(p.shape)
            first += size
        return values

    @property
    def runs(self) -> list[tuple[bool, int]]:
        """Runs of columns of one type: whether they are colours, and how many. A column is a scalar or a colour."""
        kinds = itertools.groupby(self.parameters, lambda item: item[1].is_color)
        return [(color, sum(map(_count, (p for _, p in group)))) for color, group in kinds]

    @property
    def systems(self) -> int:
        """Number of independent linear systems: 3, one per channel, for colours; 1 for scalars; 0 for both together."""
        kinds = {p.is_color for _, p in self.parameters}
        return 0 if len(kinds) > 1 else 3 if kinds.pop() else 1

    @property
    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """For n components: the column (n,) of each, and the channels (3, n) that depend on it, 1 or 0."""
        columns, seen, first = [], [], 0
        for color, count in self.runs:
            here = np.arange(first, first + count)
            columns.append(np.repeat(here, 3) if color else here)
            seen.append(np.tile(np.eye(3), count) if color else np.ones((3, count)))
            first += count
        return np.concatenate(columns), np.concatenate(seen, 1)

    def columns(self, jacobian: Mapping, image: jax.Array) -> jax.Array:
        """Return the Jacobian by name of an image (..., 3) as (..., Q, 3); 0 for names that it lacks.

        Light keeps its channel, so each channel has one derivative in a colour.
        """
        parts = []
        for name, p in self.parameters:
            by_channel = [jnp.zeros((*image.shape[:-1], _count(p)), image.dtype)] * 3
            if name in jacobian:
                J = jacobian[name].reshape(*image.shape, _count(p), *([3] if p.is_color else []))
                by_channel = [J[..., c, :, c] if p.is_color else J[..., c, :] for c in range(3)]
            parts.append(jnp.stack(by_channel, -1))
        return jnp.concatenate(parts, -2)

    def by_column(self, values: jax.Array) -> jax.Array:
        """Return values (n,) as (Q, 3): a scalar is the same in all channels."""
        parts, first = [], 0
        for color, count in self.runs:
            part = values[first : first + count * (3 if color else 1)]
            parts.append(part.reshape(count, 3) if color else jnp.broadcast_to(part[:, None], (count, 3)))
            first += len(part)
        return jnp.concatenate(parts)

    def by_component(self, columns: jax.Array) -> jax.Array:
        """Return columns (..., Q, 3) as (..., n): for a scalar, the sum over channels."""
        parts, first = [], 0
        for color, count in self.runs:
            part = columns[..., first : first + count, :]
            parts.append(part.reshape(*part.shape[:-2], -1) if color else part.sum(-1))
            first += count
        return jnp.concatenate(parts, -1)

    @property
    def _logarithmic(self) -> np.ndarray:
        """(n,) bool: fitted by the logarithm, since ratios of values matter, as for roughnesses, which have a least."""
        return np.array([math.isfinite(p.least) for _, p in self.parameters for _ in range(math.prod(p.shape))])

    @property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """(2, n) bounds, of the logarithm where that is fitted; and (n,) bool whether the upper one is finite."""
        bounds = self.bounds.T
        limits = np.where(self._logarithmic, np.log(np.where(self._logarithmic, bounds, 1)), bounds)
        return limits, np.isfinite(limits[1])

    def bounded(self, x):
        """Map unbounded x (n,) to values: logistic between two bounds; above one, exponential at first, then linear."""
        (low, high), two = self._limits
        width = jnp.asarray(np.where(two, high - low, 1), x.dtype)
        return _bounded(x, jnp.asarray(low, x.dtype), width, two, self._logarithmic)

    def unbounded(self, values) -> np.ndarray:
        """Inverse of `bounded`; values at a bound are moved a little inside."""
        (low, high), two = self._limits
        values = np.where(self._logarithmic, np.log(np.where(self._logarithmic, values, 1)), values)
        width = np.where(two, high - low, 1)
        share = np.clip((values - low) / width, _EDGE, np.where(two, 1 - _EDGE, np.inf))
        return np.where(two, np.log(share) - np.log1p(-np.where(two, share, 0)), share + np.log(-np.expm1(-share)))

    def scale(self, values) -> np.ndarray:
        """Return the size (n,) of a large change: the range between two bounds, else the value itself."""
        low, high = self.bounds.T
        ranges = np.isfinite(high) & ~self._logarithmic
        origin = np.where(self._logarithmic, 0, np.maximum(low, 0))
        least = np.where(self._logarithmic, low, _EDGE)
        return np.where(ranges, high - low, np.maximum(np.abs(values - origin), least))


@partial(jax.jit, inline=True)
def _bounded(x, low, width, two, logarithmic):
    beyond = jnp.where(two, width * jax.nn.sigmoid(x), jax.nn.softplus(jnp.where(two, 0, x)))
    y = low + beyond
    return jnp.where(logarithmic, jnp.exp(jnp.where(logarithmic, y, 0)), y)


def _count(parameter: Parameter) -> int:
    """Return the number of colours, or of scalars, in a parameter."""
    return math.prod(parameter.shape[:-1] if parameter.is_color else parameter.shape)


def _suffixes(parameter: Parameter) -> list[str]:
    """Return the suffix of a parameter's name for each of its components."""
    channels = [".r", ".g", ".b"] if parameter.is_color else [""]
    places = np.ndindex(parameter.shape[:-1] if parameter.is_color else parameter.shape)
    return [f"{list(place) if place else ''}{channel}" for place in places for channel in channels]
