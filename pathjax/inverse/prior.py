"""What is assumed of parameters before an image is seen: near their start, and alike in neighbouring texels."""

from __future__ import annotations

import numpy as np

from pathjax.errors import InputError
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.kinds.parameter import Parameter

# Standard deviations about the start: the distance of two bounds, or so many times the mean of the start.
WIDTH = 4
# Differences between texels, as parts of the scale: to begin with, and the least, so that the strength stays finite.
FIRST_DIFFERENCE, LEAST_DIFFERENCE = 0.1, 1e-3
# At least this part of the differences is taken for determined by the images.
LEAST_DETERMINED = 0.01


class Prior:
    """Independent normal distributions about the start, and of the differences between neighbouring texels.

    The second is the Laplacian prior: minus the logarithm of its density is q/2 times the sum of the squares of all
    differences, down and right, where q is such that their root mean square is `difference`.
    """

    def __init__(self, vector: ParameterVector, start: np.ndarray, smoothness: float | str | None = None):
        self.vector, self.mean = vector, start
        values = vector.unpack(start)
        self.scales = {name: _scale(p, values[name]) for name, p in vector.parameters}
        self.scale = vector.pack(self.scales)  # (n,)
        self.precision = 1 / self.scale**2
        self.shapes = {name: p.shape for name, p in vector.parameters if is_grid(p)}
        self.estimated = smoothness == "auto"
        self.difference: dict[str, float] = {}
        if smoothness is not None:
            for name in self._smoothed(smoothness):
                self.difference[name] = FIRST_DIFFERENCE * self.scales[name] if self.estimated else float(smoothness)
        self.links: dict[str, float] = {}
        self._link()

    def _smoothed(self, smoothness) -> list[str]:
        """Names of the textures; raises InputError."""
        if not self.estimated and not (isinstance(smoothness, int | float) and 0 < smoothness < np.inf):
            raise InputError(
                f"smoothness = {smoothness!r}; give the difference between neighbouring texels that is to be expected, "
                'or "auto"'
            )
        if not self.shapes:
            raise InputError("smoothness is about the texels of textures, and none is fitted")
        return list(self.shapes)

    def _link(self) -> None:
        """Precisions of the differences. T texels have more of these than the T - 1 that are independent."""
        for name, difference in self.difference.items():
            h, w = self.shapes[name][:2]
            links = max(h * (w - 1) + (h - 1) * w, 1)
            self.links[name] = (h * w - 1) / links / difference**2

    def times(self, x: np.ndarray) -> np.ndarray:
        """The precision matrix times x (n,)."""
        return self.precision * x + self._between(x)

    def of_channel(self) -> np.ndarray:
        """(Q, Q) the precision matrix of one channel, where all parameters are colours."""
        columns = np.zeros((len(self.mean) // 3, len(self.mean) // 3, 3))
        columns[..., 0] = np.eye(len(columns))
        return np.stack([self.times(column.ravel())[::3] for column in columns])

    def _between(self, x: np.ndarray) -> np.ndarray:
        """What the differences add to `times`."""
        total = self.vector.unpack(np.zeros(len(x)))
        for name, value in self.vector.unpack(x).items():
            for axis in (0, 1) if name in self.links else ():
                total[name] += self.links[name] * _transposed(np.diff(value, axis=axis), axis)
        return self.vector.pack(total)

    def gradient(self, values: np.ndarray) -> np.ndarray:
        """(n,) of minus the logarithm of the density."""
        return self.precision * (values - self.mean) + self._between(values)

    def diagonal(self) -> np.ndarray:
        """(n,) of the precision matrix."""
        total = self.vector.unpack(self.precision.copy())
        for name, link in self.links.items():
            for axis in (0, 1):
                first, last = _ends(axis)
                total[name][first] += link
                total[name][last] += link
        return self.vector.pack(total)

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """(n,) of a normal distribution whose covariance is the precision matrix."""
        total = self.vector.unpack(np.sqrt(self.precision) * random.normal(size=len(self.precision)))
        for name, link in self.links.items():
            for axis in (0, 1):
                shape = np.diff(total[name], axis=axis).shape
                total[name] += np.sqrt(link) * _transposed(random.normal(size=shape), axis)
        return self.vector.pack(total)

    def estimate(self, values: np.ndarray, told: np.ndarray) -> None:
        """Take the differences that are most likely, given the mean of the posterior.

        As many of them as the images determine are as large, in the mean square, as they were taken for: the fixed
        point of MacKay (1992), Neural Computation 4(3). told: (n,) how much of each number the images determine.
        """
        tolds = self.vector.unpack(told)
        for name, value in self.vector.unpack(values).items():
            if name not in self.links or not self.estimated:
                continue
            energy = self.links[name] * sum((np.diff(value, axis=axis) ** 2).sum() for axis in (0, 1))
            free = value.size - value.shape[-1]
            determined = np.clip(tolds[name].sum(), LEAST_DETERMINED * free, free)
            difference = self.difference[name] * float(np.sqrt(energy / determined))
            self.difference[name] = max(difference, LEAST_DIFFERENCE * self.scales[name])
        self._link()


def is_grid(parameter: Parameter) -> bool:
    """Whether it is an image, whose numbers have neighbours."""
    return parameter.is_texture and len(parameter.shape) == 3


def _scale(parameter: Parameter, start: np.ndarray) -> float:
    low, high = parameter.bounds
    return high - low if np.isfinite(high) else WIDTH * float(np.mean(np.abs(start))) or 1.0


def _ends(axis: int) -> tuple:
    return (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])


def _transposed(differences: np.ndarray, axis: int) -> np.ndarray:
    """The transpose of np.diff."""
    around = [(0, 0)] * differences.ndim
    around[axis] = 1, 1
    return -np.diff(np.pad(differences, around), axis=axis)
