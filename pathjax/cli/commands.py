"""The command line: parses, calls, prints. Results on stdout; progress and messages on stderr.

Exit status: 0 done, 1 the work failed (of `compare`: the images differ), 2 the command or a file is wrong.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import warnings
from pathlib import Path

from pathjax.cli.arguments import parser
from pathjax.errors import InputError, InputWarning
from pathjax.system.files import check_writable
from pathjax.system.interrupts import Interrupts
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say

DONE, FAILED, WRONG = 0, 1, 2


def main(arguments: list[str] | None = None) -> int:
    commands = {"render": _render, "fit": _fit, "info": _info, "bench": _bench, "compare": _compare}
    options, output = parser(commands).parse_args(arguments), Output()
    with _warnings_as_messages():
        try:
            status = options.run(options, output)
        except InputError as error:
            say(str(error))
            return WRONG
        except KeyboardInterrupt:
            say("interrupted" if output.written else "interrupted; nothing was written")
            return FAILED
    return FAILED if output.failed else status


@contextlib.contextmanager
def _warnings_as_messages():
    """Print an InputWarning as a message; never raise it, whatever Python was told to do with warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("default", InputWarning)
        plain = warnings.showwarning

        def show(message, category, *place):
            if issubclass(category, InputWarning):
                say(str(message))
            else:
                plain(message, category, *place)

        warnings.showwarning = show
        yield


def _numbers(option: str, name: str, text: str):
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} {name}={text}: a value is a number, or three separated by commas") from None
    return values[0] if len(values) == 1 else values


def _load(options):
    from pathjax import scene
    from pathjax.compile import runtime
    from pathjax.io.mitsuba import loader as mitsuba_xml
    from pathjax.scene import parameters as named

    runtime.keep_kernels()
    loaded = scene.build(mitsuba_xml.load(options.scene, **dict(options.defines)))
    return named.with_parameters(loaded, {name: _numbers("--set", name, text) for name, text in options.settings})


# ---- render -------------------------------------------------------------------------------------------------------


# Output variables and their channels in an EXR file.
CHANNELS = {"error": "RGB", "depth": "Z", "normal": "XYZ", "albedo": "RGB"}


def _render(options, output: Output) -> int:
    path = Path(options.output)
    if path.suffix.lower() not in (".exr", ".png"):
        raise InputError(f"{path}: images are written as .exr or .png")
    check_writable(path, [options.checkpoint] if options.checkpoint is not None else [])

    from pathjax import emitters
    from pathjax.rendering import aovs
    from pathjax.rendering.progressive.until import Render

    aovs.check_names(options.aov, (*CHANNELS, "bounces"))
    if options.aov and path.suffix.lower() == ".png":
        raise InputError(f"{path}: --aov needs an .exr file; a .png holds one image")
    started = time.perf_counter()
    scene = _load(options)
    if dark := emitters.darkness(scene.emitters):
        say(f"{options.scene}: {dark}, so the image will be black")
    if "bounces" in options.aov:
        _check_terms(scene, options)
    spp = options.spp
    if spp is None and options.error is None and options.time is None:
        spp = scene.about.description.spp
    loaded = time.perf_counter()
    render = Render(scene, options.error, options.time, spp, options.seed, options.strategy, options.checkpoint)
    first_hits = _compile(render, spp, options)
    # From the first sample to the written image a signal only ends the rendering.
    with Interrupts() as interrupts:
        result = render.run(progress=True)
        layers = _layers(scene, result, first_hits, options, interrupts, output)
        place = output.file(path, lambda place: _write(place, result, layers, options))
    pixels_lost = int((~(abs(result.image) < math.inf)).any(-1).sum())
    if pixels_lost:
        say(f"{pixels_lost} pixels met a sample that is not finite, and hold nan")
    if not dark and not result.image.any():
        say("every pixel is black: none of the paths met a light")
    interrupted = result.reason == "interrupted"
    missed = interrupted or (options.error is not None and result.reason != "target error")
    saved = render.checkpoint is not None and render.checkpoint.problem is None
    if missed:
        say(_reached(result, pixels_lost, place, spp, saved, options))
    if options.json:
        report = {
            "output": None if place is None else str(place),
            "width": result.image.shape[1],
            "height": result.image.shape[0],
            "spp": result.spp,
            "fewest_spp": int(result.samples.min()),
            "most_spp": int(result.samples.max()),
            "seed": options.seed,
            "load_seconds": loaded - started,
            "compile_seconds": result.compile_seconds,
            "run_seconds": result.run_seconds,
            "error": result.error,
            "error_bound": result.error_bound,
            "reason": result.reason,
            "not_finite_pixels": pixels_lost,
            "interrupted": interrupted,
        }
        output.text(json_text(report))
    return FAILED if missed or (options.checkpoint is not None and not saved) else DONE


def _compile(render, spp: int | None, options) -> dict:
    """Compile the render, and make the images of what is hit first, by name."""
    from rich.console import Console

    from pathjax.rendering import aovs

    first_hits, images = [name for name in options.aov if name in aovs.NAMES], {}
    try:
        with Console(stderr=True).status("compiling"):
            _interruptible(render.compile)
            if first_hits:
                spp = spp or aovs.MAX_SPP
                images = _interruptible(lambda: aovs.render_aovs(render.scene, first_hits, spp, options.seed))
    except KeyboardInterrupt:
        # The compiler cannot be stopped, and aborts the process if the interpreter ends under it.
        say("interrupted; nothing was written")
        os._exit(FAILED)
    return images


def _layers(scene, result, first_hits: dict, options, interrupts: Interrupts, output: Output) -> dict:
    """The channels of the output variables by name."""
    images = first_hits | {"error": result.standard_error}
    layers = {}
    for name in options.aov:
        if name == "bounces":
            layers |= _terms(scene, result, options, interrupts, output)
        else:
            layers |= {f"{name}.{channel}": images[name][..., i] for i, channel in enumerate(CHANNELS[name])}
    return layers


def _check_terms(scene, options) -> None:
    from pathjax.rendering.bounces import MOST_TERMS

    depth = int(scene.max_depth)
    if not 1 <= depth <= MOST_TERMS:
        asked = "no limit" if depth > MOST_TERMS else depth
        raise InputError(
            f"{options.scene}: --aov bounces writes a term for each depth, and max_depth is {asked}; set one of 1 to "
            f"{MOST_TERMS} (`pathjax info --tail 0.01` suggests one)"
        )


def _terms(scene, result, options, interrupts: Interrupts, output: Output) -> dict:
    """Channels of the terms of the series, of the same samples as the image, and of their standard errors."""
    import numpy as np

    from pathjax.rendering.bounces import render_bounces

    try:
        if result.reason == "interrupted":
            raise KeyboardInterrupt
        with interrupts.let_through():
            bounces = render_bounces(scene, int(scene.max_depth), result.samples, options.seed, options.strategy)
            images = {"": np.asarray(bounces.terms), "error.": bounces.standard_error}
    except (KeyboardInterrupt, Exception) as error:  # the image is there, whatever this second render ran out of
        output.failed = True
        say(f"{'interrupted' if isinstance(error, KeyboardInterrupt) else error}; the bounces are left out")
        return {}
    return {
        f"bounces.{k}.{what}{channel}": term[..., i]
        for what, terms in images.items()
        for k, term in enumerate(terms)
        for i, channel in enumerate("RGB")
    }


def _reached(result, pixels_lost: int, place: Path | None, spp: int | None, saved: bool, options) -> str:
    """What there is, where it is not what was asked for."""
    if result.reason == "no estimate":
        why = f"{pixels_lost} of its pixels are not finite" if pixels_lost else "it is black, or nearly so"
        return (
            f"{place or 'the image'} holds {result.spp:.4g} spp, and its error cannot be told, for {why}; float32 has "
            "room for radiances from 1e-31 to 1e36"
        )
    ended = {"interrupted": "interrupted", "time limit": "out of time", "spp": "out of samples"}[result.reason]
    text = f"{ended}; {place or 'the image'} holds {result.spp:.4g}{f' of {spp}' if spp else ''} spp"
    if options.error is not None:
        bound = result.error_bound
        reached = f"at most {bound:.3g}" if math.isfinite(bound) else "unknown"
        text += f", and its error is {reached}, not yet {options.error:g}"
    if saved and result.reason == "interrupted":
        text += "; the same command goes on from there"
    return text


def _interruptible(call):
    """The call's result, waited for in a way that Ctrl-C ends at once (compilation itself cannot be interrupted)."""
    outcome = []

    def work():
        try:
            outcome.append((True, call()))
        except BaseException as error:
            outcome.append((False, error))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(0.1)
    succeeded, result = outcome[0]
    if not succeeded:
        raise result
    return result


def _write(path: Path, result, layers, options) -> None:
    from pathjax import __version__, images

    if path.suffix.lower() == ".png":
        images.write_png(path, result.image)
        return
    header = {
        "pathjax.version": __version__,
        "pathjax.scene": str(options.scene),
        "pathjax.parameters": " ".join(f"{name}={value}" for name, value in options.defines + options.settings),
        "pathjax.spp": result.spp,
        "pathjax.seed": options.seed,
    }
    channels = {name: result.image[..., i] for i, name in enumerate("RGB")}
    images.write_exr(path, channels | layers, header)


# ---- fit ----------------------------------------------------------------------------------------------------------


def _fit(options, output: Output) -> int:
    from rich.console import Console
    from rich.markup import escape

    from pathjax import images, inverse
    from pathjax.inverse import report
    from pathjax.inverse.fitting import step_text
    from pathjax.system.files import write_text

    table, picture = (Path(f"{Path(options.output)}{suffix}") for suffix in (".json", ".png"))
    for path in (table, picture):
        check_writable(path, [options.target, options.scene])
    start, names = {}, []
    for text in options.params:
        name, equals, value = text.partition("=")
        names.append(name)
        if equals:
            start[name] = _numbers("--param", name, value)
    target = inverse.read_target(options.target)
    scene = _load(options)
    console = Console(stderr=True)
    with console.status("compiling") as status:

        def show(entry):
            status.update(escape(step_text(entry)))

        fit = inverse.fit(scene, target, names, start=start, spp=options.spp, seed=options.seed, progress=show)
    facts = {"scene": str(options.scene), "target": str(options.target), "spp": options.spp, "seed": options.seed}
    facts |= report.facts(fit)
    with Interrupts():
        output.file(table, lambda path: write_text(path, json_text(facts, indent=1) + "\n"))
        if fit.images:
            output.file(picture, lambda path: images.write_png(path, report.picture(fit, [target.image])))
        output.text(json_text(facts) if options.json else report.text(fit))
    return DONE if fit.converged else FAILED


# ---- compare ------------------------------------------------------------------------------------------------------


def _compare(options, output: Output) -> int:
    from pathjax import images
    from pathjax.images import comparison as reports

    if options.output:
        if Path(options.output).suffix.lower() != ".png":
            raise InputError(f"{options.output}: the picture is written as .png")
        check_writable(options.output, [options.image, options.reference])
    comparison = images.compare(options.image, options.reference, options.errors)
    if options.max_flip is not None and comparison.flip is None:
        raise InputError("--max-flip: FLIP needs its authors' package: pip install 'pathjax[flip]'")
    differ = []
    if options.max_relmse is not None and comparison.rel_mse > options.max_relmse:
        differ.append(f"relMSE {comparison.rel_mse:.4g} is above {options.max_relmse:g}")
    if options.max_error is not None and not comparison.relative_error <= options.max_error:
        differ.append(f"the error {comparison.relative_error:.4g} is not below {options.max_error:g}")
    if options.max_flip is not None and comparison.flip > options.max_flip:
        differ.append(f"FLIP {comparison.flip:.4g} is above {options.max_flip:g}")
    if options.errors and comparison.p < options.alpha:
        differ.append(f"p {comparison.p:.3g} is below {options.alpha:g}")
    lines = [reports.text(comparison), *(f"the images differ: {reason}" for reason in differ)]
    if options.output:
        picture, scale = reports.picture(comparison)
        place = output.file(options.output, lambda path: images.write_png(path, picture))
        lines.insert(1, f"{place} shows differences of {scale:.3g} in full colour")
    facts = {"image": options.image, "reference": options.reference, **reports.facts(comparison), "differ": differ}
    output.text(json_text(facts) if options.json else "\n".join(lines))
    return FAILED if differ else DONE


# ---- info and bench -----------------------------------------------------------------------------------------------


def _info(options, output: Output) -> int:
    from pathjax.cli import report

    scene = _load(options)
    facts = report.facts(scene)
    if options.tail is not None:
        facts["tail"] = report.tail_facts(scene, options.tail)
    output.text(json_text(facts) if options.json else report.text(facts))
    return DONE


def _bench(options, output: Output) -> int:
    from pathjax.bench import bench

    return bench.run(options, output)
