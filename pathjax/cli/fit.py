"""`pathjax fit`: parameters from an image of the scene."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape

from pathjax import distributed, images, inverse
from pathjax.cli import DONE, FAILED
from pathjax.cli.inputs import load, numbers
from pathjax.inverse import report
from pathjax.inverse.fitting import step_text
from pathjax.io.load import save_scene
from pathjax.system.files import check_writable, write_text
from pathjax.system.interrupts import Interrupts
from pathjax.system.json_text import json_text
from pathjax.system.output import Output


def run(options, output: Output) -> int:
    table, picture = (Path(f"{Path(options.output)}{suffix}") for suffix in (".json", ".png"))
    first = distributed.index() == 0  # only the first process prints and writes
    for path in (table, picture) if first else ():
        check_writable(path, [options.target, options.scene])
    start, names = {}, []
    for text in options.params:
        name, equals, value = text.partition("=")
        names.append(name)
        if equals:
            start[name] = numbers("--param", name, value)
    target = distributed.of_file(options.target, lambda: inverse.read_target(options.target))
    scene = load(options)
    if first and any(known.is_texture for name, known in scene.described.parameters.items() if name in names):
        check_writable(Path(f"{options.output}.xml"), [options.target, options.scene])
    with Interrupts():
        with Console(stderr=True, quiet=not first).status("compiling") as status:

            def show(entry):
                status.update(escape(step_text(entry)))

            how = dict(spp=options.spp, seed=options.seed, smoothness=options.smoothness, prior=options.prior)
            fit = inverse.fit(scene, target, names, start=start, progress=show, **how)
        if not first:
            return DONE if fit.converged else FAILED
        facts = {"scene": str(options.scene), "target": str(options.target), "spp": options.spp, "seed": options.seed}
        facts |= report.facts(fit)
        output.file(table, lambda path: write_text(path, json_text(facts, indent=1) + "\n"))
        if fit.images:
            output.file(picture, lambda path: images.write_png(path, report.picture(fit, [target.image])))
        for name in report.textures(fit):
            of_layers = {"": fit.values[name], "error.": fit.standard_errors[name]}
            channels = "RGB" if fit.values[name].ndim == 3 else "Y"
            of_layers = {layer: x.reshape(*x.shape[:2], -1) for layer, x in of_layers.items()}
            layers = {f"{layer}{c}": x[..., i] for layer, x in of_layers.items() for i, c in enumerate(channels)}
            path = Path(f"{options.output}.{name}.exr")
            output.file(path, lambda path, layers=layers: images.write_exr(path, layers, {}))
        if report.summed_up(fit):
            output.file(Path(f"{options.output}.xml"), lambda path: save_scene(fit.scene, path))
        output.text(json_text(facts) if options.json else report.text(fit))
    return DONE if fit.converged else FAILED
