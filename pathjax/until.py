"""Render until an error is reached, a time is over or samples are spent; nothing is lost when it is stopped."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pathjax import estimate, film, progressive, replicates
from pathjax.checkpoint import Checkpoint, identity
from pathjax.errors import InputError
from pathjax.integrators import path
from pathjax.progressive import State
from pathjax.scene import Scene

# Samples of every pixel before their number may differ.
PILOT_SPP = 16
# A round multiplies the samples by at most MOST_GROWTH. Near the target it takes this power of what is predicted to be
# lacking, so as not to pass it by, but never less than LEAST_GROWTH.
MOST_GROWTH, LEAST_GROWTH, CAUTION = 2.0, 1.05, 0.75
MAX_SPP = 2**31 - 1


@dataclass(frozen=True)
class RenderResult:
    """An image and how wrong it is."""

    image: np.ndarray  # (H, W, 3) float32
    standard_error: np.ndarray  # (H, W, 3) float32 of the image; nan where a pixel has fewer than 2 samples
    spp: float  # mean over the pixels
    samples: np.ndarray  # (H, W) int32 of each pixel
    compile_seconds: float  # of this call
    run_seconds: float  # of all calls that shared the checkpoint
    error: float  # estimate of sqrt(relMSE), relMSE = mean((I - R)^2 / (R^2 + 0.01)); nan before the second sample
    error_bound: float  # that the error exceeds in some 5 % of renders; what is compared with the target
    reason: str  # why it ended: "target error", "time limit", "spp", "interrupted"


def render_until(
    scene: Scene,
    target_error: float | None = None,
    time_limit: float | None = None,
    spp: int | None = None,
    seed: int = 0,
    strategy: str = "mis",
    checkpoint: str | Path | None = None,
    progress: bool = False,
) -> RenderResult:
    """Render until the first of three limits is reached.

    The image is the mean of independent replicates, so not that of `render` for the same seed. With `spp` alone all
    pixels get as many samples; else, after a pilot, noisy neighbourhoods get more (`estimate.sample_weights`). Either
    way the image is unbiased up to the scene's max_depth. The same arguments give the same image, bit for bit, unless a
    time limit or an interrupt ended it.

    Args:
        target_error: of sqrt(relMSE). Reached when the upper bound of its estimate is below.
        time_limit: seconds of rendering; compilation, which nothing can cut short, comes on top.
        spp: most samples per pixel, on average.
        checkpoint: a .npz file to save the state in, at intervals, when interrupted and at the end. Where it exists
            the render goes on from there; killed at any moment and called again, it gives the image of an undisturbed
            run.
        progress: show a bar on stderr.
    Raises:
        InputError: an argument is out of range, or nothing to stop at is given; a checkpoint of another render, a
            damaged one, or one that cannot be written (before rendering starts, where that can be known).
        KeyboardInterrupt: interrupted before the first samples. Later, Ctrl-C and SIGTERM end the render and return
            what is done (in the main thread; while the kernel compiles, they are heard afterwards).
    """
    _check(target_error, time_limit, spp)
    path.check_sampling(strategy, MAX_SPP if spp is None else spp, seed)
    adaptive = target_error is not None or time_limit is not None
    state = progressive.start(scene)
    progressive.plan(state, min(PILOT_SPP, spp or MAX_SPP) if adaptive else spp)
    store = None
    if checkpoint is not None:
        store = Checkpoint(checkpoint, identity(scene, seed, strategy, adaptive))
        state = store.load(state)
        store.save(state)
    if not adaptive and spp > state.spp:
        progressive.plan(state, spp)
    limits = _Limits(target_error, time_limit, spp or MAX_SPP)

    with _Interrupts() as interrupts, _bar(progress) as show:
        started = time.perf_counter()
        progressive.compile(scene, strategy)
        compile_seconds = time.perf_counter() - started
        reason = _run(scene, state, seed, strategy, limits, interrupts, store, show)
    if store is not None:
        store.save(state)
    if not state.count.any():
        raise KeyboardInterrupt
    return _result(scene, state, compile_seconds, reason)


@dataclass(frozen=True)
class _Limits:
    error: float | None
    seconds: float | None
    spp: int


def _check(target_error, time_limit, spp) -> None:
    if target_error is None and time_limit is None and spp is None:
        raise InputError("nothing to stop at; give target_error, time_limit or spp")
    for name, value in (("target_error", target_error), ("time_limit", time_limit)):
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise InputError(f"{name} = {value}; it must be positive and finite")
    if spp is not None and not (isinstance(spp, int | np.integer) and 1 <= spp <= MAX_SPP):
        raise InputError(f"spp = {spp}; it must be an integer in [1, 2^31)")


def _run(scene, state: State, seed, strategy, limits: _Limits, interrupts, store, show) -> str:
    """Extend the state until there is a reason to stop. What a round does depends on the state alone, never on time."""
    shape = (*film.image_shape(scene.film), 3)
    earlier, started = state.seconds, time.perf_counter()
    error = estimate.ImageError(math.nan, math.nan)
    while True:
        calls = progressive.extend(scene, state, seed, strategy)
        while True:
            if interrupts.heard:
                return "interrupted"
            if limits.seconds is not None and state.seconds >= limits.seconds:
                return "time limit"
            if next(calls, state) is state:
                break
            state.seconds = earlier + time.perf_counter() - started
            if store is not None:
                store.save_if_due(state)
            show(state, limits, error)
        image, variance = state.image().reshape(shape), state.variance().reshape(shape)
        error = estimate.image_error(image, variance)
        if limits.error is not None and error.bound <= limits.error:
            return "target error"
        if state.spp >= limits.spp:
            return "spp"
        if state.spp == PILOT_SPP:
            state.weights = estimate.sample_weights(image, variance).ravel()
        progressive.plan(state, _next_spp(state.spp, error, limits))


def _next_spp(spp: int, error: estimate.ImageError, limits: _Limits) -> int:
    growth = MOST_GROWTH
    if limits.error is not None and math.isfinite(error.bound):
        lacking = (error.bound / limits.error) ** 2
        growth = min(max(lacking**CAUTION, LEAST_GROWTH), MOST_GROWTH)
    step = math.ceil(spp * (growth - 1) / replicates.COUNT) * replicates.COUNT
    return min(spp + step, limits.spp)


def _result(scene, state: State, compile_seconds, reason) -> RenderResult:
    height, width = film.image_shape(scene.film)
    image = state.image().reshape(height, width, 3)
    variance = state.variance().reshape(height, width, 3)
    # While some pixels know nothing of their error, neither does the image.
    error = estimate.ImageError(math.nan, math.nan) if state.count.min() < 2 else estimate.image_error(image, variance)
    return RenderResult(
        image,
        estimate.standard_error(variance),
        float(state.count.mean()),
        state.count.reshape(height, width),
        compile_seconds,
        state.seconds,
        *error,
        reason,
    )


class _Interrupts:
    """Within it Ctrl-C and SIGTERM are only noted, so that no state is left half changed; a second one acts as ever."""

    heard = False

    def __enter__(self):
        self._earlier = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._earlier[number] = signal.signal(number, self._hear)
        return self

    def _hear(self, number, frame):
        self.heard = True
        self._restore()

    def __exit__(self, *_):
        self._restore()

    def _restore(self):
        while self._earlier:
            number, handler = self._earlier.popitem()
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def _bar(wanted: bool) -> Iterator:
    """A function (state, limits, error of the last round) that shows how far the render is."""
    if not wanted:
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[status]}"), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("compiling", total=1.0, status="")

        def show(state: State, limits: _Limits, error: estimate.ImageError) -> None:
            spp = state.count.mean()
            status = f"{spp:.4g} spp"
            if math.isfinite(error.estimate):
                status += f"  error {error.estimate:.2%}"
            done = _share_done(state, spp, limits, error)
            bar.update(task, completed=done, description="rendering", status=status)

        yield show


def _share_done(state: State, spp, limits: _Limits, error: estimate.ImageError) -> float:
    shares = [spp / limits.spp]
    if limits.seconds is not None:
        shares.append(state.seconds / limits.seconds)
    if limits.error is not None and error.bound > 0:
        shares.append(spp / max(state.spp * (error.bound / limits.error) ** 2, 1))
    return min(max(shares), 1.0)
