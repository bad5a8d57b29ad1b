"""The prior of the parameters of a fit: near their start, and alike in neighbouring texels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import fft, ndimage, optimize

from pathjax.errors import InputError
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.kinds.parameter import Parameter

# Standard deviation about the start: the distance of two bounds, or this many times the mean of the start.
WIDTH = 4
# Differences between texels, as parts of the scale: the first, and the least, which keeps the strength finite.
FIRST_DIFFERENCE, LEAST_DIFFERENCE = 0.1, 1e-3
# At least this part of the differences is taken to be determined by the images.
LEAST_DETERMINED = 0.01
# The largest power of smoothness, that of edges. Pixels cannot show that a texture is smoother: there may be an edge
# within one of them, where errors would then be stated too small.
MOST_POWER = 1.5
# Distributions of differences, by name; and width in texels of the windows in which a draw shows their uncertainty.
KINDS, WINDOW = ("laplacian", "total variation"), 5


class Prior:
    """Independent normal distributions about the start, and one of two for the differences of neighbouring texels.

    With d the differences of a texel from those below and to the right of it, in all C channels, the negative logarithm
    of the density is

        "laplacian"          q/2 sum |d|^2    where q is such that the root mean square of the differences,
        "total variation"    q sum |d|        where q is such that the mean of |d| / sqrt(2 C)

    is `difference`. The second lets a few be large, as at edges. It is replaced by the normal distribution of precision
    q / r that touches it at r, the root mean square of |d| in the posterior: lagged diffusivity (Vogel and Oman 1996,
    SIAM J. Sci. Comput. 17(1)), which allows for uncertain differences being large.

    Under the first, cosine waves are independent, with precision q L, L being the eigenvalues of the grid's Laplacian.
    Where `difference` is estimated, the precision is q L^s, and the power s is estimated too: 0 for independent texels,
    about 1 for photographs, and 3/2, the most, for edges. It says how much texels vary within a pixel, which is all of
    their error where pixels are larger.
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
        # (h, w, C) of parameters that are images; C = 1 for scalars.
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
        # (h, w, 1) root mean square of |d| / sqrt(2 C) in the posterior.
        self.sizes = {name: np.full((*self.shapes[name][:2], 1), d) for name, d in self.difference.items()}
        self.power = dict.fromkeys(self.difference, 1.0)
        self.links: dict[str, np.ndarray] = {}  # total variation: precisions (h, w, 1) of each texel's differences
        self.waves: dict[str, np.ndarray] = {}  # Laplacian: precisions (h, w, 1) of cosine waves
        self._link()

    def _smoothed(self, smoothness) -> list[str]:
        """Return the names of the textures, or raise InputError."""
        if not self.estimated and not (isinstance(smoothness, int | float) and 0 < smoothness < np.inf):
            raise InputError(
                f"smoothness = {smoothness!r}; give the difference between neighbouring texels that is to be expected, "
                'or "auto"'
            )
        if not self.shapes:
            raise InputError("smoothness is about the texels of textures, and none is fitted")
        return list(self.shapes)

    def _link(self) -> None:
        """Update `links`, allowing for there being more differences than independent ones, or `waves`."""
        for name, difference in self.difference.items():
            h, w = self.shapes[name][:2]
            count = max(h * (w - 1) + (h - 1) * w, 1)
            if self.total_variation:
                self.links[name] = np.broadcast_to((h * w - 1) / count / (difference * self.sizes[name]), (h, w, 1))
            else:
                rates = _rates(h, w)
                varies = rates > 0
                shape = np.where(varies, rates ** self.power[name], 0)
                q = (rates[varies] / shape[varies]).sum() / count / difference**2
                self.waves[name] = q * shape[..., None]

    def times(self, x: np.ndarray) -> np.ndarray:
        """Return the precision matrix times x (n,)."""
        return self.precision * x + self._between(x)

    def of_system(self) -> np.ndarray:
        """Return the precision matrix (Q, Q) of one of `ParameterVector.systems`."""
        systems = self.vector.systems
        columns = np.zeros((len(self.mean) // systems, len(self.mean) // systems, systems))
        columns[..., 0] = np.eye(len(columns))
        return np.stack([self.times(column.ravel())[::systems] for column in columns])

    def _between(self, x: np.ndarray) -> np.ndarray:
        """Return the differences' part of `times`."""
        total = self._by_name(np.zeros(len(x)))
        for name, value in self._by_name(x).items():
            for axis in (0, 1) if name in self.links else ():
                first, _ = _ends(axis)
                total[name] += _transposed(self.links[name][first] * np.diff(value, axis=axis), axis)
            if name in self.waves:
                total[name] += _of_waves(self.waves[name] * waves_of(value))
        return _joined(total)

    def _by_name(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parts of x (n,) by name, images as (h, w, C)."""
        parts = self.vector.unpack(x)
        return {name: part.reshape(self.shapes.get(name, part.shape)) for name, part in parts.items()}

    def gradient(self, values: np.ndarray) -> np.ndarray:
        """Return the gradient (n,) of the negative logarithm of the density."""
        return self.precision * (values - self.mean) + self._between(values)

    def diagonal(self) -> np.ndarray:
        """Return the diagonal (n,) of the precision matrix."""
        total = self._by_name(self.precision.copy())
        for name, link in self.links.items():
            for axis in (0, 1):
                first, last = _ends(axis)
                total[name][first] += link[first]
                total[name][last] += link[first]
        for name, precision in self.waves.items():
            down, right = (fft.dct(np.eye(n), axis=0, norm="ortho") ** 2 for n in precision.shape[:2])
            total[name] += (down.T @ precision[..., 0] @ right)[..., None]
        return _joined(total)

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """Draw (n,) from the normal distribution whose covariance is the precision matrix."""
        total = self._by_name(np.sqrt(self.precision) * random.normal(size=len(self.precision)))
        for name, link in self.links.items():
            for axis in (0, 1):
                first, _ = _ends(axis)
                normal = random.normal(size=np.diff(total[name], axis=axis).shape)
                total[name] += _transposed(np.sqrt(link[first]) * normal, axis)
        for name, precision in self.waves.items():
            total[name] += _of_waves(np.sqrt(precision) * random.normal(size=total[name].shape))
        return _joined(total)

    def estimate(
        self, values: np.ndarray, deviation: np.ndarray, told: np.ndarray, determined_waves: Mapping[str, np.ndarray]
    ) -> None:
        """Update the most likely differences, given the mean of the posterior and a deviation drawn from it.

        At the fixed point (MacKay 1992, Neural Computation 4(3)) squared differences times their precisions sum to the
        number of differences that the images determine. The same holds for waves, with equal weights and with the
        logarithms of their eigenvalues as weights: then the evidence is stationary in q and in s.

        Args:
            values: (n,) mean of the posterior.
            deviation: (n,) drawn from it.
            told: (n,) how much of each parameter the images determine.
            determined_waves: (h, w) the same for the waves of each texture in `waves`, summed over channels.
        """
        if self.estimated:
            for name in self.waves:
                self._estimate_waves(name, self._by_name(values)[name], determined_waves[name])
        deviations, tolds = self._by_name(deviation), self._by_name(told)
        for name, value in self._by_name(values).items():
            if name not in self.links:
                continue
            known, uncertain = _squares(value), _squares(deviations[name])
            if self.estimated:
                link, free = self.links[name], value.size - value.shape[-1]
                determined = np.clip(tolds[name].sum(), LEAST_DETERMINED * free, free)
                times = (link * known).sum() / determined  # factor by which precisions should shrink
                difference = self.difference[name] * float(times)
                self.difference[name] = max(difference, LEAST_DIFFERENCE * self.scales[name])
            square = (known + ndimage.uniform_filter(uncertain, (WINDOW, WINDOW, 1))) / (2 * value.shape[-1])
            self.sizes[name] = np.sqrt(square + (LEAST_DIFFERENCE * self.scales[name]) ** 2)
        self._link()

    def waves_of(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return the amplitudes (h, w, C) of the cosine waves of the textures in `waves`."""
        return {name: waves_of(value) for name, value in self._by_name(x).items() if name in self.waves}

    def _estimate_waves(self, name: str, value: np.ndarray, told: np.ndarray) -> None:
        h, w, channels = value.shape
        rates = _rates(h, w)
        varies = rates > 0
        if not varies.any():
            return
        rates, told = rates[varies], told[varies]
        known, log = (waves_of(value) ** 2).sum(-1)[varies], np.log(rates)
        free = channels * len(rates)
        determined = np.clip(told.sum(), LEAST_DETERMINED * free, free)

        def excess(power: float) -> float:
            """Return the mean log eigenvalue weighted by squares, minus that by `told`, times the sum of squares."""
            weights = known * rates**power
            return float(weights @ (log - (told @ log) / determined))

        if excess(MOST_POWER) <= 0:
            power = MOST_POWER
        else:
            power = 0.0 if excess(0.0) >= 0 else float(optimize.brentq(excess, 0.0, MOST_POWER))
        # The mean square of the differences of waves of precision q L^s.
        square = (known @ rates**power) / determined * (rates ** (1 - power)).sum() / (h * (w - 1) + (h - 1) * w)
        self.power[name] = power
        self.difference[name] = max(float(np.sqrt(square)), LEAST_DIFFERENCE * self.scales[name])


def waves_of(value: np.ndarray, axes: tuple[int, int] = (0, 1)) -> np.ndarray:
    """Return the amplitudes of the cosine waves whose sum is a texture (h, w, C)."""
    return fft.dctn(value, axes=axes, norm="ortho")


def _of_waves(amplitudes: np.ndarray) -> np.ndarray:
    return fft.idctn(amplitudes, axes=(0, 1), norm="ortho")


def _rates(h: int, w: int) -> np.ndarray:
    """Return the eigenvalues (h, w) of a grid's Laplacian: squared differences of each cosine wave of norm 1."""
    down, right = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (h, w))
    return down[:, None] + right


def is_grid(parameter: Parameter) -> bool:
    """Return whether a parameter is an image, of colours or scalars, whose texels have neighbours."""
    return parameter.is_texture and len(parameter.shape) == 2 + parameter.is_color


def _joined(parts: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([part.ravel() for part in parts.values()])


def _scale(parameter: Parameter, start: np.ndarray) -> float:
    low, high = parameter.bounds
    return high - low if np.isfinite(high) else WIDTH * float(np.mean(np.abs(start))) or 1.0


def _squares(value: np.ndarray) -> np.ndarray:
    """Return the sum of the squared differences of each texel: (h, w, C) -> (h, w, 1)."""
    total = np.zeros((*value.shape[:2], 1))
    for axis in (0, 1):
        first, _ = _ends(axis)
        total[first] += (np.diff(value, axis=axis) ** 2).sum(-1, keepdims=True)
    return total


def _ends(axis: int) -> tuple:
    return (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])


def _transposed(differences: np.ndarray, axis: int) -> np.ndarray:
    """Transpose of np.diff."""
    around = [(0, 0)] * differences.ndim
    around[axis] = 1, 1
    return -np.diff(np.pad(differences, around), axis=axis)
