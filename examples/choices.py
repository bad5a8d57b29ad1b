"""Compare the choices of the classic path tracer: error against time, with a table and a plot for each question.

    python examples/choices.py [QUESTION...]

Which strategy? Roulette from which depth? What does Schlick's approximation cost? Does splitting at glass pay? Which
random numbers? Which split rule of the hierarchy? Which filter? Does a coarse solution help? Choices are rendered in
turns with the same seeds; relMSE is measured against a converged reference. Writes choices.png. A further choice is one
line here: its label, its scene, and its arguments of `pathjax.render`.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import pathjax as pj
from pathjax import transport
from pathjax.bench import figures, plot
from pathjax.bsdfs import FRESNEL
from pathjax.integrators.options import SAMPLERS, STRATEGIES
from pathjax.scene import UNBOUNDED, Scene, build
from pathjax.sensors.filters import Tent
from pathjax.shapes.accel.build import RULES

SCENES = Path(__file__).resolve().parents[1] / "scenes"
BATCHES = 16  # independent images that make up a reference
PATCHES = 400  # of the coarse solution
REFERENCE_SEED = 1 << 20  # of the first reference image; no timed render uses it
LOOKS = [
    {"color": color, "marker": marker}
    for color, marker in zip(("black", "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00"), "os^DvP", strict=True)
]


class Choice(NamedTuple):
    label: str
    scene: Scene
    how: dict = {}  # keywords of `render`
    truth: int = 0  # index of the choice whose converged image is the reference


def load(name, res, **more):
    return pj.load_scene(SCENES / f"{name}.xml", res=res, **more)


def with_tent(scene):
    description = scene.about.description
    view = description.view
    film = replace(view.film, filter=Tent(1.0))
    return build(replace(description, view=view._replace(film=film)))


def strategy(res):
    """Sample lights, bsdfs, or both (Cornell box)?"""
    scene = load("cornell_box", res)
    return [Choice(name, scene, {"strategy": name}) for name in STRATEGIES]


def roulette(res):
    """From which depth should roulette end paths (Cornell box, max_depth 32)?"""
    scene = load("cornell_box", res, max_depth=32)
    depths = {"none": UNBOUNDED, "from depth 2": 2, "from depth 5": 5, "from depth 10": 10}
    return [Choice(label, replace(scene, rr_depth=np.int32(depth))) for label, depth in depths.items()]


def fresnel(res):
    """What does Schlick's approximation cost in accuracy (glass ball)?"""
    scene = load("glass_ball", res)
    return [Choice(name, scene, {"fresnel": name}) for name in FRESNEL]


def splitting(res):
    """Does following both branches of the first dielectrics pay (glass and mirror)?"""
    scene = load("glass_and_mirror", res)
    return [Choice(f"split_depth {depth}", scene, {"split_depth": depth}) for depth in range(4)]


def sampler(res):
    """A lattice, independent numbers, or 2 x 2 strata of the pixel (Cornell box, tent filter)?"""
    scene = with_tent(load("cornell_box", res))
    return [Choice(name, scene, {"sampler": name}) for name in SAMPLERS]


def split_rule(res):
    """How should the hierarchy be split (knot of 20,800 triangles)?"""
    return [Choice(rule, load("mesh", res, split_rule=rule)) for rule in RULES]


def reconstruction(res):
    """A box or a tent filter, each against its own truth (Cornell box)?"""
    scene = load("cornell_box", res)
    return [Choice("box", scene), Choice("tent", with_tent(scene), truth=1)]


def control(res):
    """Does it pay to end paths in a coarse solution, whose own time comes on top (Cornell box, max_depth 32)?"""
    scene = load("cornell_box", res, max_depth=32)
    transport.operator(scene, PATCHES).solve()  # compiles
    started = time.perf_counter()
    op = transport.operator(scene, PATCHES)
    L = jax.block_until_ready(op.solve().L)
    label = f"solved in {time.perf_counter() - started:.2f} s, effort"
    return [Choice("none", scene)] + [Choice(f"{label} {x}", scene, {"control": op.control(L, x)}) for x in (1, 2, 4)]


QUESTIONS = (strategy, roulette, fresnel, splitting, sampler, split_rule, reconstruction, control)
QUESTIONS = {question.__name__: question for question in QUESTIONS}


def measure(choices, spps, seeds, reference_spp):
    """Return a list of rows for each choice, one row per spp, with the bias."""
    each = -(-reference_spp // BATCHES)
    references = {}
    for truth in sorted({choice.truth for choice in choices}):
        _, scene, how, _ = choices[truth]
        images = (pj.render(scene, each, REFERENCE_SEED + k, **how) for k in range(BATCHES))
        references[truth] = figures.reference_of(images, each)
    for choice in choices:
        jax.block_until_ready(pj.render(choice.scene, spps[0], **choice.how))  # compiles
    rows = [[] for _ in choices]
    for spp in spps:
        done = [([], []) for _ in choices]
        for seed in range(seeds):
            for choice, (seconds, images) in zip(choices, done, strict=True):
                started = time.perf_counter()
                images.append(np.asarray(pj.render(choice.scene, spp, seed, **choice.how)))
                seconds.append(time.perf_counter() - started)
        for choice, (seconds, images), into in zip(choices, done, rows, strict=True):
            reference = references[choice.truth]
            paths = images[0].shape[0] * images[0].shape[1]
            row = figures.row(spp, spp, seconds, reference.errors(images), reference.noise, paths)
            into.append(row | {"bias": reference.bias(images)})
    return rows


def table(choices, rows):
    """Return a Markdown table; efficiency is 1 / (relMSE x s), bias a relMSE that more samples would not remove."""
    lines = ["| | spp | s | relMSE | efficiency | of the first | bias, relMSE |", "|---|---|---|---|---|---|---|"]
    for choice, of_choice in zip(choices, rows, strict=True):
        for row, first in zip(of_choice, rows[0], strict=True):
            efficiency, against = row["efficiency"], first["efficiency"]
            share = f"{efficiency / against:.2f}" if efficiency and against else ""
            bias = row["bias"]
            error = f"{row['rel_mse']:.2e} ± {row['rel_mse_standard_error'] / row['rel_mse']:.0%}"
            cells = [choice.label, row["spp"], f"{row['run_seconds']:.3f}", error, f"{efficiency or np.nan:.0f}", share]
            cells.append(f"{bias['rel_mse']:.1e} ± {bias['standard_error']:.1e}")
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("questions", nargs="*", metavar="QUESTION", help=f"of {', '.join(QUESTIONS)}; all by default")
    parser.add_argument("--res", type=int, default=96)
    parser.add_argument("--spp", type=lambda text: [int(x) for x in text.split(",")], default=[16, 64, 256])
    parser.add_argument("--seeds", type=int, default=4, help="renders of each choice and spp; 2 or more")
    parser.add_argument("--reference-spp", type=int, default=4096)
    parser.add_argument("-o", "--output", type=Path, default=Path("choices.png"))
    options = parser.parse_args()
    if unknown := set(options.questions) - QUESTIONS.keys():
        parser.error(f"{', '.join(sorted(unknown))}: unknown; ask {', '.join(QUESTIONS)}")
    if options.seeds < 2:
        parser.error(f"--seeds {options.seeds}: errors have standard errors from two seeds on")
    if not plot.available():
        parser.error("plots need matplotlib: pip install 'pathjax[bench]'")

    panels = []
    for name in options.questions or QUESTIONS:
        question, started = QUESTIONS[name], time.perf_counter()
        choices = question(options.res)
        rows = measure(choices, options.spp, options.seeds, options.reference_spp)
        print(f"\n{name}: {question.__doc__}\n\n{table(choices, rows)}\n\n{time.perf_counter() - started:.0f} s in all")
        lines = {c.label: (r, LOOKS[k % len(LOOKS)]) for k, (c, r) in enumerate(zip(choices, rows, strict=True))}
        panels.append((f"{name}: {question.__doc__}", lines))
    plot.write_panels(panels, options.output, columns=min(2, len(panels)))


if __name__ == "__main__":
    main()
