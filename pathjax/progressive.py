"""A render in passes: something to look at soon, bounded memory, and a state that can be left and taken up again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pathjax import film, replicates
from pathjax.render import pixel_means
from pathjax.scene import Scene

# Pixels in one call of the kernel: large enough that the call costs little, small enough that an interrupt is heard
# at once. The schedule is fixed, not timed, so that the same command gives the same image.
CHUNK_PIXELS = 1 << 14
MAX_PASS_SPP = 16 * replicates.COUNT


@dataclass
class State:
    """Running means of the replicates, row by row over the image, and how far they are to go."""

    means: np.ndarray  # (R, N, 3) float32
    count: np.ndarray  # (N,) int32 samples so far, of all replicates together
    goal: np.ndarray  # (N,) int32 samples at the end of this round
    weights: np.ndarray  # (N,) float32 of mean 1, how samples are spread over the pixels
    spp: int = 0  # mean samples of a pixel that the round was planned for
    seconds: float = 0.0  # spent rendering

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """The image and its variance, (N, 3) each."""
        return replicates.moments(self.means, self.count)


def start(scene: Scene) -> State:
    count = film.pixel_count(scene.film)
    none = np.zeros(count, np.int32)
    return State(np.zeros((replicates.COUNT, count, 3), np.float32), none, none.copy(), np.ones(count, np.float32))


def plan(state: State, spp: int) -> None:
    """Begin a round that ends with `spp` samples a pixel, on average; what a pixel has already it keeps."""
    goal = state.weights.astype(float) * spp
    if (state.weights != 1).any():
        goal = np.rint(goal / replicates.COUNT) * replicates.COUNT
    state.goal = np.maximum(state.count, np.minimum(goal, np.iinfo(np.int32).max)).astype(np.int32)
    state.spp = spp


def extend(scene: Scene, state: State, seed: int, strategy: str) -> Iterator[None]:
    """Render what is missing of the round; yields after every call of the kernel, when the state is whole.

    The samples of a pixel are added in portions that depend on its own count alone, so that a state which was saved
    between two calls leads to the same bits.
    """
    seeds = replicates.seeds(seed)
    chunk = _chunk(state)
    while (missing := np.flatnonzero(state.count < state.goal)).size:
        for first in range(0, missing.size, chunk):
            pixels = missing[first : first + chunk]
            before = state.count[pixels]
            portion = np.clip(3 * before, replicates.COUNT, MAX_PASS_SPP)
            after = before + np.minimum(portion, state.goal[pixels] - before)
            first_sample = replicates.shares(before)
            spp = replicates.shares(after) - first_sample
            means = _call(scene, chunk, pixels, first_sample, spp, seeds, strategy)
            share = (spp / np.maximum(first_sample + spp, 1)).astype(np.float32)[..., None]
            with np.errstate(invalid="ignore"):  # a pixel that met a sample that is not finite
                change = np.where(share > 0, (means - state.means[:, pixels]) * share, 0)
            state.means[:, pixels] += change
            state.count[pixels] = after
            yield


def compile(scene: Scene, strategy: str = "mis") -> None:
    """Have the kernel of `extend` compiled, by a call for no samples."""
    state = start(scene)
    none = np.zeros((replicates.COUNT, 1), np.int32)
    _call(scene, _chunk(state), np.zeros(1, int), none, none, replicates.seeds(0), strategy)


def _chunk(state: State) -> int:
    """All calls have one shape, so one kernel; a small image is one call."""
    return min(CHUNK_PIXELS, len(state.count))


def _call(scene, chunk, pixels, first_sample, spp, seeds, strategy):
    """(R, n, 3) means of n <= chunk pixels, all replicates in one call; nan where spp is 0."""
    lacking = chunk - len(pixels)

    def padded(x, **how):
        return np.pad(x, ((0, 0), (0, lacking)), **how).ravel()

    tiled = padded(np.tile(pixels.astype(np.int32), (replicates.COUNT, 1)), mode="edge")
    numbers = (x.astype(np.uint32) for x in (padded(first_sample), padded(spp), np.repeat(seeds, chunk)))
    # Without the derivatives of `render_pixels`, whose machinery takes longer than a call of few samples.
    means = pixel_means(replace(scene, about=None), tiled, *numbers, strategy=strategy)
    return np.asarray(means, np.float32).reshape(replicates.COUNT, chunk, 3)[:, : len(pixels)]
