"""Render in passes: an early image, bounded memory, and a state from which a render can resume."""

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

# Pixels in one call of the kernel, and most samples that it adds to each: enough that the overhead of a call is small,
# few enough that interrupts are handled at once. The schedule does not depend on time, so that images are reproducible.
CHUNK_PIXELS = 1 << 13
MAX_PASS_SPP = 48 * replicates.COUNT
# Samples per pixel of the first pass, few so that a whole image exists early. The second and third value apply to goals
# from _GOALS[0] and _GOALS[1] on.
_FIRST_SPP = replicates.COUNT * np.array([1, 4, 16], np.int32)
_GOALS = np.array([17, 256])
# A call with fewer items is another program, whose last bits may differ.
_LEAST_CHUNK = -(-MANY_ITEMS // replicates.COUNT)


@dataclass
class State:
    """Running means of the replicates, row by row over the image, and the goal of the current round."""

    means: np.ndarray  # (R, N, 3) float32
    count: np.ndarray  # (N,) int32 samples so far, of all replicates together
    goal: np.ndarray  # (N,) int32 samples at the end of this round
    weights: np.ndarray  # (N,) float32 of mean 1, distribution of samples over the pixels
    chunk: int  # pixels per call
    spp: int = 0  # mean samples per pixel that the round was planned for
    seconds: float = 0.0  # spent rendering

    # Fields in a checkpoint, besides the means: one value per pixel, or one for all.
    of_pixels: ClassVar[tuple[str, ...]] = ("count", "weights")

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays except the means, which are the same in all processes already."""
        return {name: getattr(self, name) for name in ("goal", *self.of_pixels)}

    def take(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in arrays.items():
            setattr(self, name, array)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the image and its variance, (H W, 3) each."""
        return replicates.moments(self.means, self.count)

    def samples(self) -> np.ndarray:
        """Return the samples per pixel of the image, (H W,) int32."""
        return self.count

    def spread(self, weights: np.ndarray) -> None:
        """Distribute the samples of later rounds by these weights (H, W)."""
        self.weights = weights.ravel()

    def plan(self, spp: int) -> None:
        weights = replicates.one_if_equal(self.weights).astype(float)
        goal = weights * spp
        if (weights != 1).any():
            goal = np.rint(goal / replicates.COUNT) * replicates.COUNT
        self.goal = np.maximum(self.count, np.minimum(goal, np.iinfo(np.int32).max).astype(np.int32))
        self.spp = spp

    def resume(self, spp: int, chunk: int) -> None:
        """Continue a round from a checkpoint. chunk: pixels per call there; here any number gives the same bits."""
        self.plan(spp)

    def runs(self, missing: np.ndarray) -> Iterator[np.ndarray]:
        """Return the pixels of each call of the kernel, at most `chunk`, from those (n,) that miss samples."""
        return (missing[first : first + self.chunk] for first in range(0, missing.size, self.chunk))

    def more(self, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the further arguments of the kernel."""
        return ()

    def add(self, pixels: np.ndarray, before: np.ndarray, after: np.ndarray, means: np.ndarray) -> None:
        """Add means (R, chunk, 3), which begin with those of the pixels, over the samples from `before` to `after`."""
        # Consecutive pixels are a slice, which is many times faster.
        follow = pixels[-1] - pixels[0] == len(pixels) - 1
        here = slice(pixels[0], pixels[-1] + 1) if follow else pixels
        means = means[:, : len(pixels)]
        if before.any():
            begin, end = (replicates.shares(replicates.one_if_equal(count)) for count in (before, after))
            share = ((end - begin) / np.maximum(end, 1)).astype(np.float32)[..., None]
            with np.errstate(invalid="ignore"):  # pixels with a non-finite sample
                change = means - self.means[:, here]
                change *= share
                self.means[:, here] += change
        else:
            # Equivalent. Reading fresh memory before it is written would stop all threads, page by page, at the write.
            self.means[:, here] = means
        self.count[here] = after


@dataclass
class SharedState(State):
    """State of a film that shares samples: its pixels are those of `film.of_samples`, and its means are sums.

    A pixel's samples weigh `scale` each, so that in the end all pixels weigh the same, however many samples they have:
    the image is A / W of `reconstruction`. Sample counts chosen from the noise of earlier rounds change no mean.
    """

    # means: (R, N, 4) A and W of each replicate.
    scale: np.ndarray = field(kw_only=True)  # (N,) float32 weight of a sample of this round
    begun: np.ndarray = field(kw_only=True)  # (N,) int32 samples at the start of this round
    film: Film = field(kw_only=True)

    of_pixels = "count", "weights", "goal", "scale", "begun"

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        sums = film.cropped(self.film, self.means)
        values, weights = sums[..., :3], sums[..., 3:]
        with np.errstate(invalid="ignore"):  # pixels with a non-finite sample
            means = values / np.where(weights > 0, weights, 1)
        return replicates.moments(means, self.samples())

    def samples(self) -> np.ndarray:
        return film.cropped(self.film, self.count[None])[0]

    def spread(self, weights: np.ndarray) -> None:
        (self.weights,) = np.asarray(film.extended(self.film, weights[None]))

    def plan(self, spp: int) -> None:
        # Missing part of the weight that all pixels have in the end.
        missing = spp - self.spp + self.scale.astype(float) * (self.goal - self.count)
        wanted = self.weights * missing
        if (self.weights != 1).any():
            wanted = np.maximum(np.rint(wanted / replicates.COUNT), 1) * replicates.COUNT
        wanted = np.where(missing > 0, np.minimum(wanted, np.iinfo(np.int32).max - self.count), 0).astype(np.int32)
        self.goal, self.begun = self.count + wanted, self.count.copy()
        self.scale = (np.maximum(missing, 0) / np.maximum(wanted, 1)).astype(np.float32)
        self.spp = spp

    def resume(self, spp: int, chunk: int) -> None:
        # Keep the same runs: others would be half done, and sums would have another order.
        self.spp, self.chunk = spp, chunk  # the rest is restored already

    def runs(self, missing: np.ndarray) -> Iterator[np.ndarray]:
        """Yield runs of consecutive pixels, some of which may have all their samples."""
        for number in np.unique(missing // self.chunk):
            yield np.arange(number * self.chunk, min((number + 1) * self.chunk, len(self.count)), dtype=np.int32)

    def more(self, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        return (np.pad(self.scale[pixels], (0, self.chunk - len(pixels))),)

    def add(self, pixels: np.ndarray, before: np.ndarray, after: np.ndarray, means: np.ndarray) -> None:
        """Add sums (R, chunk + 2 halo, 4), which begin `halo` before the first pixel."""
        first = pixels[0] - reconstruction.halo(self.film)
        begin, end = max(first, 0), min(first + means.shape[1], len(self.count))
        self.means[:, begin:end] += means[:, begin - first : end - first]
        self.count[pixels[0] : pixels[-1] + 1] = after


def start(scene: Scene) -> State:
    count = film.pixel_count(film.of_samples(scene.film))
    none, one = np.zeros(count, np.int32), np.ones(count, np.float32)
    beside = none, none.copy(), one, pixels_per_call(count, calls_at_once() * distributed.count())
    if not scene.film.shared:
        return State(np.zeros((replicates.COUNT, count, 3), np.float32), *beside)
    sums = np.zeros((replicates.COUNT, count, 4), np.float32)
    return SharedState(sums, *beside, scale=one.copy(), begun=none.copy(), film=scene.film)


def plan(state: State, spp: int) -> None:
    """Begin a round that ends with `spp` samples per pixel, on average; pixels keep the samples that they have."""
    state.plan(spp)
    state.take(distributed.of_first(state.arrays()))


def extend(
    scene: Scene, state: State, seed: int, options: Options, stopped: Callable[[], object] = lambda: False
) -> Iterator[bool]:
    """Render the missing part of the round. Yield after every call of the kernel, when the state is consistent: True,
    or False if it was stopped.

    The samples of a pixel are added in portions that depend only on its own count and goal, so that a state saved
    between two calls continues to the same bits.

    Args:
        stopped: called before each kernel call. Once it is true no call starts; running ones are awaited.
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
    """Yield the portions between the state and its goal: pixels and their sample counts before and after, (n,) int32
    each, n <= `state.chunk`."""
    # Start where the round began, since sums of neighbouring runs depend on their order; skip portions already there.
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
    """Return the compiled kernel of `extend`: (3, n) int32 pixels and their sample counts before and after, and a seed
    -> means of each replicate over the samples between, (R, n, 3) float32, 0 if there are none. For a film that shares
    samples it also takes the weight of a sample, (n,) float32, and returns A and W of `reconstruction.sums`, (R, m, 4).
    """
    # Without the derivatives of `render_pixels`, whose overhead is longer than a call of few samples.
    scene = nameless(scene)
    arguments = scene, jax.ShapeDtypeStruct((3, chunk), np.int32), np.uint32(0)
    if scene.film.shared:
        scale = jax.ShapeDtypeStruct((chunk,), np.float32)
        kernel = compiled(_sums_of_replicates, *arguments, scale, options=replace(options, shared=True))
    else:
        kernel = compiled(_means_of_replicates, *arguments, options=options)
    # A compiled kernel, unlike a jitted function, ignores the calling thread's contexts, such as `jax.enable_x64`.
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


def pixels_per_call(count: int, at_once: int) -> int:
    """Return the pixels per call: all calls have one shape, so one kernel, and concurrent calls get equally many."""
    calls = at_once * -(-count // (at_once * CHUNK_PIXELS))
    return min(count, max(-(-count // calls), _LEAST_CHUNK))
