"""`pathjax convert`: any loadable file to a scene file of Mitsuba."""

from __future__ import annotations

from pathjax.cli import DONE
from pathjax.cli.inputs import load
from pathjax.io.load import save_scene
from pathjax.system.interrupts import wait_for
from pathjax.system.json_text import json_text
from pathjax.system.output import Output


def run(options, output: Output) -> int:
    scene = load(options)
    files = [str(file) for file in wait_for(lambda: save_scene(scene, options.output))]
    output.written = True
    if options.json:
        notes = scene.about.description.notes
        output.text(json_text({"output": files[-1], "files": files, "notes": list(notes)}))
    return DONE
