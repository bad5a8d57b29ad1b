"""What is assumed of parameters before an image is seen: near their start, and alike in neighbouring texels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import fft, ndimage, optimize

from pathjax.errors import InputError
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.kinds.parameter import Parameter

# Standard deviations about the start: the distance of two bounds, or so many times the mean of the start.
WIDTH = 4
# Differences between texels, as parts of the scale: to begin with, and the least, so that the strength stays finite.
FIRST_DIFFERENCE, LEAST_DIFFERENCE = 0.1, 1e-3
# At least this part of the differences is taken for determined by the images.
LEAST_DETERMINED = 0.01
# The largest power of smoothness, which is that of edges. Pixels tell no more of what is smoother: within one of them
# there may be an edge, and errors would be stated too small there.
MOST_POWER = 1.5
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

    Under the first, cosine waves are independent, of precision q L with L the eigenvalues of the Laplacian of the grid.
    Where `difference` is estimated, that is q L^s, and the power s too: texels that know nothing of each other have 0,
    those of a photograph about 1, edges 3/2, which is the most. It says how texels vary within a pixel, of which their
    errors consist where pixels are larger.
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
        self.power = dict.fromkeys(self.difference, 1.0)
        self.links: dict[str, np.ndarray] = {}  # of total variation
        self.waves: dict[str, np.ndarray] = {}  # of the Laplacian: precisions (h, w, 1) of cosine waves
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
        """Precisions (h, w, 1) of each texel's differences, of which more are than are independent; or of waves."""
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
            if name in self.waves:
                total[name] += _of_waves(self.waves[name] * waves_of(value))
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
        for name, precision in self.waves.items():
            down, right = (fft.dct(np.eye(n), axis=0, norm="ortho") ** 2 for n in precision.shape[:2])
            total[name] += (down.T @ precision[..., 0] @ right)[..., None]
        return _joined(total)

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """(n,) of a normal distribution whose covariance is the precision matrix."""
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
        self, values: np.ndarray, deviation: np.ndarray, told: np.ndarray, told_waves: Mapping[str, np.ndarray]
    ) -> None:
        """Take the differences that are most likely, given the mean of the posterior and a deviation drawn from it.

        As many of them as the images determine are as large, in the mean square, as they were taken for: the fixed
        point of MacKay (1992), Neural Computation 4(3). So are waves, whether each counts alike, or by the logarithm of
        its eigenvalue: then the evidence changes neither with q nor with s.

        Args:
            told: (n,) how much of each number the images determine.
            told_waves: (h, w) the same of the waves of each texture in `waves`, summed over channels.
        """
        if self.estimated:
            for name in self.waves:
                self._estimate_waves(name, self._by_name(values)[name], told_waves[name])
        deviations, tolds = self._by_name(deviation), self._by_name(told)
        for name, value in self._by_name(values).items():
            if name not in self.links:
                continue
            known, uncertain = _squares(value), _squares(deviations[name])
            if self.estimated:
                link, free = self.links[name], value.size - value.shape[-1]
                determined = np.clip(tolds[name].sum(), LEAST_DETERMINED * free, free)
                times = (link * known).sum() / determined  # so many times smaller should precisions be
                difference = self.difference[name] * float(times)
                self.difference[name] = max(difference, LEAST_DIFFERENCE * self.scales[name])
            square = (known + ndimage.uniform_filter(uncertain, (WINDOW, WINDOW, 1))) / (2 * value.shape[-1])
            self.sizes[name] = np.sqrt(square + (LEAST_DIFFERENCE * self.scales[name]) ** 2)
        self._link()

    def waves_of(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Amplitudes (h, w, C) of the waves of which the textures in `waves` are sums."""
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
            """How much larger logarithms are in the mean over known squares than over what the images determine."""
            weights = known * rates**power
            return float(weights @ (log - (told @ log) / determined))

        if excess(MOST_POWER) <= 0:
            power = MOST_POWER
        else:
            power = 0.0 if excess(0.0) >= 0 else float(optimize.brentq(excess, 0.0, MOST_POWER))
        # The root mean square of the differences of waves of the precision q L^s.
        square = (known @ rates**power) / determined * (rates ** (1 - power)).sum() / (h * (w - 1) + (h - 1) * w)
        self.power[name] = power
        self.difference[name] = max(float(np.sqrt(square)), LEAST_DIFFERENCE * self.scales[name])


def waves_of(value: np.ndarray, axes: tuple[int, int] = (0, 1)) -> np.ndarray:
    """Amplitudes of the cosine waves that a texture (h, w, C) is the sum of."""
    return fft.dctn(value, axes=axes, norm="ortho")


def _of_waves(amplitudes: np.ndarray) -> np.ndarray:
    return fft.idctn(amplitudes, axes=(0, 1), norm="ortho")


def _rates(h: int, w: int) -> np.ndarray:
    """(h, w) eigenvalues of the Laplacian of a grid: squares of the differences of each cosine wave of length 1."""
    down, right = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (h, w))
    return down[:, None] + right


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
