"""A render in passes: something to look at soon, bounded memory, and a state that can be left and taken up again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import MANY_ITEMS, calls_at_once, concurrently, devices_of_a_call
from pathjax.integrators.options import DEFAULTS, Options
from pathjax.rendering.progressive import replicates
from pathjax.rendering.render import pixel_means
from pathjax.scene.parameters import nameless
from pathjax.scene.scene import Scene
from pathjax.sensors import film

# Pixels in one call of the kernel and samples that it adds to each at most: so many that the call costs little, so few
# that an interrupt is heard at once. The schedule is fixed, not timed, so that the same command gives the same image.
CHUNK_PIXELS = 1 << 13
MAX_PASS_SPP = 48 * replicates.COUNT
# Samples of the first pass over the image, so that there is soon a whole picture, and the goals from which on it is the
# second and the third of them.
_FIRST_SPP = replicates.COUNT * np.array([1, 4, 16], np.int32)
_GOALS = np.array([17, 256])
# A call of few items is another program, whose last bits may differ.
_LEAST_CHUNK = -(-MANY_ITEMS // replicates.COUNT)


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
    weights = replicates.one_if_equal(state.weights).astype(float)
    goal = weights * spp
    if (weights != 1).any():
        goal = np.rint(goal / replicates.COUNT) * replicates.COUNT
    state.goal = np.maximum(state.count, np.minimum(goal, np.iinfo(np.int32).max).astype(np.int32))
    state.spp = spp


def extend(
    scene: Scene, state: State, seed: int, options: Options, stopped: Callable[[], object] = lambda: False
) -> Iterator[None]:
    """Render what is missing of the round; yields after every call of the kernel, when the state is whole.

    The samples of a pixel are added in portions that depend on its own count and goal alone, so that a state which was
    saved between two calls leads to the same bits.

    Args:
        stopped: asked by other threads before each call. Once it is true none begins; those that run are waited for.
    """
    kernel, chunk = compile(scene, options), _chunk(scene)

    def rendered(portion):
        if stopped():
            return None
        numbers = np.zeros((3, chunk), np.int32)
        numbers[:, : len(portion[0])] = portion
        return np.asarray(kernel(numbers, np.uint32(seed)))[:, : len(portion[0])]

    for portion, means in concurrently(rendered, _portions(state, chunk)):
        if means is None:
            yield
            return
        _add(state, *portion, means)
        yield


def _add(state: State, pixels, before, after, means) -> None:
    """Means (R, n, 3) of what lies between two numbers of samples."""
    # Pixels that follow each other are a slice, which is many times faster.
    follow = pixels[-1] - pixels[0] == len(pixels) - 1
    here = slice(pixels[0], pixels[-1] + 1) if follow else pixels
    if before.any():
        begin, end = (replicates.shares(replicates.one_if_equal(count)) for count in (before, after))
        share = ((end - begin) / np.maximum(end, 1)).astype(np.float32)[..., None]
        with np.errstate(invalid="ignore"):  # a pixel that met a sample that is not finite
            change = means - state.means[:, here]
            change *= share
            state.means[:, here] += change
    else:
        # The same; but reading fresh memory before it is written stops all threads, page by page, at the write.
        state.means[:, here] = means
    state.count[here] = after


def _portions(state: State, chunk: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What lies between the state and its goal, portion by portion: pixels and their numbers of samples before and
    after, (n,) int32 each, n <= chunk."""
    planned = state.count.copy()
    while (missing := np.flatnonzero(planned < state.goal).astype(np.int32)).size:
        for first in range(0, missing.size, chunk):
            pixels = missing[first : first + chunk]
            before, goal = planned[pixels], state.goal[pixels]
            least = _FIRST_SPP[np.searchsorted(_GOALS, replicates.one_if_equal(goal), side="right")]
            planned[pixels] = after = np.minimum(before + np.clip(3 * before, least, MAX_PASS_SPP), goal)
            yield pixels, before, after


def compile(scene: Scene, options: Options = DEFAULTS) -> Callable:
    """The kernel of `extend`: (3, n) int32 of a chunk, the pixels and their numbers of samples before and after, and a
    seed -> means of each replicate over the samples between, 0 of none, (R, n, 3) float32."""
    # Without the derivatives of `render_pixels`, whose machinery takes longer than a call of few samples.
    scene = nameless(scene)
    numbers = jax.ShapeDtypeStruct((3, _chunk(scene)), np.int32)
    # JAX keeps what it has compiled. A compiled kernel, unlike a jitted function, does not ask for the calling thread's
    # contexts, such as `jax.enable_x64`.
    return partial(_replicate_means.lower(scene, numbers, np.uint32(0), options=options).compile(), scene)


@partial(jax.jit, static_argnames="options")
def _replicate_means(scene, numbers, seed, *, options):
    pixels, before, after = numbers
    first_sample = replicates.shares(before)
    spp = replicates.shares(after) - first_sample
    unsigned = first_sample.ravel(), spp.ravel(), jnp.repeat(replicates.seeds(seed), len(pixels))
    work = jnp.tile(pixels, replicates.COUNT), *(x.astype(jnp.uint32) for x in unsigned)
    means = pixel_means(scene, *work, options=options, devices=devices_of_a_call())
    return means.reshape(*spp.shape, 3).astype(jnp.float32)


def _chunk(scene: Scene) -> int:
    """Pixels of a call: all calls have one shape, so one kernel, and each of those that run at once gets as many."""
    count, at_once = film.pixel_count(scene.film), calls_at_once()
    calls = at_once * -(-count // (at_once * CHUNK_PIXELS))
    return min(count, max(-(-count // calls), _LEAST_CHUNK))
