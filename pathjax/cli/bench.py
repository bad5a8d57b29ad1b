"""`pathjax bench`: speed against error."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pathjax import distributed
from pathjax.bench import bench, twelve
from pathjax.bench.measure import Plan
from pathjax.bench.report import markdown
from pathjax.cli import DONE, FAILED
from pathjax.errors import InputError
from pathjax.system.interrupts import Interrupts
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say


def run(options, output: Output) -> int:
    first = distributed.index() == 0  # only the first process prints, writes and starts the peer
    folder = Path(options.output) if options.output is not None and first else None
    if options.scenes and options.bunny:
        raise InputError("--bunny is for the twelve scenes, which are measured where none is named")
    if options.resume and options.output is None:
        raise InputError("--resume goes on with the report in a folder: name it by -o")
    bench.prepare(folder)
    defines = dict(options.defines)
    with Interrupts(), tempfile.TemporaryDirectory() as temporary:
        if options.scenes:
            scenes, spps, reference_spp = options.scenes, [16, 64, 256], 16384
        else:
            made = Path(temporary) if folder is None else folder / "scenes"
            made.mkdir(exist_ok=True)
            scenes = [str(file) for file in twelve.twelve(made, options.bunny and Path(options.bunny))]
            spps, reference_spp, defines = twelve.SPPS, twelve.REFERENCE_SPP, {"res": str(twelve.RES), **defines}
        plan = Plan(
            sorted(set(options.spp or spps)),
            options.repeat,
            options.reference_spp or reference_spp,
            options.against if first else None,
            options.quick or not options.scenes,
            say if first else lambda message: None,
        )
        report, whole = bench.run(scenes, defines, plan, folder, output, options.resume)
        if first:
            output.text(json_text(report) if options.json else markdown(report))
    return DONE if whole else FAILED
