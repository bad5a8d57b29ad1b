"""Plots of error against time, as PNG. Needs matplotlib, from the `bench` extra."""

from __future__ import annotations

import math
from pathlib import Path

from pathjax.bench import figures
from pathjax.system.files import encodable, write_whole

_OURS = {"color": "black", "marker": "o", "linewidth": 2.2, "markersize": 7, "zorder": 3}
_PEERS = {
    "independent": {"color": "#d55e00", "marker": "s"},
    "stratified": {"color": "#0072b2", "marker": "^"},
    "multijitter": {"color": "#009e73", "marker": "D"},
    "orthogonal": {"color": "#cc79a7", "marker": "v"},
    "ldsampler": {"color": "#e69f00", "marker": "P"},
}


def available() -> bool:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return False
    return True


def has_noise(scene: dict) -> bool:
    """Return whether a scene of the report has noise, so that there are errors to plot."""
    return any(_points(rows) for rows in (scene["pathjax"], scene["mitsuba"]))


def write(scene: dict, path: Path) -> None:
    """Plot a scene of the report; some of its rows must have noise."""
    lines = {"pathjax": (scene["pathjax"], _OURS)}
    for sampler in scene["slopes"]["mitsuba"]:
        lines[f"Mitsuba {sampler}"] = [row for row in scene["mitsuba"] if row["sampler"] == sampler], _PEERS[sampler]
    title = encodable(f"{scene['file']}, {scene['width']} x {scene['height']}")
    write_panels([(title, lines)], path)


def write_panels(panels: list[tuple[str, dict]], path: Path, columns: int = 1) -> None:
    """Plot panels of error against time side by side.

    Args:
        panels: one (title, name -> (rows of `figures.row`, look: keywords of matplotlib's `plot`)) per panel.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(7.2 * columns, 5 * rows), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    for number, (title, lines) in enumerate(panels, 1):
        _draw(figure.add_subplot(rows, columns, number, xscale="log", yscale="log"), title, lines)
    write_whole(path, lambda file: figure.savefig(file, format="png"))


def _draw(axes, title: str, lines: dict) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for name, (rows, look) in lines.items():
        if not _points(rows):
            continue
        slope = figures.slopes(rows)["seconds"]
        label = name if slope is None else f"{name}, slope {slope:.2f}"
        axes.plot(*zip(*_points(rows), strict=True), label=label, **look)
    axes.margins(0.1)
    _guide(axes)
    axes.set_xlabel("time of a render [s], without compilation")
    axes.set_ylabel("RMS relative error, sqrt(relMSE)")
    axes.set_title(title, fontsize=10)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, color="#eeeeee", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8.5, loc="upper right")


def _points(rows) -> list[tuple[float, float]]:
    return sorted((row["run_seconds"], math.sqrt(row["rel_mse"])) for row in rows if row["efficiency"])


def _guide(axes) -> None:
    """Draw lines of equal efficiency, at powers of ten, without changing the limits of the axes."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    axes.set(xlim=(left, right), ylim=(low, high))
    first = math.ceil(math.log10(1 / (high**2 * right)))
    last = math.floor(math.log10(1 / (low**2 * left)))
    for power in range(first, last + 1):
        efficiency = 10.0**power
        y = [(efficiency * x) ** -0.5 for x in (left, right)]
        axes.plot([left, right], y, color="#bbbbbb", linewidth=0.8, linestyle="--", zorder=1)
        label = {"text": f" efficiency {efficiency:g} ", "fontsize": 7, "color": "gray", "zorder": 1}
        if y[1] > low:
            axes.annotate(xy=(right, y[1]), ha="right", va="top", **label)
        else:
            axes.annotate(xy=(1 / (efficiency * low**2), low), ha="left", va="bottom", **label)
