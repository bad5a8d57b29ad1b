"""`pathjax bench`: speed against error beside a peer, and what strategies, sampler and precision are worth.

Efficiency is 1 / (relMSE x seconds), relMSE against a converged reference of pathjax's own with other seeds.
"""

from __future__ import annotations

import json
import platform
import sys
from pathlib import Path

import jax

import pathjax
from pathjax.bench import mitsuba_peer, plot
from pathjax.bench.measure import Plan, measure
from pathjax.bench.report import markdown
from pathjax.errors import InputError
from pathjax.io.files import write_text


def run(options) -> int:
    """The command: `options` as `pathjax.cli` parses them. Returns 1 where a part of the work failed."""
    folder = None if options.output is None else Path(options.output)
    if folder is not None and not folder.parent.is_dir():
        raise InputError(f"{folder}: there is no folder {folder.parent}; make it first")
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder")
    defines = dict(options.defines)
    for file in options.scenes:
        pathjax.load_scene(file, **defines)  # a wrong one is refused before an hour of work on the others
    if options.against == "mitsuba":
        _find_mitsuba(options.scenes[0], defines)
    plan = Plan(sorted(set(options.spp)), options.repeat, options.reference_spp, options.against, options.quick, _say)
    report = {"machine": machine(), "against": options.against, "repeat": options.repeat, "scenes": []}
    if folder is not None:
        folder.mkdir(exist_ok=True)
        if not plot.available():
            _say("pathjax: no plots, for there is no matplotlib: pip install 'pathjax[bench]'")
    try:
        for name, file in _plot_names(options.scenes):
            scene = measure(file, defines, plan)
            for failure in scene["failures"]:
                _say(f"pathjax: {file}: {failure}")
            drawn = folder is not None and plot.available() and plot.write(scene, folder / name)
            report["scenes"].append({**scene, "plot": name if drawn else None})
            if folder is not None:
                write_text(folder / "bench.json", json.dumps(report, indent=2))
                write_text(folder / "bench.md", markdown(report))
    except KeyboardInterrupt:
        if folder is None or not report["scenes"]:
            raise
        _say(f"pathjax: interrupted; {folder} holds {len(report['scenes'])} of {len(options.scenes)} scenes")
        return 1
    print(json.dumps(report) if options.json else markdown(report))
    return int(any(scene["failures"] for scene in report["scenes"]))


def _say(message: str) -> None:
    print(message, file=sys.stderr)


def _find_mitsuba(scene: str, defines: dict) -> None:
    """Refuse before all measurements if Mitsuba is missing."""
    run = {"sampler": "independent", "spp": 1, "seeds": [1]}
    try:
        mitsuba_peer.call({"scene": scene, "parameters": defines, "runs": [run]})
    except mitsuba_peer.PeerMissing as error:
        raise InputError(f"--against mitsuba: {error}") from None
    except (mitsuba_peer.RequestError, mitsuba_peer.PeerFailed):
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
