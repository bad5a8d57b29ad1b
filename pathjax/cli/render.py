"""`pathjax render`: render a scene to an image, with extra channels, up to an error, a time or a sample count."""

from __future__ import annotations

import math
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from pathjax import distributed, emitters
from pathjax.cli import DONE, FAILED
from pathjax.cli.inputs import load
from pathjax.errors import InputError
from pathjax.io import picture
from pathjax.rendering import aovs, bounces
from pathjax.rendering.progressive.until import Render, RenderResult
from pathjax.scene.scene import Scene
from pathjax.system.files import check_writable
from pathjax.system.interrupts import Interrupts, wait_for
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say

# Output variables and their channels in an EXR file.
CHANNELS = {"error": "RGB", "depth": "Z", "normal": "XYZ", "albedo": "RGB"}


def run(options, output: Output) -> int:
    path = Path(options.output)
    _check(path, options)
    started = time.perf_counter()
    scene = load(options)
    if dark := emitters.darkness(scene.emitters, scene.samples_lights):
        say(f"{options.scene}: {dark}, so the image will be black")
    if "bounces" in options.aov:
        _check_depth(scene, options)
    if options.spp is None and options.error is None and options.time is None:
        options.spp = scene.about.description.view.spp
    load_seconds = time.perf_counter() - started
    render = Render(
        scene, options.error, options.time, options.spp, options.seed, options.strategy, options.checkpoint
    )
    first = distributed.index() == 0  # only the first process prints and writes
    watched = first and sys.stderr.isatty()
    with _compiling() if watched else nullcontext():
        wait_for(render.compile)
        first_hits = wait_for(lambda: _first_hits(scene, options))
    # From here on signals, however many, only stop the rendering: samples so far are written.
    with Interrupts() as interrupts:
        result = render.run(progress=watched)
        layers = first_hits | _image_layers("error", result.standard_error)
        channels = {name: layers[name] for name in layers if name.partition(".")[0] in options.aov}
        if "bounces" in options.aov:
            channels |= _bounces(scene, result, options, interrupts, output)
        if not first:
            return DONE if result.reason != "interrupted" else FAILED
        made_of = {"scene": options.scene, "parameters": dict(options.defines + options.settings), "seed": options.seed}
        place = output.file(path, lambda place: picture.write(place, result, channels, **made_of))
        saved = render.checkpoint is not None and render.checkpoint.problem is None
        missed = result.reason == "interrupted" or (options.error is not None and result.reason != "target error")
        lost = int((~np.isfinite(result.image)).any(-1).sum())
        if lost:
            say(f"{lost} pixels met a sample that is not finite, and hold nan")
        if not dark and not result.image.any():
            say("every pixel is black: none of the paths met a light")
        if missed:
            say(_reached(result, lost, place, saved, options))
        if options.json:
            facts = _facts(result, lost, place, options.seed, load_seconds)
            output.text(json_text(facts))
    return FAILED if missed or (options.checkpoint is not None and not saved) else DONE


def _compiling():
    from rich.console import Console  # its import takes a tenth of the time of a small render

    return Console(stderr=True).status("compiling")


def _check(path: Path, options) -> None:
    if path.suffix.lower() not in (".exr", ".png"):
        raise InputError(f"{path}: images are written as .exr or .png")
    if distributed.index() == 0:
        check_writable(path, [options.checkpoint] if options.checkpoint is not None else [])
    aovs.check_names(options.aov, (*CHANNELS, "bounces"))
    if options.aov and path.suffix.lower() == ".png":
        raise InputError(f"{path}: --aov needs an .exr file; a .png holds one image")


def _check_depth(scene: Scene, options) -> None:
    depth = int(scene.max_depth)
    if not 1 <= depth <= bounces.MOST_TERMS:
        asked = "no limit" if depth > bounces.MOST_TERMS else depth
        raise InputError(
            f"{options.scene}: --aov bounces writes a term for each depth, and max_depth is {asked}; set one of 1 to "
            f"{bounces.MOST_TERMS} (`pathjax info --tail 0.01` suggests one)"
        )


def _first_hits(scene: Scene, options) -> dict[str, np.ndarray]:
    """Return the channels of the output variables of the first hits."""
    names = [name for name in options.aov if name in aovs.NAMES]
    if not names:
        return {}
    rendered = aovs.render_aovs(scene, names, options.spp or aovs.MAX_SPP, options.seed)
    return {channel: layer for name in names for channel, layer in _image_layers(name, rendered[name]).items()}


def _image_layers(name: str, image: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}.{channel}": image[..., i] for i, channel in enumerate(CHANNELS[name])}


def _bounces(scene, result: RenderResult, options, interrupts: Interrupts, output: Output) -> dict[str, np.ndarray]:
    """Return channels of the terms per bounce, from the same samples as the image, and of their standard errors."""

    def rendered():
        found = bounces.render_bounces(scene, int(scene.max_depth), result.samples, options.seed, options.strategy)
        return {"": np.asarray(found.terms), "error.": found.standard_error}

    try:
        with distributed.interruptible(interrupts):
            terms = wait_for(rendered)
    except (KeyboardInterrupt, Exception) as error:  # the image is complete, whatever this second render ran out of
        output.failed = True
        if distributed.index():
            return {}
        say(f"{'interrupted' if isinstance(error, KeyboardInterrupt) else error}; the bounces are left out")
        return {}
    return {
        f"bounces.{k}.{what}{channel}": term[..., i]
        for what, images in terms.items()
        for k, term in enumerate(images)
        for i, channel in enumerate("RGB")
    }


def _reached(result: RenderResult, lost: int, place: Path | None, saved: bool, options) -> str:
    """Return a message on what was reached, for a render that ended before its limits."""
    if result.reason == "no estimate":
        why = f"{lost} of its pixels are not finite" if lost else "it is black, or nearly so"
        return (
            f"{place or 'the image'} holds {result.spp:.4g} spp, and its error cannot be told, for {why}; float32 has "
            "room for radiances from 1e-31 to 1e36"
        )
    ended = {"interrupted": "interrupted", "time limit": "out of time", "spp": "out of samples"}[result.reason]
    asked = f" of {options.spp}" if options.spp else ""
    text = f"{ended}; {place or 'the image'} holds {result.spp:.4g}{asked} spp"
    if options.error is not None:
        reached = f"at most {result.error_bound:.3g}" if math.isfinite(result.error_bound) else "unknown"
        text += f", and its error is {reached}, not yet {options.error:g}"
    if saved and result.reason == "interrupted":
        text += "; the same command goes on from there"
    return text


def _facts(result: RenderResult, lost: int, place: Path | None, seed: int, load_seconds: float) -> dict:
    height, width, _ = result.image.shape
    return {
        "output": None if place is None else str(place),
        "width": width,
        "height": height,
        "spp": result.spp,
        "fewest_spp": result.samples.min(),
        "most_spp": result.samples.max(),
        "seed": seed,
        "load_seconds": load_seconds,
        "compile_seconds": result.compile_seconds,
        "run_seconds": result.run_seconds,
        "error": result.error,
        "error_bound": result.error_bound,
        "reason": result.reason,
        "not_finite_pixels": lost,
        "interrupted": result.reason == "interrupted",
    }
