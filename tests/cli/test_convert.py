"""`pathjax convert` writes what can be loaded as a scene file."""

import json
from pathlib import Path

import numpy as np
import pytest

import pathjax as pj

MESH = "tests/scenes/meshes/cube.obj"


def test_a_scene_is_written_with_the_values_that_are_set(run, tmp_path):
    arguments = "scenes/cornell_box.xml", tmp_path / "out.xml", "-D", "res=24", "--set", "white.reflectance=0.25"
    assert run("convert", *arguments) == (0, "", "")
    scene = pj.load_scene(tmp_path / "out.xml")
    np.testing.assert_array_equal(pj.parameters(scene)["white.reflectance"], [0.25] * 3)
    assert scene.film.width == 24


def test_json_lists_the_files(run, tmp_path):
    status, out, _ = run("convert", "scenes/meshes/knot.ply", tmp_path / "out.xml", "--json")
    facts = json.loads(out)
    assert status == 0
    assert facts["files"] == [str(tmp_path / "out_mesh.ply"), facts["output"]]
    assert all(Path(file).is_file() for file in facts["files"])
    assert any("has no camera" in note for note in facts["notes"])


def test_bad_input_is_refused(refused, tmp_path):
    refused("convert", "scenes/none.xml", tmp_path / "out.xml", says=["none.xml"])
    refused("convert", "scenes/furnace.xml", tmp_path / "out.glb", says=["scenes are written as .xml"])
    refused("convert", "scenes/furnace.xml", "scenes/furnace.xml", says=["is read by the same command"])
    refused("convert", "scenes/furnace.xml", tmp_path / "none" / "out.xml", says=["there is no folder"])
    refused("render", "scenes/meshes/knot.ply", "-o", tmp_path / "a.png", "-D", "spp=3", says=["it has: res"])


@pytest.mark.parametrize("res", ["0", "-1", "many", "1.5"])
def test_the_width_of_a_mesh_is_a_number_of_pixels(refused, tmp_path, res):
    says = ["knot.ply: res must be a whole number"]
    refused("render", "scenes/meshes/knot.ply", "-o", tmp_path / "a.png", "-D", f"res={res}", says=says)
