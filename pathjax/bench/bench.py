"""`pathjax bench`: speed against error beside a peer, and what strategies, sampler and precision are worth.

Efficiency is 1 / (relMSE x seconds), relMSE against a converged reference of pathjax's own with other seeds.
"""

from __future__ import annotations

import platform
from pathlib import Path

import jax

import pathjax
from pathjax.bench import peers, plot
from pathjax.bench.measure import Plan, measure
from pathjax.bench.report import markdown
from pathjax.errors import InputError
from pathjax.system.files import check_writable, write_text
from pathjax.system.interrupts import Interrupts
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say


def run(
    files: list[str], defines: dict[str, str], plan: Plan, folder: Path | None, output: Output
) -> tuple[dict, bool]:
    """Measure scenes one after another; after each one the report of all is in the folder, if there is one.

    Returns:
        The report, and whether all was measured. What ends it early, Ctrl-C too, costs no scene that is done.
    Raises:
        InputError: a scene, the folder or the peer is not as it must be; nothing was measured.
    """
    if folder is not None and not folder.parent.is_dir():
        raise InputError(f"{folder}: there is no folder {folder.parent}; make it first")
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder")
    for file in files:
        pathjax.load_scene(file, parameters=defines)  # a wrong one is refused before an hour of work on the others
    if plan.against == "mitsuba":
        _find_mitsuba(files[0], defines)
    if folder is not None:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
        for name in ("bench.json", "bench.md"):
            check_writable(folder / name)
        if not plot.available():
            say("no plots, for there is no matplotlib: pip install 'pathjax[bench]'")
    report = {"machine": machine(), "against": plan.against, "repeat": plan.repeat, "scenes": []}
    whole = True
    with Interrupts() as interrupts:
        for name, file in _plot_names(files):
            try:
                with interrupts.raised():
                    scene = measure(file, defines, plan)
            except (KeyboardInterrupt, Exception) as error:
                if not report["scenes"]:
                    raise
                stopped = isinstance(error, KeyboardInterrupt)
                why = "interrupted" if stopped else f"{file}: {type(error).__name__}: {error}"
                say(f"{why}; {len(report['scenes'])} of {len(files)} scenes are done")
                return report, False
            for failure in scene["failures"]:
                say(f"{file}: {failure}")
            whole &= not scene["failures"]
            report["scenes"].append({**scene, "plot": None})
            if folder is not None:
                _write(report, folder, name, output)
    return report, whole


def _write(report: dict, folder: Path, name: str, output: Output) -> None:
    """Plot the last scene, and write the report of all."""
    scene = report["scenes"][-1]
    if plot.available() and plot.has_noise(scene):
        place = output.file(folder / name, lambda path: plot.write(scene, path))
        scene["plot"] = name if place == folder / name else place and str(place)
    output.file(folder / "bench.json", lambda path: write_text(path, json_text(report, indent=2)))
    output.file(folder / "bench.md", lambda path: write_text(path, markdown(report)))


def _find_mitsuba(scene: str, defines: dict) -> None:
    """Refuse before all measurements if Mitsuba is missing."""
    run = {"sampler": "independent", "spp": 1, "seeds": [1]}
    try:
        peers.call("mitsuba3", {"scene": scene, "parameters": defines, "runs": [run]})
    except peers.PeerMissing as error:
        raise InputError(f"--against mitsuba: {error}") from None
    except (peers.RequestError, peers.PeerFailed):
        pass  # of this scene; the report tells


def _plot_names(files: list[str]):
    """(name of its plot, file) of every scene."""
    stems = [Path(file).stem for file in files]
    for number, (stem, file) in enumerate(zip(stems, files, strict=True), 1):
        yield f"{stem}.png" if stems.count(stem) == 1 else f"{stem}-{number}.png", file


def machine() -> dict:
    return {
        "processor": _processor(),
        "devices": len(jax.local_devices()),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "pathjax": pathjax.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
