"""Render until an error, a time limit or a number of samples is reached; nothing is lost when it is stopped."""

from __future__ import annotations

import math
import operator
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pathjax import distributed
from pathjax.compile import standard_promotion
from pathjax.errors import InputError
from pathjax.integrators.options import Options, check_counts
from pathjax.rendering.progressive import error_estimate, passes, replicates
from pathjax.rendering.progressive.checkpoint import Checkpoint, identity
from pathjax.scene.alike import fingerprint
from pathjax.scene.ladder import padded
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.system.interrupts import Interrupts

# Samples of every pixel before sample counts may differ between pixels.
PILOT_SPP = 16
# A round multiplies the samples by at most MOST_GROWTH and at least LEAST_GROWTH. Near the target it multiplies by the
# predicted missing factor to the power CAUTION, so as not to overshoot.
MOST_GROWTH, LEAST_GROWTH, CAUTION = 2.0, 1.05, 0.75
MAX_SPP = 2**31 - 1
# Reasons to leave a round early.
REASONS = None, "time limit", "interrupted"
UNKNOWN = error_estimate.ImageError(math.nan, math.nan)


@dataclass(frozen=True)
class RenderResult:
    """An image and its estimated error."""

    image: np.ndarray  # (H, W, 3) float32
    standard_error: np.ndarray  # (H, W, 3) float32 of the image; nan where a pixel has fewer than 2 samples
    spp: float  # mean over the pixels
    samples: np.ndarray  # (H, W) int32 per pixel
    compile_seconds: float  # of this call
    run_seconds: float  # of all calls that shared the checkpoint
    error: float  # estimate of `images.relative_error` over the finite pixels; nan if there is no estimate
    error_bound: float  # exceeded by the error in some 5 % of renders; compared with the target
    reason: str  # why it ended: "target error", "time limit", "spp", "interrupted", "no estimate"


@standard_promotion
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

    The error is sqrt(mean((I - R)^2 / (R^2 + 0.01 L^2))) of the image I against the truth R, where L is the level of R:
    the mean of its lit pixels without the brightest quarter, such as lamps in view (`images.level`). So 0.02 is 2 % in
    any unit of radiance. It is estimated as long as float32 holds the radiances, some 1e-31 to 1e36. An image that is
    black, darker than that or not finite never counts as on target. If no other limit would end the render, it then
    ends with the reason "no estimate", after the pilot or when the finite pixels are on target.

    The image is the mean of independent replicates, so it differs from that of `render` for the same seed. If only
    `spp` is given, all pixels get equally many samples. Otherwise, after a pilot, noisy neighbourhoods get more: see
    `error_estimate.sample_weights`. Either way the image is unbiased up to the scene's max_depth. The same arguments
    give the same image, bit for bit, unless a time limit or an interrupt ended it.

    Args:
        target_error: the error to reach; it counts as reached when the upper bound of the estimate is no higher.
        time_limit: seconds of rendering. Compilation, which cannot be interrupted, is not counted.
        spp: most samples per pixel, on average.
        seed: other seeds give independent images.
        strategy: as for `render`.
        checkpoint: a .npz file in which the state is saved, at intervals, when interrupted and at the end. If it
            exists, the render continues from there. A render that was killed at any moment and called again gives the
            image of an undisturbed run.
        progress: show a bar on stderr.
    Raises:
        InputError: an argument is out of range, or no limit is given; the checkpoint is of another render, is damaged
            or cannot be written.
        KeyboardInterrupt: Ctrl-C while the kernel compiles. Later, Ctrl-C, SIGTERM and SIGHUP end the render, which
            returns the image so far (in the main thread only, since Python handles signals nowhere else).
    Warns:
        InputWarning: the checkpoint cannot be written after rendering has begun. The image is returned, and the last
            checkpoint that was written is intact.
    """
    render = Render(scene, target_error, time_limit, spp, seed, strategy, checkpoint)
    render.compile()
    return render.run(progress)


class Render:
    """The steps of `render_until`: check the arguments and load the checkpoint, compile, run."""

    def __init__(self, scene, target_error, time_limit, spp, seed, strategy, checkpoint):
        _check(target_error, time_limit, spp)
        self.options = Options(strategy)
        check_counts(MAX_SPP if spp is None else spp, seed)
        self.options.check_strategy(scene)
        # Padded, so that other scenes, in a batch or not, find this one's kernel in the cache.
        self.scene, self.seed = padded(scene), operator.index(seed)
        self.target_error, self.time_limit = target_error, time_limit
        self.spp = MAX_SPP if spp is None else int(spp)
        self.compile_seconds = 0.0
        adaptive = target_error is not None or time_limit is not None
        self.state, self.checkpoint = passes.start(scene), None
        if checkpoint is not None:
            self.checkpoint = Checkpoint(checkpoint, identity(scene, self.seed, strategy, adaptive))
            self.state = self.checkpoint.load(self.state)
            self.checkpoint.save(self.state)
        if distributed.count() > 1:
            limits = target_error, time_limit, spp, seed, strategy
            distributed.same({"scene": fingerprint(scene), "limit, seed or strategy": fingerprint(limits)})
            self._agree()
        if not adaptive or self.state.spp > self.spp:
            passes.plan(self.state, self.spp)
        elif not self.state.spp:
            passes.plan(self.state, min(PILOT_SPP, self.spp))

    def _agree(self) -> None:
        """Start from the state of the first process, the only one that needs access to the checkpoint."""
        state = self.state
        facts = np.int32(state.spp), np.int32(state.chunk), np.float32(state.seconds)
        (spp, chunk, seconds), state.means = distributed.of_first((facts, state.means))
        state.take(distributed.of_first(state.arrays()))
        state.spp, state.chunk, state.seconds = int(spp), int(chunk), float(seconds)

    def compile(self) -> None:
        started = time.perf_counter()
        passes.compile(self.scene, self.options, self.state.chunk)
        self.compile_seconds += time.perf_counter() - started

    def run(self, progress: bool = False) -> RenderResult:
        with Interrupts() as interrupts, _bar(progress) as show:
            reason, found = self._run(interrupts, show)
            with ThreadPoolExecutor(1) as beside:
                saved = beside.submit(self.checkpoint.keep, self.state) if self.checkpoint is not None else None
                result = self._result(reason, found or self._evaluate())
                if saved is not None:
                    saved.result()
        return result

    def _run(self, interrupts, show) -> tuple[str, tuple | None]:
        """Extend the state until there is a reason to stop. Its evolution depends on itself alone, not on time.

        Returns:
            the reason, and the result of `_evaluate` if it is known.
        """
        state, error = self.state, UNKNOWN
        started = time.perf_counter() - state.seconds

        def stopped():
            if interrupts.heard:
                return "interrupted"
            # state.seconds is 0 before the first call, so something is rendered however short the limit.
            if self.time_limit is not None and state.seconds and time.perf_counter() - started >= self.time_limit:
                return "time limit"
            return None

        while True:
            for goes_on in passes.extend(self.scene, state, self.seed, self.options, stopped):
                state.seconds = time.perf_counter() - started
                if self.checkpoint is not None:
                    self.checkpoint.save_if_due(state)
                show(self, error)
                if not goes_on:
                    return REASONS[distributed.highest(REASONS.index(stopped()))], None
            if state.spp >= self.spp:
                return "spp", None
            image, variance, error = found = self._evaluate()
            if self._on_target(error):
                return "target error", found
            if math.isnan(error.bound) and self.spp == MAX_SPP and self.time_limit is None:
                return "no estimate", found
            if state.spp == PILOT_SPP:
                state.spread(error_estimate.sample_weights(image, variance))
            passes.plan(state, min(_next_spp(state.spp, error, self.target_error), self.spp))

    def _on_target(self, error: error_estimate.ImageError) -> bool:
        return self.target_error is not None and error.bound <= self.target_error

    def _evaluate(self) -> tuple[np.ndarray, np.ndarray, error_estimate.ImageError]:
        """Return the image and its variance, (H, W, 3) each, and its error."""
        shape = (*film.image_shape(self.scene.film), 3)
        image, variance = (x.reshape(shape) for x in self.state.moments())
        # The error of the image is unknown while that of some pixels is.
        known = self.state.count.min() >= 2
        alike = float(np.square(film.correlation(self.scene.film)).sum())
        return image, variance, error_estimate.image_error(image, variance, alike) if known else UNKNOWN

    def _result(self, reason, found) -> RenderResult:
        image, variance, error = found
        count = self.state.samples().reshape(image.shape[:2])
        if reason != "interrupted" and self._on_target(error):
            reason = "target error" if np.isfinite(image).all() else "no estimate"
        standard_error = error_estimate.standard_error(image, variance, count)
        seconds = self.compile_seconds, self.state.seconds
        return RenderResult(image, standard_error, float(count.mean()), count, *seconds, *error, reason)


def _check(target_error, time_limit, spp) -> None:
    if target_error is None and time_limit is None and spp is None:
        raise InputError("nothing to stop at; give target_error, time_limit or spp")
    for name, value in (("target_error", target_error), ("time_limit", time_limit)):
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise InputError(f"{name} = {value}; it must be positive and finite")


def _next_spp(spp: int, error: error_estimate.ImageError, target: float | None) -> int:
    if spp < PILOT_SPP:
        return PILOT_SPP
    growth = MOST_GROWTH
    if target is not None and math.isfinite(error.bound):
        lacking = (error.bound / target) ** 2
        growth = min(max(lacking**CAUTION, LEAST_GROWTH), MOST_GROWTH)
    return spp + math.ceil(spp * (growth - 1) / replicates.COUNT) * replicates.COUNT


@contextmanager
def _bar(wanted: bool) -> Iterator:
    """Yield a function (Render, error at the end of the last round) that displays the progress.

    Errors of the display do not end the render.
    """
    if not wanted:
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("rendering"), BarColumn(), TextColumn("{task.fields[status]}"), TimeRemainingColumn()
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task("", total=1.0, status="")

    def show(render: Render, error: error_estimate.ImageError) -> None:
        spp = render.state.count.mean()
        status = f"{spp:.4g} spp"
        if math.isfinite(error.estimate):
            status += f"  error {error.estimate:.2%}"
        with suppress(Exception):
            bar.update(task, completed=_share_done(render, spp, error), status=status)

    with suppress(Exception):
        bar.start()
    try:
        yield show
    finally:
        with suppress(Exception):
            bar.stop()


def _share_done(render: Render, spp: float, error: error_estimate.ImageError) -> float:
    shares = [spp / render.spp]
    if render.time_limit is not None:
        shares.append(render.state.seconds / render.time_limit)
    if render.target_error is not None and error.bound > 0:
        shares.append(spp / max(render.state.spp * (error.bound / render.target_error) ** 2, 1))
    return min(max(shares), 1.0)
