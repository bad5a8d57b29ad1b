"""`pathjax bench`: speed against error."""

from __future__ import annotations

from pathlib import Path

from pathjax.bench import bench
from pathjax.bench.measure import Plan
from pathjax.bench.report import markdown
from pathjax.cli import DONE, FAILED
from pathjax.system.interrupts import Interrupts
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say


def run(options, output: Output) -> int:
    spps = sorted(set(options.spp))
    plan = Plan(spps, options.repeat, options.reference_spp, options.against, options.quick, say)
    folder = None if options.output is None else Path(options.output)
    with Interrupts():
        report, whole = bench.run(options.scenes, dict(options.defines), plan, folder, output)
        output.text(json_text(report) if options.json else markdown(report))
    return DONE if whole else FAILED
