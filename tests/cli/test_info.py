"""`pathjax info`: the contents of a scene, its parameters and its tail."""

import json

import numpy as np
import pytest

import pathjax as pj
from pathjax.images import write_png
from pathjax.media.gridvolume import write_vol

FURNACE = "scenes/furnace.xml"


@pytest.mark.parametrize("name", ["scenes/glass_and_mirror.xml", "tests/scenes/conductors.xml", "scenes/mesh.xml"])
def test_info_lists_every_parameter(run, name):
    status, out, _ = run("info", name)
    parameters = pj.parameters(pj.load_scene(name))
    assert status == 0
    assert parameters
    lines = [line.split() for line in out.splitlines()]
    for parameter in parameters:
        assert any(line[:1] == [parameter] for line in lines), parameter


def test_info_tells_how_many_numbers_stand_in_one_line(run, write_scene, tmp_path):
    write_vol(tmp_path / "fog.vol", np.full((2, 3, 4, 1), 0.5, np.float32))
    write_png(tmp_path / "dots.png", np.full((5, 6, 3), 0.25))
    bitmap = f'<texture type="bitmap" name="%s"><string name="filename" value="{tmp_path}/dots.png"/></texture>'
    grid = f'<volume type="gridvolume" name="sigma_t"><string name="filename" value="{tmp_path}/fog.vol"/></volume>'
    path = write_scene(
        f"""<shape type="sphere"><bsdf type="null"/>
        <medium type="heterogeneous" name="interior" id="fog">{grid}</medium></shape>
        <shape type="sphere"><bsdf type="roughconductor" id="metal">
        {bitmap % "alpha"}{bitmap % "specular_reflectance"}</bsdf></shape>"""
    )
    path.write_text(path.read_text().replace('"path"', '"volpath"'))
    _, out, _ = run("info", path)
    assert "2 x 3 x 4 values, mean 0.5 " in out
    assert out.count("5 x 6 texels, mean ") == 2


def test_info_as_json(run):
    status, out, _ = run("info", "scenes/glass_and_mirror.xml", "-D", "res=20", "--set", "glass.int_ior=1.25", "--json")
    facts = json.loads(out)
    assert status == 0
    assert facts["image"] == {"width": 20, "height": 20, "filter": "box", "spp": 256}
    assert facts["camera"] == "thinlens"
    assert facts["integrator"]["max_depth"] == 12
    assert facts["primitives"]["spheres"] == 5
    assert facts["parameters"]["glass.int_ior"]["value"] == 1.25
    assert facts["parameters"]["glass.int_ior"]["shape"] == []
    assert facts["parameters"]["sky.radiance"]["bounds"] == [0, None]
    assert set(facts["compiled"]["bsdfs"]) == {"diffuse", "conductor", "dielectric"}


def test_info_tells_of_the_sampler_and_the_tree(run):
    _, out, _ = run("info", "scenes/mesh.xml")
    assert "independent" in out
    assert "20800 triangles" in out
    assert "SAH cost" in out
    assert "sampler" in out


def test_info_suggests_a_depth_for_a_tail(run):
    """The furnace's largest albedo is 0.8: 0.8^30 > 0.001 > 0.8^31. With so many pixels the noise of the terms is a
    quarter of a step."""
    large = "-D", "res=96"
    _, out, _ = run("info", FURNACE, *large, "--tail", 0.001, "--json")
    facts = json.loads(out)["tail"]
    assert 30 <= facts["max_depth"] <= 32
    _, out, _ = run("info", FURNACE, *large, "--tail", 0.001)
    assert f"max_depth {facts['max_depth']} would cut off no more than 0.001" in out
    np.testing.assert_allclose(facts["cut_off"], [0.2**8, 0.5**8, 0.8**8], rtol=0.1)


def test_info_of_a_scene_without_parameters_or_shapes(run, write_scene):
    status, out, _ = run("info", write_scene(""))
    assert status == 0
    assert "none" in out
