"""Every example runs, at a reduced size, and writes its image."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
SMALL = {
    "cornell_albedos": ["--res", "24", "--target-spp", "256", "--spp", "32"],
    "glass_ior": ["--res", "32", "--target-spp", "256", "--spp", "16"],
    "three_views": ["--res", "24", "--target-spp", "128", "--spp", "16"],
    "identifiability": ["--res", "16", "--target-spp", "256", "--spp", "32"],
    "radiosity": ["--res", "32", "--spp", "16", "--patches", "60", "200"],
    "texture": ["--size", "16", "--res", "48", "--target-spp", "256", "--spp", "16"],
    "own_loss": ["--res", "16", "--spp", "8", "--steps", "5"],
    "choices": ["--res", "16", "--spp", "4,16", "--seeds", "2", "--reference-spp", "256"],
    "rough_metal": ["--res", "24", "--target-spp", "256", "--spp", "32"],
    "own_bsdf": ["--res", "24", "--target-spp", "256", "--spp", "16"],
    "original_results": ["--res", "32", "--spp", "8"],
    "planning": ["--res", "480", "--rows", "48", "--spp", "4"],
    "check_mitsuba": ["--res", "32", "--spp", "16", "--seeds", "8"],
}
# Modules that are no dependencies of pathjax.
NEEDS = {"choices": "matplotlib", "check_mitsuba": "mitsuba"}


def test_every_example_is_run_here():
    assert {path.stem for path in ROOT.glob("examples/*.py")} == SMALL.keys()


def python_finds(*folders):
    places = [*map(str, folders), os.environ.get("PYTHONPATH")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_example_runs_and_writes_its_picture(name, tmp_path):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    command = [sys.executable, ROOT / "examples" / f"{name}.py", *SMALL[name], "-o", tmp_path / "out.png"]
    environment = python_finds(ROOT)
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "out.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 50
    if name == "identifiability":
        assert "not determined" in done.stdout
    if name == "check_mitsuba":
        assert done.stdout.count("passes") == 2 and "prb in the place of the ball is wrong" in done.stdout


def test_without_mitsuba_its_example_says_so(tmp_path):
    """A fake module hides Mitsuba and fails as a missing one does."""
    (tmp_path / "mitsuba.py").write_text("raise ModuleNotFoundError")
    environment = python_finds(tmp_path, ROOT)
    command = [sys.executable, ROOT / "examples" / "check_mitsuba.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and "pip install 'pathjax[bench]'" in done.stderr
