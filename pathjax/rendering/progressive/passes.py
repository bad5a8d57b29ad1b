"""A render in passes: something to look at soon, bounded memory, and a state that can be left and taken up again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import distributed, emitters
from pathjax.compile import MANY_ITEMS, calls_at_once, compiled, devices_of_a_call, native_map
from pathjax.integrators import pixel, reconstruction
from pathjax.integrators.options import Options
from pathjax.rendering.progressive import replicates
from pathjax.rendering.render import pixel_means
from pathjax.scene.parameters import nameless
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.sensors.film import Film

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
    chunk: int  # pixels of a call
    spp: int = 0  # mean samples of a pixel that the round was planned for
    seconds: float = 0.0  # spent rendering

    # What a checkpoint keeps, beside the means: one number for each pixel, or one for all.
    of_pixels: ClassVar[tuple[str, ...]] = ("count", "weights")

    def arrays(self) -> dict[str, np.ndarray]:
        """All but the means, which all processes have from the same calls."""
        return {name: getattr(self, name) for name in ("goal", *self.of_pixels)}

    def take(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in arrays.items():
            setattr(self, name, array)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """The image and its variance, (H W, 3) each."""
        return replicates.moments(self.means, self.count)

    def samples(self) -> np.ndarray:
        """(H W,) int32 of each pixel of the image."""
        return self.count

    def spread(self, weights: np.ndarray) -> None:
        """Let the samples of later rounds be spread as these weights (H, W) say."""
        self.weights = weights.ravel()

    def plan(self, spp: int) -> None:
        weights = replicates.one_if_equal(self.weights).astype(float)
        goal = weights * spp
        if (weights != 1).any():
            goal = np.rint(goal / replicates.COUNT) * replicates.COUNT
        self.goal = np.maximum(self.count, np.minimum(goal, np.iinfo(np.int32).max).astype(np.int32))
        self.spp = spp

    def resume(self, spp: int, chunk: int) -> None:
        """Go on with a round that a checkpoint has kept, of calls of so many pixels: any number gives the same bits."""
        self.plan(spp)

    def runs(self, missing: np.ndarray) -> Iterator[np.ndarray]:
        """Pixels of each call of the kernel, of those (n,) that miss samples: at most `chunk`."""
        return (missing[first : first + self.chunk] for first in range(0, missing.size, self.chunk))

    def more(self, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        """What the kernel takes beside the numbers of samples."""
        return ()

    def add(self, pixels: np.ndarray, before: np.ndarray, after: np.ndarray, means: np.ndarray) -> None:
        """Means (R, chunk, 3), the first those of the pixels, of what lies between two numbers of samples."""
        # Pixels that follow each other are a slice, which is many times faster.
        follow = pixels[-1] - pixels[0] == len(pixels) - 1
        here = slice(pixels[0], pixels[-1] + 1) if follow else pixels
        means = means[:, : len(pixels)]
        if before.any():
            begin, end = (replicates.shares(replicates.one_if_equal(count)) for count in (before, after))
            share = ((end - begin) / np.maximum(end, 1)).astype(np.float32)[..., None]
            with np.errstate(invalid="ignore"):  # a pixel that met a sample that is not finite
                change = means - self.means[:, here]
                change *= share
                self.means[:, here] += change
        else:
            # The same; but reading fresh memory before it is written stops all threads, page by page, at the write.
            self.means[:, here] = means
        self.count[here] = after


@dataclass
class SharedState(State):
    """The state of a film that shares samples: its pixels are those of `film.of_samples`, and its means are sums.

    A pixel's samples weigh `scale` each, so that in the end all pixels weigh the same, however many samples they have:
    the image is A / W of `reconstruction`. What is chosen for a round by the noise of earlier ones changes no mean.
    """

    # means: (R, N, 4) A and W of each replicate.
    scale: np.ndarray = field(kw_only=True)  # (N,) float32 weight of a sample of this round
    begun: np.ndarray = field(kw_only=True)  # (N,) int32 samples at the begin of this round
    film: Film = field(kw_only=True)

    of_pixels = "count", "weights", "goal", "scale", "begun"

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        sums = film.cropped(self.film, self.means)
        values, weights = sums[..., :3], sums[..., 3:]
        with np.errstate(invalid="ignore"):  # a pixel that met a sample that is not finite
            means = values / np.where(weights > 0, weights, 1)
        return replicates.moments(means, self.samples())

    def samples(self) -> np.ndarray:
        return film.cropped(self.film, self.count[None])[0]

    def spread(self, weights: np.ndarray) -> None:
        (self.weights,) = np.asarray(film.extended(self.film, weights[None]))

    def plan(self, spp: int) -> None:
        # What is missing of the weight that all pixels have in the end.
        missing = spp - self.spp + self.scale.astype(float) * (self.goal - self.count)
        wanted = self.weights * missing
        if (self.weights != 1).any():
            wanted = np.maximum(np.rint(wanted / replicates.COUNT), 1) * replicates.COUNT
        wanted = np.where(missing > 0, np.minimum(wanted, np.iinfo(np.int32).max - self.count), 0).astype(np.int32)
        self.goal, self.begun = self.count + wanted, self.count.copy()
        self.scale = (np.maximum(missing, 0) / np.maximum(wanted, 1)).astype(np.float32)
        self.spp = spp

    def resume(self, spp: int, chunk: int) -> None:
        # In the same runs: of others some would be half done, and sums would have another order.
        self.spp, self.chunk = spp, chunk  # the rest is as it was kept

    def runs(self, missing: np.ndarray) -> Iterator[np.ndarray]:
        """Runs of pixels; some of them may have all their samples."""
        for number in np.unique(missing // self.chunk):
            yield np.arange(number * self.chunk, min((number + 1) * self.chunk, len(self.count)), dtype=np.int32)

    def more(self, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        return (np.pad(self.scale[pixels], (0, self.chunk - len(pixels))),)

    def add(self, pixels: np.ndarray, before: np.ndarray, after: np.ndarray, means: np.ndarray) -> None:
        """Sums (R, chunk + 2 halo, 4), of which the first pixels lie before."""
        first = pixels[0] - reconstruction.halo(self.film)
        begin, end = max(first, 0), min(first + means.shape[1], len(self.count))
        self.means[:, begin:end] += means[:, begin - first : end - first]
        self.count[pixels[0] : pixels[-1] + 1] = after


def start(scene: Scene) -> State:
    count = film.pixel_count(film.of_samples(scene.film))
    none, one = np.zeros(count, np.int32), np.ones(count, np.float32)
    beside = none, none.copy(), one, _chunk(count)
    if not scene.film.shared:
        return State(np.zeros((replicates.COUNT, count, 3), np.float32), *beside)
    sums = np.zeros((replicates.COUNT, count, 4), np.float32)
    return SharedState(sums, *beside, scale=one.copy(), begun=none.copy(), film=scene.film)


def plan(state: State, spp: int) -> None:
    """Begin a round that ends with `spp` samples a pixel, on average; what a pixel has already it keeps."""
    state.plan(spp)
    state.take(distributed.of_first(state.arrays()))


def extend(
    scene: Scene, state: State, seed: int, options: Options, stopped: Callable[[], object] = lambda: False
) -> Iterator[bool]:
    """Render what is missing of the round; yields after every call of the kernel, when the state is whole: False where
    it was stopped.

    The samples of a pixel are added in portions that depend on its own count and goal alone, so that a state which was
    saved between two calls leads to the same bits.

    Args:
        stopped: asked before each call. Once it is true none begins; those that run are waited for.
    """
    kernel = compile(scene, options, state.chunk)

    def rendered(portion):
        numbers = np.zeros((3, state.chunk), np.int32)
        numbers[:, : len(portion[0])] = portion
        return np.asarray(kernel(numbers, np.uint32(seed), *state.more(portion[0])))

    for portion, means in distributed.dealt(rendered, _portions(state), stopped):
        if means is None:
            yield False
            return
        state.add(*portion, means)
        yield True


def _portions(state: State) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What lies between the state and its goal, portion by portion: pixels and their numbers of samples before and
    after, (n,) int32 each, n <= `state.chunk`."""
    # From where the round began, for sums of neighbouring runs depend on their order; what is there is left out.
    there = state.count.copy()
    planned = (state.begun if isinstance(state, SharedState) else state.count).copy()
    while (missing := np.flatnonzero(planned < state.goal).astype(np.int32)).size:
        for pixels in state.runs(missing):
            before, goal = planned[pixels], state.goal[pixels]
            least = _FIRST_SPP[np.searchsorted(_GOALS, replicates.one_if_equal(goal), side="right")]
            planned[pixels] = after = np.minimum(before + np.clip(3 * before, least, MAX_PASS_SPP), goal)
            if (after > there[pixels]).any():
                yield pixels, before, after


def compile(scene: Scene, options: Options, chunk: int) -> Callable:
    """The kernel of `extend`: (3, n) int32 of a chunk, the pixels and their numbers of samples before and after, and a
    seed -> means of each replicate over the samples between, 0 of none, (R, n, 3) float32. Of a film that shares
    samples: also what each weighs, (n,) float32 -> A and W of `reconstruction.sums`, (R, m, 4)."""
    # Without the derivatives of `render_pixels`, whose machinery takes longer than a call of few samples.
    scene = nameless(scene)
    arguments = scene, jax.ShapeDtypeStruct((3, chunk), np.int32), np.uint32(0)
    if scene.film.shared:
        scale = jax.ShapeDtypeStruct((chunk,), np.float32)
        kernel = compiled(_sums_of_replicates, *arguments, scale, options=replace(options, shared=True))
    else:
        kernel = compiled(_means_of_replicates, *arguments, options=options)
    # A compiled kernel, unlike a jitted function, does not ask for the calling thread's contexts, such as
    # `jax.enable_x64`.
    return partial(kernel, scene)


@partial(jax.jit, static_argnames="options")
def _means_of_replicates(scene, numbers, seed, *, options):
    pixels, before, after = numbers
    first_sample = replicates.shares(before)
    spp = replicates.shares(after) - first_sample
    unsigned = first_sample.ravel(), spp.ravel(), jnp.repeat(replicates.seeds(seed), len(pixels))
    work = jnp.tile(pixels, replicates.COUNT), *(x.astype(jnp.uint32) for x in unsigned)
    means = pixel_means(scene, *work, options=options, devices=devices_of_a_call())
    return means.reshape(*spp.shape, 3).astype(jnp.float32)


@partial(jax.jit, static_argnames="options")
def _sums_of_replicates(scene, numbers, seed, scale, *, options):
    pixels, before, after = numbers
    first_sample = replicates.shares(before)
    spp = replicates.shares(after) - first_sample
    seeds = jnp.broadcast_to(replicates.seeds(seed)[:, None], spp.shape)
    scales = jnp.broadcast_to(scale.astype(scene.camera.origin.dtype), spp.shape)
    run = pixels[0], first_sample.astype(jnp.uint32), spp.astype(jnp.uint32), seeds, scales
    choice = emitters.choice(scene.emitters, options.strategy)
    devices = devices_of_a_call()
    of_samples = partial(native_map, partial(pixel.mean, options=options), devices=devices)
    like = jax.ShapeDtypeStruct((3,), scales.dtype)
    sums, weights = reconstruction.sums(of_samples, like, run, scene, choice, options=options, devices=devices)
    return jnp.concatenate([sums, weights[..., None]], -1).astype(jnp.float32)


def _chunk(count: int) -> int:
    """Pixels of a call: all calls have one shape, so one kernel, and each of those that run at once gets as many."""
    at_once = calls_at_once() * distributed.count()
    calls = at_once * -(-count // (at_once * CHUNK_PIXELS))
    return min(count, max(-(-count // calls), _LEAST_CHUNK))
