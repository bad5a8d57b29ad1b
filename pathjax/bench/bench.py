"""`pathjax bench`: speed against error beside a peer, and comparisons of strategies, sampler and precision.

Efficiency is 1 / (relMSE x seconds), with relMSE against a converged reference by pathjax itself with other seeds.
"""

from __future__ import annotations

import json
import platform
from pathlib import Path

import jax
import numpy as np

import pathjax
from pathjax import distributed
from pathjax.bench import peers, plot
from pathjax.bench.measure import Plan, measure
from pathjax.bench.report import markdown
from pathjax.bench.summary import summary
from pathjax.errors import InputError
from pathjax.system.files import check_writable, write_text
from pathjax.system.interrupts import Interrupts
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say


def prepare(folder: Path | None) -> None:
    """Create the folder of a report; None: there is no report.

    Raises:
        InputError: the folder cannot be created or written into.
    """
    if folder is not None and not folder.parent.is_dir():
        raise InputError(f"{folder}: there is no folder {folder.parent}; make it first")
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder")
    if folder is not None:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
        for name in ("bench.json", "bench.md"):
            check_writable(folder / name)
        if not plot.available():
            say("no plots, for there is no matplotlib: pip install 'pathjax[bench]'")


def run(
    files: list[str], defines: dict[str, str], plan: Plan, folder: Path | None, output: Output, resume: bool = False
) -> tuple[dict, bool]:
    """Measure scenes one after another, and write the report of all so far into the folder, if any, after each scene.

    Several processes share the renders; only the first one has a folder and a peer, and only its report is complete.

    Args:
        folder: folder after `prepare`; resume: continue after the scenes of the report in it.
    Returns:
        The report, and whether everything was measured. Finished scenes survive an early end, also by Ctrl-C.
    Raises:
        InputError: a scene, the report to resume or the peer is invalid; nothing was measured.
    """
    report = {
        "machine": machine(),
        "against": plan.against,
        "repeat": plan.repeat,
        "plan": {"spp": plan.spps, "reference_spp": plan.reference_spp, "quick": plan.quick, "parameters": defines},
        "scenes": [],
        "summary": None,
    }
    if resume and folder is not None and (folder / "bench.json").exists():
        report = _begun(folder / "bench.json", report)
        report["scenes"] = [scene for scene in report["scenes"] if scene["file"] in files]
        report["summary"] = summary(report["scenes"]) if report["scenes"] else None
    done = {scene["file"] for scene in report["scenes"]}
    missing = distributed.of_first(np.array([file not in done for file in files]))
    todo = [scene for scene, misses in zip(_plot_names(files), missing, strict=True) if misses]
    for _, file in todo:
        pathjax.load_scene(file, parameters=defines)  # refuse a wrong one before an hour of work on the others
    if plan.against == "mitsuba" and todo:
        _find_mitsuba(todo[0][1], defines)
    with Interrupts() as interrupts:
        for name, file in todo:
            plan.say(f"scene {len(report['scenes']) + 1} of {len(files)}")
            try:
                with distributed.interruptible(interrupts):
                    scene = measure(file, defines, plan)
            except (KeyboardInterrupt, Exception) as error:
                if not report["scenes"]:
                    raise
                stopped = isinstance(error, KeyboardInterrupt)
                why = "interrupted" if stopped else f"{file}: {type(error).__name__}: {error}"
                plan.say(f"{why}; {len(report['scenes'])} of {len(files)} scenes are done")
                return report, False
            for failure in scene["failures"]:
                plan.say(f"{file}: {failure}")
            report["scenes"].append({**scene, "plot": None})
            report["summary"] = summary(report["scenes"])
            if folder is not None:
                _write(report, folder, name, output)
    return report, not any(scene["failures"] for scene in report["scenes"])


def _write(report: dict, folder: Path, name: str, output: Output) -> None:
    """Plot the last scene, and write the report of all scenes."""
    scene = report["scenes"][-1]
    if plot.available() and plot.has_noise(scene):
        place = output.file(folder / name, lambda path: plot.write(scene, path))
        scene["plot"] = name if place == folder / name else place and str(place)
    output.file(folder / "bench.json", lambda path: write_text(path, json_text(report, indent=2)))
    output.file(folder / "bench.md", lambda path: write_text(path, markdown(report)))


def _begun(file: Path, report: dict) -> dict:
    """Return the report in a file, which must have the machine, plan and other settings of `report`."""
    try:
        begun = json.loads(file.read_text(encoding="utf-8"))
        other = [key for key, value in report.items() if key not in ("scenes", "summary") and begun[key] != value]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"--resume: {file} is no report to go on with: {error!r}") from None
    if other:
        raise InputError(f"--resume: {file} has another {' and '.join(other)}; ask for the same, or for another folder")
    return begun


def _find_mitsuba(scene: str, defines: dict) -> None:
    """Refuse before all measurements if Mitsuba is missing."""
    run = {"sampler": "independent", "spp": 1, "seeds": [1]}
    try:
        peers.call("mitsuba3", {"scene": scene, "parameters": defines, "runs": [run]})
    except peers.PeerMissing as error:
        raise InputError(f"--against mitsuba: {error}") from None
    except (peers.RequestError, peers.PeerFailed):
        pass  # a failure of this scene only, which goes into the report


def _plot_names(files: list[str]):
    """Yield (name of the plot, file) of every scene."""
    stems = [Path(file).stem for file in files]
    for number, (stem, file) in enumerate(zip(stems, files, strict=True), 1):
        yield f"{stem}.png" if stems.count(stem) == 1 else f"{stem}-{number}.png", file


def machine() -> dict:
    return {
        "processor": _processor(),
        "devices": jax.device_count(),
        "processes": distributed.count(),
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
