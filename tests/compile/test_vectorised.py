"""Everything public in the form for accelerators, which a CPU takes where native loops are off."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

SCRIPT = """
import sys
import jax
import numpy as np
import pathjax as pj
from pathjax.compile import native

scene = pj.load_scene(sys.argv[1], res=8)
names = list(pj.parameters(scene))
image, J = pj.jacobian(scene, names, 4, 1)
results = [image, list(J.values())]
if sys.argv[3] == "all":
    rays = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    results += [pj.render(scene, 4, 1), pj.render_aovs(scene, ["depth", "albedo"]), pj.closest_hit(scene, *rays).t]
    results += [pj.render_until(scene, 0.2, seed=1).image, pj.render_bounces(scene, 3, spp=4, seed=1).terms]
np.savez(sys.argv[2], *map(np.asarray, jax.tree.leaves(results)), native=native())
"""


@pytest.mark.parametrize(
    ("name", "kernels"),
    [("furnace", "jacobian")]
    + [pytest.param(name, "all", marks=pytest.mark.slow) for name in ("cornell_box", "glass_ball", "mesh")],
)
def test_kernels_agree_with_native_loops(root, tmp_path, name, kernels):
    """Where rounding tips a decision a path goes another way, so a few numbers may differ at all."""
    results = []
    for native in "10":
        out = tmp_path / f"{native}.npz"
        environment = {**os.environ, "PATHJAX_NATIVE_LOOPS": native, "PYTHONPATH": str(root)}
        environment.pop("XLA_FLAGS", None)  # of this process, which has native loops
        command = [sys.executable, "-c", SCRIPT, str(root / "scenes" / f"{name}.xml"), str(out), kernels]
        subprocess.run(command, check=True, env=environment, cwd=tmp_path)
        results.append(dict(np.load(out)))
    assert [bool(result.pop("native")) for result in results] == [True, False]
    for key, value in results[0].items():
        largest = np.abs(value[np.isfinite(value)]).max(initial=0)
        close = np.isclose(value, results[1][key], rtol=1e-3, atol=1e-4 * largest)
        assert close.mean() > 0.95 if close.size else True, key
