"""A render in passes: something to look at soon, bounded memory, and nothing lost when it is stopped."""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from pathjax import film
from pathjax.compare import RELATIVE_FLOOR
from pathjax.render import render_pixels
from pathjax.scene import Scene

# Paths in one call of the kernel: large enough that the call costs nothing, small enough that an interrupt is heard
# at once. The schedule is fixed, not timed, so that the same command gives the same image.
CHUNK_PIXELS = 1 << 14
MAX_PASS_SPP = 16


class ProgressiveRender:
    """Running means of an image.

    The error is estimated from the spread between passes. Passes share one randomised Sobol' sequence and are
    negatively correlated, so the estimate is on the high side; it is nan before the second pass.
    """

    def __init__(self, scene: Scene, spp: int, seed: int = 0, strategy: str = "mis"):
        self.scene, self.spp, self.seed, self.strategy = scene, spp, seed, strategy
        count = film.pixel_count(scene.film)
        self._sum = np.zeros((count, 3))
        self._sum_squares = np.zeros((count, 3), np.float32)  # of pass means, weighted by their samples
        self._spp = np.zeros(count, np.int32)
        self._passes = 0
        # All chunks have one shape, so one kernel; a small image is one chunk.
        self._chunk = min(CHUNK_PIXELS, count)

    def __iter__(self) -> Iterator[int]:
        """Render; yields after every call of the kernel the number of paths it traced."""
        count, done = len(self._spp), 0
        while done < self.spp:
            spp = min(max(done, 1), MAX_PASS_SPP, self.spp - done)
            for first in range(0, count, self._chunk):
                last = min(first + self._chunk, count)
                # The last chunk repeats its last pixel up to full length.
                pixels = jnp.minimum(jnp.arange(first, first + self._chunk, dtype=jnp.int32), count - 1)
                means = render_pixels(self.scene, pixels, done, spp, self.seed, self.strategy)
                means = np.asarray(means)[: last - first]
                self._sum[first:last] += means.astype(float) * spp
                self._sum_squares[first:last] += means**2 * spp
                self._spp[first:last] += spp
                yield (last - first) * spp
            done += spp
            self._passes += 1

    def image(self) -> np.ndarray:
        """(H, W, 3) float32 mean so far; 0 where nothing was rendered yet."""
        mean = self._sum / np.maximum(self._spp, 1)[:, None]
        return mean.astype(np.float32).reshape(*film.image_shape(self.scene.film), 3)

    def samples(self) -> tuple[int, int]:
        """Fewest and most samples of any pixel."""
        return int(self._spp.min()), int(self._spp.max())

    def error(self) -> float:
        """Estimate of sqrt(relMSE)."""
        if self._passes < 2:
            return float("nan")
        spp = self._spp[:, None]
        mean = self._sum / spp
        variance = np.maximum(self._sum_squares / spp - mean**2, 0) / (self._passes - 1)
        return float(np.sqrt(np.nanmean(variance / (mean**2 + RELATIVE_FLOOR))))
