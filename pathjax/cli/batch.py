"""`pathjax batch`: render a list of jobs."""

from __future__ import annotations

from collections import Counter

from pathjax.batch import render_batch
from pathjax.cli import DONE, FAILED
from pathjax.compile import keep_kernels
from pathjax.system.json_text import json_text
from pathjax.system.output import Output, say


def run(options, output: Output) -> int:
    keep_kernels()
    outcomes = render_batch(options.jobs, options.output, part=options.part, progress=True)
    counts = Counter(outcome.status for outcome in outcomes)
    output.written = counts["done"] > 0
    say(", ".join(f"{count} {status}" for status, count in counts.items()))
    if options.json:
        facts = [vars(each) | {"job": each.job.place, "output": str(each.output)} for each in outcomes]
        output.text(json_text({"jobs": facts}))
    return DONE if not counts.keys() - {"done", "skipped"} else FAILED
