"""`pathjax compare`: the difference of an image from a reference, and whether it exceeds given limits."""

from __future__ import annotations

from pathlib import Path

from pathjax import images
from pathjax.cli import DONE, FAILED
from pathjax.errors import InputError
from pathjax.images import comparison as report
from pathjax.system.files import check_writable
from pathjax.system.json_text import json_text
from pathjax.system.output import Output


def run(options, output: Output) -> int:
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
    lines = [report.text(comparison), *(f"the images differ: {reason}" for reason in differ)]
    if options.output:
        picture, scale = report.picture(comparison)
        place = output.file(options.output, lambda path: images.write_png(path, picture))
        lines.insert(1, f"{place} shows differences of {scale:.3g} in full colour")
    facts = {"image": options.image, "reference": options.reference, **report.facts(comparison), "differ": differ}
    output.text(json_text(facts) if options.json else "\n".join(lines))
    return FAILED if differ else DONE
