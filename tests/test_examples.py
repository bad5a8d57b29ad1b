"""Every example runs, at a reduced size, and writes its picture."""

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
    "own_loss": ["--res", "16", "--spp", "8", "--steps", "5"],
    "choices": ["--res", "16", "--spp", "4,16", "--seeds", "2", "--reference-spp", "256"],
    "own_bsdf": ["--res", "24", "--target-spp", "256", "--spp", "16"],
    "original_results": ["--res", "32", "--spp", "8"],
}


def test_every_example_is_run_here():
    assert {path.stem for path in ROOT.glob("examples/*.py")} == SMALL.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_example_runs_and_writes_its_picture(name, tmp_path):
    if name == "choices":
        pytest.importorskip("matplotlib")
    command = [sys.executable, ROOT / "examples" / f"{name}.py", *SMALL[name], "-o", tmp_path / "out.png"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "out.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 50
    if name == "identifiability":
        assert "not determined" in done.stdout
