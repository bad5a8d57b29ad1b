"""Rendering of the jobs of a batch, one after another; next scenes are loaded while the current one is rendered."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from pathjax.batch import jobs as job_lists
from pathjax.batch.jobs import Job
from pathjax.errors import InputError
from pathjax.io import picture
from pathjax.io.load import load_scene
from pathjax.rendering.progressive.until import Render
from pathjax.scene.parameters import with_parameters
from pathjax.scene.scene import Scene
from pathjax.system.files import check_room
from pathjax.system.interrupts import Interrupts
from pathjax.system.output import say

# Number of scenes that are loaded ahead.
_AHEAD = 2
# Seconds between lines of progress if there is no bar.
_SECONDS_BETWEEN_LINES = 60


@dataclass(frozen=True)
class Outcome:
    """Outcome of one job."""

    job: Job
    output: Path
    status: str  # "done"; "skipped": the output existed; "failed"; "unwritten"; "waiting": the batch ended before it
    message: str = ""  # why it failed, which limit it missed, or that its output is old; with the place of the job
    spp: float = 0.0
    error: float = math.nan  # of `RenderResult`
    load_seconds: float = 0.0
    compile_seconds: float = 0.0  # close to 0 if an earlier scene has compiled the kernel
    run_seconds: float = 0.0


def render_batch(
    jobs: str | os.PathLike | Iterable[Mapping],
    folder: str | os.PathLike = ".",
    *,
    part: tuple[int, int] = (0, 1),
    progress: bool | Callable[[Outcome], None] = False,
) -> list[Outcome]:
    """Render many scenes to image files. Scenes of one structure share a kernel, regardless of their triangle counts.

    Images are bitwise equal to those of `render_until` with the limits of the job. A job whose output exists is
    skipped, so that a batch that was stopped or killed continues when it is called again; its outcome has a message if
    the output is older than the scene file. Outputs appear whole or not at all. A job that fails does not end the
    others, but an output that cannot be written does, as the rest would be lost too.

    Args:
        jobs: a file of JSON Lines, or mappings: each with the keys of `Job`. Scenes are relative to the file's folder;
            those of mappings to the current one.
        folder: for outputs; created if missing, like folders within it.
        part: (I, N): only every N-th job, beginning with the I-th, from 0, so that N processes share a batch.
        progress: True for a bar on stderr, or a function that is called with each outcome.
    Returns:
        The outcome of each job of this part. Ctrl-C ends the batch, and drops the image in progress.
    Raises:
        InputError: the list of jobs is wrong (the message names the place), or the folder cannot be created or written
            to; nothing was rendered.
    """
    if isinstance(jobs, str | os.PathLike):
        listed, beside = job_lists.read(jobs, folder), Path(jobs).parent
    else:
        listed, beside = job_lists.checked(((f"job {number}", job) for number, job in enumerate(jobs)), folder), Path()
    index, parts = part
    if not 0 <= index < parts:
        raise InputError(f"part = {part}; (I, N) is part I of N, from 0 to N - 1")
    mine, folder = listed[index::parts], Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: the folder cannot be made: {error.strerror or error}") from None
    check_room(folder)
    outcomes: list[Outcome] = []
    with Interrupts() as interrupts, _reporting(progress, len(mine)) as report, ThreadPoolExecutor(1) as thread:
        for job, output, scene in _loaded(mine, beside, folder, thread):
            outcome = _outcome(job, output, scene, interrupts) if scene else _skipped(job, output, beside)
            if outcome is not None:
                outcomes.append(outcome)
                report(outcome)
            if outcome is None or outcome.status == "unwritten":
                thread.shutdown(cancel_futures=True)
                break
    return outcomes + [Outcome(job, folder / job.output, "waiting") for job in mine[len(outcomes) :]]


def _loaded(jobs: list[Job], beside: Path, folder: Path, thread: ThreadPoolExecutor) -> Iterator:
    """Yield jobs, outputs and futures of their scenes, None if the output exists, while loading some scenes ahead."""
    waiting: deque[tuple[Job, Path, Future | None]] = deque()
    for job in jobs:
        output = folder / job.output
        waiting.append((job, output, None if output.exists() else thread.submit(_load, job, beside)))
        if len(waiting) > _AHEAD:
            yield waiting.popleft()
    yield from waiting


def _skipped(job: Job, output: Path, beside: Path) -> Outcome:
    try:
        old = output.stat().st_mtime < (beside / job.scene).stat().st_mtime
    except OSError:  # one of them is gone, which does not matter for a job that is done
        old = False
    note = f"{job.place}: {output} is older than {job.scene}, and kept; delete it to have it rendered anew"
    return Outcome(job, output, "skipped", note if old else "")


def _load(job: Job, beside: Path) -> tuple[Scene, float]:
    started = time.perf_counter()
    scene = load_scene(beside / job.scene, sensor=job.sensor, parameters=job.parameters)
    return with_parameters(scene, job.set), time.perf_counter() - started


def _outcome(job: Job, output: Path, loading: Future, interrupts: Interrupts) -> Outcome | None:
    """Render a job and write its image; None: a signal came before the image was complete."""
    if interrupts.heard:
        return None
    try:
        scene, load_seconds = loading.result()
        no_limit = job.spp is None and job.error is None and job.time is None
        spp = scene.about.description.view.spp if no_limit else job.spp
        render = Render(scene, job.error, job.time, spp, job.seed, job.strategy, None)
        render.compile()
        result = render.run()
    except Exception as error:  # whatever it is, the other jobs go on
        return Outcome(job, output, "failed", f"{job.place}: {error or type(error).__name__}")
    if result.reason == "interrupted":
        return None
    figures = result.spp, result.error, load_seconds, result.compile_seconds, result.run_seconds
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        made_of = {"scene": job.scene, "parameters": {**job.parameters, **job.set}, "seed": job.seed}
        picture.write(output, result, {}, **made_of)
    except (InputError, OSError) as error:
        return Outcome(job, output, "unwritten", f"{job.place}: {error}; the batch ends here", *figures)
    if job.error is not None and result.reason != "target error":
        missed = f"{job.place}: its error is {result.error_bound:.3g}, not yet {job.error:g}"
        return Outcome(job, output, "done", missed, *figures)
    return Outcome(job, output, "done", "", *figures)


@contextmanager
def _reporting(progress: bool | Callable[[Outcome], None], count: int) -> Iterator[Callable[[Outcome], None]]:
    """Context of a function that shows outcomes as they come: by a bar, or by lines if stderr is not a terminal."""
    if progress is not True:
        yield progress or (lambda outcome: None)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    started = reported = time.monotonic()
    seen, rendered = 0, 0
    console = Console(stderr=True)
    columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}")
    bar = Progress(*columns, console=console, transient=True) if console.is_terminal else None
    with bar or nullcontext():
        task = bar and bar.add_task("", total=count)

        def report(outcome: Outcome) -> None:
            nonlocal reported, seen, rendered
            seen, rendered, now = seen + 1, rendered + (outcome.status != "skipped"), time.monotonic()
            left = f"{_time((now - started) / max(rendered, 1) * (count - seen))} left"
            if outcome.message:
                say(outcome.message)
            if bar:
                bar.update(task, advance=1, description=f"{outcome.output.name}  {left}")
            elif now - reported >= _SECONDS_BETWEEN_LINES:
                reported = now
                say(f"{seen} of {count} jobs, about {left}")

        yield report


def _time(seconds: float) -> str:
    units = (1, "s"), (60, "min"), (3600, "h")
    size, unit = next((each for each in units if seconds < 120 * each[0]), units[-1])
    return f"{seconds / size:.0f} {unit}"
