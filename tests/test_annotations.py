"""Annotations between rooms hold (types, shapes and dtypes) where scenes are rendered, differentiated and fitted."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

CHECKED = Path(__file__).with_name("checked_annotations.py")


def run(arguments, **how):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=600, **how)


def test_annotations_hold_in_images_and_jacobians(root):
    done = run([CHECKED, "--no-fit", "scenes/glass_ball.xml"], cwd=root)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("half", [0, 1])
def test_annotations_hold_in_every_scene_and_in_a_fit(root, half):
    """The fit runs with the first half; two workers can take one half each."""
    files = [*sorted(root.glob("scenes/*.xml")), *sorted(root.glob("tests/scenes/*.xml"))][half::2]
    done = run([CHECKED, *(["--no-fit"] if half else ["scenes/furnace.xml"]), *files], cwd=root)
    assert done.returncode == 0, done.stderr


def test_shapes_in_annotations_can_be_read(root):
    """jaxtyping parses a shape only when a value is checked, perhaps in no quick test: "3M" is no valid dimension."""
    shapes = re.compile(r"\b(?:Array|ndarray)(?: \| \w+)*, \"([^\"]*)\"\]")
    files = list((root / "pathjax").rglob("*.py"))
    found = [(file.name, shape) for file in files for shape in shapes.findall(file.read_text())]
    assert len(found) > 1000

    def readable(dimension):
        name = dimension.lstrip("*#?_")
        parts = re.split(r"[-+*]", name.strip("{}"))
        return name in ("", "...") or all(part.isidentifier() or part.isdigit() for part in parts)

    assert not [(file, shape) for file, shape in found if not all(map(readable, shape.split()))]


WRONG = """
from __future__ import annotations
from dataclasses import dataclass
from typing import NamedTuple
from jaxtyping import Array, Float, Int

class Pair(NamedTuple):
    xy: Float[Array, "2"]

@dataclass
class Table:
    row: Int[Array, ""]

def takes(xy: Float[Array, "2"]):
    return 0

def gives(x) -> Float[Array, "2"]:
    return x

def agree(a: Float[Array, " n"], b: Float[Array, " n"]) -> None:
    return None

def pair(x):
    return Pair(x)

def table(x):
    return Table(x)
"""
CALLS = """
import jax, jax.numpy as jnp, numpy as np
from checked_annotations import load
wrong = load("wrong")
two, three, zero = jnp.ones(2), jnp.ones(3), np.int32(0)
for good in (lambda: wrong.takes(two), lambda: wrong.gives(two), lambda: wrong.pair(two), lambda: wrong.table(zero),
             lambda: wrong.agree(two, two), lambda: jax.vmap(wrong.pair)(jnp.ones((3, 2)))):
    good()
for bad in (lambda: wrong.takes(three), lambda: wrong.gives(three), lambda: wrong.pair(three),
            lambda: wrong.table(np.float32(0)), lambda: wrong.agree(two, three), lambda: wrong.takes(jnp.ones(2, int))):
    try:
        bad()
    except TypeError:
        continue
    raise SystemExit("a wrong annotation was not noticed")
"""


def test_wrong_annotations_are_noticed(tmp_path):
    (tmp_path / "wrong").mkdir()
    (tmp_path / "wrong" / "__init__.py").write_text(WRONG)
    done = run(["-c", f"import sys\nsys.path[:0] = [{str(CHECKED.parent)!r}, {str(tmp_path)!r}]\n{CALLS}"])
    assert done.returncode == 0, done.stderr
