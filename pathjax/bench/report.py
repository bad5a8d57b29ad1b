"""The report of `pathjax bench` as Markdown."""

from __future__ import annotations

import math
import statistics

_ABOUT = """\
relMSE = mean((I - R)^2 / (R^2 + 0.01)), the mean over seeds ({repeat}) and its standard error. R is a reference of
pathjax's own with other seeds, the mean of independent images; its own relMSE, told by their spread, is subtracted.
Efficiency = 1 / (relMSE x seconds). Seconds are medians over the seeds and hold no compilation{halves}.
Slopes are those of log sqrt(relMSE): -0.5 in spp where samples are independent. Bias is the relMSE that
seeds have in common at the most spp, so that more of them would not remove it: 0, give or take its standard error, if
both programs converge to the same image and the peer's seeds are independent.
"""
_HALVES = ";\nhalf of pathjax's renders were made before Mitsuba's and half after"
_NOISY_REFERENCE = "\\* More than half of the error measured is the reference's: raise --reference-spp."


def markdown(report: dict) -> str:
    about, scenes = report["machine"], report["scenes"]
    programs = list(dict.fromkeys(row["program"] for scene in scenes for row in scene["mitsuba"]))
    versions = [f"Python {about['python']}", f"jax {about['jax']}", f"pathjax {about['pathjax']}", *programs]
    halves = _HALVES if report["against"] else ""
    processes = f" in {about['processes']} processes" if about["processes"] > 1 else ""
    lines = [
        f"{about['processor']}, {about['devices']} devices of JAX{processes}; {', '.join(versions)}",
        "",
        _ABOUT.format(repeat=report["repeat"], halves=halves),
    ]
    for scene in scenes:
        lines += _scene(scene)
    if report["summary"]:
        lines += _summary(report["summary"])
    return "\n".join(lines)


def _scene(scene: dict) -> list[str]:
    memory = scene["peak_memory_bytes"]
    compiled = f"Compiled in {scene['compile_seconds']:.2f} s."
    if memory is not None:
        compiled += f" Peak memory {memory / 2**20:.0f} MiB above `import jax`."
    reference = f"Reference: {scene['reference_spp']} spp, relMSE {_number(scene['reference_rel_mse'])}."
    lines = [f"## {scene['file']}, {scene['width']} x {scene['height']}", "", f"{compiled} {reference}", ""]
    lines += [f"{failure}\n" for failure in scene["failures"]]
    if scene["plot"]:
        lines += [f"![error against time]({scene['plot']})", ""]
    lines += _speed(scene)
    if scene["strategies"]:
        lines += _strategies(scene["strategies"])
    if scene["derivatives"]:
        lines += _derivatives(scene["derivatives"])
    if scene["sampler"]:
        lines += _sampler(scene["sampler"])
    if scene["precision"]:
        lines += _precision(scene["precision"])
    if scene["closest_hits"]:
        lines += _rays(scene["closest_hits"], scene["rays"])
    return lines


def _summary(summary: dict) -> list[str]:
    """Return the table of all scenes, with ratios only if there is a peer."""
    rows, wall, cpu = summary["rows"], summary["wall"], summary["cpu"]
    head = [f"at {summary['spp']} spp", "run s", "relMSE", "compiled s"]
    cells = [
        [row["scene"], f"{row['seconds']:.3f}", _number(row["rel_mse"]), f"{row['compile_seconds']:.2f}"]
        for row in rows
    ]
    lines = ["## All scenes", ""]
    if wall is None:
        return lines + _table(head, cells)
    head += ["efficiency ratio", "by CPU time", "time ratio", "relMSE ratio", "over Mitsuba's"]
    for row, line in zip(rows, cells, strict=True):
        if row["efficiency_ratio"] is None:
            line += [""] * 5
            continue
        given = math.isfinite(row["relative_error"])
        sure = f" ± {row['relative_error']:.0%}" if given else ""
        line += [f"{row['efficiency_ratio']:.2f}{sure}"]
        line += [f"{row[key]:.2f}" for key in ("cpu_ratio", "time_ratio", "rel_mse_ratio")]
        line += [row["best_peer"]]
    said = "; ".join(
        f"{each['geometric_mean']:.2f}{by}, the worst {each['worst']:.2f} ({each['worst_scene']})"
        for each, by in ((wall, ""), (cpu, " by CPU time"))
    )
    return [
        *lines,
        *_table(head, cells),
        f"Geometric mean of the {wall['scenes']} efficiency ratios: {said}.",
        "",
        "Ratios above 1: pathjax is ahead. ± is the standard error that those of both relMSE leave.",
        "",
    ]


def _speed(scene: dict) -> list[str]:
    rows = [("pathjax", _versus(row), row) for row in scene["pathjax"]]
    rows += [(f"Mitsuba {row['sampler']}", "", row) for row in scene["mitsuba"]]
    lines = _table(
        ["", "spp", "run s", "Mpaths/s", "relMSE", "efficiency", "over the best peer"],
        [[name, row["spp"], *_run(row), versus] for name, versus, row in rows],
    )
    if any(row["reference_too_noisy"] for _, _, row in rows):
        lines += [_NOISY_REFERENCE, ""]
    groups = {"pathjax": (scene["slopes"]["pathjax"], scene["pathjax"])}
    for sampler, found in scene["slopes"]["mitsuba"].items():
        groups[f"Mitsuba {sampler}"] = found, [row for row in scene["mitsuba"] if row["sampler"] == sampler]
    cells = [
        [name, _hundredths(found["spp"]), _hundredths(found["seconds"]), _bias(rows[-1]["bias"])]
        for name, (found, rows) in groups.items()
    ]
    return lines + _table(["RMS error", "slope in spp", "slope in seconds", "bias, relMSE"], cells)


def _strategies(rows: list[dict]) -> list[str]:
    cells = [[row["strategy"], *_run(row)] for row in rows]
    return _table([f"strategy, {rows[0]['spp']} spp", "run s", "Mpaths/s", "relMSE", "efficiency"], cells)


def _sampler(sampler: dict) -> list[str]:
    cells = [
        [row["spp"], _number(row["rel_mse"]), _number(row["independent_rel_mse"]), _hundredths(row["ratio"])]
        for row in sampler["rows"]
    ]
    single = _relative(sampler["single_rel_mse"], sampler["single_rel_mse_standard_error"])
    return [
        f"Independent numbers: relMSE of one sample, {single}, over spp.",
        "",
        *_table(["sampler, spp", "relMSE, shifted lattice", "relMSE, independent", "ratio"], cells),
    ]


def _derivatives(derivatives: dict) -> list[str]:
    numbers, seconds = derivatives["numbers"], derivatives["cpu_seconds"]
    image, *others = ((name, statistics.median(each)) for name, each in seconds.items())
    cells = [[name, f"{each:.3f}", f"{each / image[1]:.2f}"] for name, each in others]
    return _table([f"derivatives in {numbers} numbers, {derivatives['spp']} spp", "CPU s", "over the image's"], cells)


def _precision(precision: dict) -> list[str]:
    names = ("float32", "float64")
    spp = precision["float64"]["spp"]
    seconds = {name: statistics.median(precision[name]["seconds"]) for name in names}
    cells = [[name, *_run(precision[name])] for name in names]
    difference, noise = precision["rel_mse"], precision["float64"]["rel_mse"]
    share = f", {difference / noise:.1e} of the noise" if math.isfinite(difference) and noise > 0 else ""
    return [
        *_table([f"precision, {spp} spp", "run s", "Mpaths/s", "relMSE", "efficiency"], cells),
        f"float32 against float64, same seeds: relMSE {_number(difference)}{share}; largest deviation "
        f"|I - E| / sqrt(E^2 + 0.01) of a value {_number(precision['largest_deviation'])}. float64 takes "
        f"{seconds['float64'] / seconds['float32']:.2f} x the time.",
        "",
    ]


def _rays(closest_hits: dict, beside: dict | None) -> list[str]:
    lines = _table(
        ["closest hits, all shapes, 1 core", "Mray/s"],
        [[f"{name} rays", f"{rate:.2f}"] for name, rate in closest_hits.items()],
    )
    if beside:
        cells = []
        for name in closest_hits:
            row = beside[name]
            embree = ["not measured", ""] if row["embree"] is None else [f"{row['embree']:.2f}", f"{row['ratio']:.2f}"]
            cells.append([f"{name} rays", f"{row['mrays_per_second']:.2f}", *embree])
        lines += _table([f"{beside['triangles']} triangles alone, 1 core", "Mray/s", "Embree", "ratio"], cells)
    return lines


def _table(head: list[str], rows: list[list]) -> list[str]:
    """Return the lines of a Markdown table, and an empty line after it."""
    return [*(f"| {' | '.join(map(str, cells))} |" for cells in (head, ["---"] * len(head), *rows)), ""]


def _run(row: dict) -> list[str]:
    star = "\\*" if row["reference_too_noisy"] else ""
    error = _relative(row["rel_mse"], row["rel_mse_standard_error"]) + star
    return [f"{row['run_seconds']:.3f}", f"{row['mpaths_per_second']:.2f}", error, _efficiency(row)]


def _efficiency(row: dict) -> str:
    if row["efficiency"] is not None:
        return f"{row['efficiency']:.0f}" if row["efficiency"] > 100 else f"{row['efficiency']:.3g}"
    return "" if not math.isfinite(row["rel_mse"]) or row["reference_too_noisy"] else "no noise"


def _versus(row: dict) -> str:
    ratio = row["efficiency_over_best_peer"]
    if ratio is None:
        return ""
    taken = "" if row["best_peer_spp"] == row["spp"] else f" at {row['best_peer_spp']} spp"
    return f"{ratio:.2f} x {row['best_peer']}{taken}"


def _relative(value: float, standard_error: float) -> str:
    """Format a value with its standard error in percent."""
    known = value > 0 and math.isfinite(standard_error)
    return _number(value) + (f" ± {standard_error / value:.0%}" if known else "")


def _bias(bias: dict) -> str:
    return "" if not math.isfinite(bias["rel_mse"]) else f"{bias['rel_mse']:.1e} ± {bias['standard_error']:.1e}"


def _number(value: float) -> str:
    return f"{value:.2e}" if math.isfinite(value) else "not finite"


def _hundredths(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
