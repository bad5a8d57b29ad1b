"""What is assumed of parameters before an image is seen: near their start, and alike in neighbouring texels."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pathjax.errors import InputError
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.kinds.parameter import Parameter

# Standard deviations about the start: the distance of two bounds, or so many times the mean of the start.
WIDTH = 4
# Differences between texels, as parts of the scale: to begin with, and the least, so that the strength stays finite.
FIRST_DIFFERENCE, LEAST_DIFFERENCE = 0.1, 1e-3
# At least this part of the differences is taken for determined by the images.
LEAST_DETERMINED = 0.01
# What is supposed of differences, by name; and over so many texels a draw says how uncertain they are.
KINDS, WINDOW = ("laplacian", "total variation"), 5


class Prior:
    """Independent normal distributions about the start, and one of two of the differences between neighbouring texels.

    With d the differences of a texel from those below and to the right of it, in all C channels, minus the logarithm of
    the density is

        "laplacian"          q/2 sum |d|^2    where q is such that the root mean square of the differences,
        "total variation"    q sum |d|        where q is such that the mean of |d| / sqrt(2 C)

    is `difference`. The second lets few be large, as at edges. It is taken as the normal distribution of precision
    q / r that touches it at r, the root mean square of |d| in the posterior: lagged diffusivity (Vogel and Oman 1996,
    SIAM J. Sci. Comput. 17(1)), which knows that what is uncertain may be large.
    """

    def __init__(
        self,
        vector: ParameterVector,
        start: np.ndarray,
        smoothness: float | str | None = None,
        kind: str = KINDS[0],
    ):
        self.vector, self.mean = vector, start
        values = vector.unpack(start)
        self.scales = {name: _scale(p, values[name]) for name, p in vector.parameters}
        self.scale = vector.pack(self.scales)  # (n,)
        self.precision = 1 / self.scale**2
        # (h, w, C) of those that are images; where they are of numbers, C = 1.
        self.shapes = {name: p.shape if p.is_color else (*p.shape, 1) for name, p in vector.parameters if is_grid(p)}
        if kind not in KINDS:
            raise InputError(f"prior = {kind!r}; use {' or '.join(map(repr, KINDS))}")
        self.total_variation = kind == "total variation"
        self.estimated = smoothness == "auto"
        self.difference: dict[str, float] = {}
        if smoothness is not None:
            for name in self._smoothed(smoothness):
                self.difference[name] = FIRST_DIFFERENCE * self.scales[name] if self.estimated else float(smoothness)
        elif self.total_variation:
            raise InputError("prior is of fits with smoothness; give it too")
        # Of |d| / sqrt(2 C), as it is in the posterior: (h, w, 1).
        self.sizes = {name: np.full((*self.shapes[name][:2], 1), d) for name, d in self.difference.items()}
        self.links: dict[str, np.ndarray] = {}
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
        """Precisions (h, w, 1) of each texel's differences: there are more of these than are independent."""
        for name, difference in self.difference.items():
            h, w = self.shapes[name][:2]
            count = max(h * (w - 1) + (h - 1) * w, 1)
            size = self.sizes[name] if self.total_variation else difference
            self.links[name] = np.broadcast_to((h * w - 1) / count / (difference * size), (h, w, 1))

    def times(self, x: np.ndarray) -> np.ndarray:
        """The precision matrix times x (n,)."""
        return self.precision * x + self._between(x)

    def of_system(self) -> np.ndarray:
        """(Q, Q) the precision matrix of one of `ParameterVector.systems`."""
        systems = self.vector.systems
        columns = np.zeros((len(self.mean) // systems, len(self.mean) // systems, systems))
        columns[..., 0] = np.eye(len(columns))
        return np.stack([self.times(column.ravel())[::systems] for column in columns])

    def _between(self, x: np.ndarray) -> np.ndarray:
        """What the differences add to `times`."""
        total = self._by_name(np.zeros(len(x)))
        for name, value in self._by_name(x).items():
            for axis in (0, 1) if name in self.links else ():
                first, _ = _ends(axis)
                total[name] += _transposed(self.links[name][first] * np.diff(value, axis=axis), axis)
        return _joined(total)

    def _by_name(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """(n,) as parts of it, images as (h, w, C)."""
        parts = self.vector.unpack(x)
        return {name: part.reshape(self.shapes.get(name, part.shape)) for name, part in parts.items()}

    def gradient(self, values: np.ndarray) -> np.ndarray:
        """(n,) of minus the logarithm of the density."""
        return self.precision * (values - self.mean) + self._between(values)

    def diagonal(self) -> np.ndarray:
        """(n,) of the precision matrix."""
        total = self._by_name(self.precision.copy())
        for name, link in self.links.items():
            for axis in (0, 1):
                first, last = _ends(axis)
                total[name][first] += link[first]
                total[name][last] += link[first]
        return _joined(total)

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """(n,) of a normal distribution whose covariance is the precision matrix."""
        total = self._by_name(np.sqrt(self.precision) * random.normal(size=len(self.precision)))
        for name, link in self.links.items():
            for axis in (0, 1):
                first, _ = _ends(axis)
                normal = random.normal(size=np.diff(total[name], axis=axis).shape)
                total[name] += _transposed(np.sqrt(link[first]) * normal, axis)
        return _joined(total)

    def estimate(self, values: np.ndarray, deviation: np.ndarray, told: np.ndarray) -> None:
        """Take the differences that are most likely, given the mean of the posterior and a deviation drawn from it.

        As many of them as the images determine are as large, in the mean square, as they were taken for: the fixed
        point of MacKay (1992), Neural Computation 4(3). told: (n,) how much of each number the images determine.
        """
        deviations, tolds = self._by_name(deviation), self._by_name(told)
        for name, value in self._by_name(values).items():
            if name not in self.links:
                continue
            known, uncertain = _squares(value), _squares(deviations[name])
            if self.estimated:
                link, free = self.links[name], value.size - value.shape[-1]
                determined = np.clip(tolds[name].sum(), LEAST_DETERMINED * free, free)
                times = (link * known).sum() / determined  # so many times smaller should precisions be
                difference = self.difference[name] * float(times if self.total_variation else np.sqrt(times))
                self.difference[name] = max(difference, LEAST_DIFFERENCE * self.scales[name])
            square = (known + ndimage.uniform_filter(uncertain, (WINDOW, WINDOW, 1))) / (2 * value.shape[-1])
            self.sizes[name] = np.sqrt(square + (LEAST_DIFFERENCE * self.scales[name]) ** 2)
        self._link()


def is_grid(parameter: Parameter) -> bool:
    """Whether it is an image, of colours or numbers, whose texels have neighbours."""
    return parameter.is_texture and len(parameter.shape) == 2 + parameter.is_color


def _joined(parts: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([part.ravel() for part in parts.values()])


def _scale(parameter: Parameter, start: np.ndarray) -> float:
    low, high = parameter.bounds
    return high - low if np.isfinite(high) else WIDTH * float(np.mean(np.abs(start))) or 1.0


def _squares(value: np.ndarray) -> np.ndarray:
    """(h, w, C) -> (h, w, 1) of the differences of each texel, summed."""
    total = np.zeros((*value.shape[:2], 1))
    for axis in (0, 1):
        first, _ = _ends(axis)
        total[first] += (np.diff(value, axis=axis) ** 2).sum(-1, keepdims=True)
    return total


def _ends(axis: int) -> tuple:
    return (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])


def _transposed(differences: np.ndarray, axis: int) -> np.ndarray:
    """The transpose of np.diff."""
    around = [(0, 0)] * differences.ndim
    around[axis] = 1, 1
    return -np.diff(np.pad(differences, around), axis=axis)
