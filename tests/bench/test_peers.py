"""Peers run in separate processes and answer in the documented form; every shipped scene loads in Mitsuba."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pathjax.bench import peers
from pathjax.bench.peers import mitsuba3

ROOT = Path(__file__).resolve().parents[2]
SCENES = sorted([*ROOT.glob("scenes/*.xml"), *ROOT.glob("tests/scenes/*.xml")])
FURNACE = str(ROOT / "scenes" / "furnace.xml")

needs_mitsuba = pytest.mark.skipif(not importlib.util.find_spec("mitsuba"), reason="Mitsuba is not installed")
needs_embree = pytest.mark.skipif(not importlib.util.find_spec("embreex"), reason="embreex is not installed")


def peer(request, tmp_path):
    """Run the peer by its path, as its documentation says."""
    file = tmp_path / "request.json"
    file.write_text(json.dumps(request))
    return subprocess.run([sys.executable, mitsuba3.__file__, str(file)], capture_output=True, text=True)


@needs_mitsuba
@pytest.mark.parametrize("scene", SCENES, ids=lambda path: path.stem)
def test_scene_renders_in_mitsuba(scene):
    run = {"sampler": "independent", "spp": 1, "seeds": [1]}
    _, arrays = peers.call("mitsuba3", {"scene": str(scene), "variant": "scalar_rgb", "runs": [run]})
    image = arrays["images_0"][0]
    assert image.ndim == 3 and np.isfinite(image).all() and image.max() > 0


@needs_mitsuba
def test_report_and_arrays(tmp_path):
    request = {
        "scene": FURNACE,
        "parameters": {"res": 8, "max_depth": 3},
        "variant": "scalar_rgb",
        "runs": [
            {"sampler": "stratified", "spp": 15, "seeds": [1, 2, 3]},
            {"sampler": "independent", "spp": 64, "seeds": list(range(8))},
        ],
        "output": str(tmp_path / "out.npz"),
    }
    done = peer(request, tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    with np.load(tmp_path / "out.npz") as arrays:
        assert arrays["images_0"].shape == (3, 8, 8, 3)
        assert arrays["images_0"].dtype == np.float32
        assert not np.array_equal(arrays["images_0"][0], arrays["images_0"][1])  # seeds have an effect
        # the closed form of furnace.xml; pixels are independent, so the mean over them has a known error
        rho = np.array([0.2, 0.5, 0.8])
        images = arrays["images_1"].astype(float)
        error = np.sqrt(images.var(0, ddof=1).mean((0, 1)) / 8 / 64)
        z = (images.mean((0, 1, 2)) - (1 - rho**3) / (1 - rho)) / error
        assert np.all(np.abs(z) < 5)
    stratified = report["runs"][0]
    assert stratified["spp"] == 16  # rounded up, and reported
    assert len(stratified["seconds"]) == len(stratified["cpu_seconds"]) == 3


@needs_mitsuba
def test_wrong_requests_are_refused():
    run = {"sampler": "independent", "spp": 1, "seeds": [1]}
    with pytest.raises(peers.RequestError, match="no such file"):
        peers.call("mitsuba3", {"scene": "nowhere.xml", "variant": "scalar_rgb", "runs": [run]})
    with pytest.raises(peers.RequestError, match="'sobol' is unknown"):
        sobol = run | {"sampler": "sobol"}
        peers.call("mitsuba3", {"scene": FURNACE, "variant": "scalar_rgb", "runs": [sobol]})
    with pytest.raises(peers.PeerFailed, match="colour"):
        peers.call("mitsuba3", {"scene": FURNACE, "parameters": {"colour": 1}, "variant": "scalar_rgb", "runs": [run]})


def test_llvm_versions_by_name():
    versions = {
        "/lib/x86_64-linux-gnu/libLLVM.so.19.1": 19,
        "/usr/lib/libLLVM-15.so.1": 15,
        "/usr/lib/llvm-14/lib/libLLVM-14.0.6.so.1": 14,
        "/usr/lib/llvm-18/lib/libLLVM.so": 18,
        "/opt/homebrew/opt/llvm@20/lib/libLLVM.dylib": 20,
        "/usr/lib/libLLVM.so": 0,
        "/usr/lib/llvm-14/lib/libLLVMCore.a": 14,
    }
    assert {name: mitsuba3.llvm_version(name) for name in versions} == versions


def test_old_llvm_is_refused_with_the_remedy(monkeypatch):
    monkeypatch.setattr(mitsuba3, "llvm_version", lambda library: 15)
    with pytest.raises(mitsuba3.PeerMissing, match="libllvm19"):
        mitsuba3.find_llvm()


@needs_embree
def test_embree_finds_the_nearest_triangle(tmp_path):
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    vertices = np.concatenate([square, square - [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    origins = np.array([[0.7, 0.2, 2], [0.2, 0.7, 2], [0.7, 0.2, -0.5], [3, 3, 2]])
    directions = np.tile([0.0, 0.0, -1.0], (4, 1))
    rays = str(tmp_path / "rays.npz")
    np.savez(rays, vertices=vertices, faces=faces, origins=origins, directions=directions)
    report, found = peers.call("embree", {"rays": rays, "runs": 3})
    np.testing.assert_array_equal(found["primitive"], [0, 1, 2, -1])
    assert report["mrays_per_second"] > 0
