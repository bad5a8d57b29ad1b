"""`pathjax fit`: its table, its files, and its refusals."""

import io
import json
import sys

import numpy as np
import pytest

import pathjax as pj
from pathjax import inverse
from pathjax.images import read_exr, write_exr, write_png

FURNACE = "scenes/furnace.xml"
SMALL = ("-D", "res=8")
# A byte that UTF-8 never contains, as Python represents it in arguments and file names.
BYTE = "\udcff"


def write_target(path, **changes):
    """Write the furnace's image, with another albedo than its file's, and return the path."""
    scene = pj.with_parameters(pj.load_scene(FURNACE, res=8), {"wall.reflectance": [0.3, 0.5, 0.7], **changes})
    image = np.asarray(pj.render(scene, 256, seed=1))
    if path.suffix == ".exr":
        write_exr(path, {c: image[..., i] for i, c in enumerate("RGB")}, {})
    else:
        write_png(path, image)
    return path


@pytest.fixture
def target(tmp_path):
    return write_target(tmp_path / "target.exr")


@pytest.mark.parametrize("kind", ["exr", pytest.param("png", marks=pytest.mark.slow)])
def test_fit_prints_a_table_and_writes_its_files(run, tmp_path, kind):
    target = write_target(tmp_path / f"target.{kind}", **{"glow.radiance": [0.2, 0.2, 0.2]})
    start = "--set", "glow.radiance=0.2", "--param", "wall.reflectance=0.6"
    status, out, err = run("fit", FURNACE, target, *SMALL, *start, "-o", tmp_path / "f")
    assert status == 0
    assert all(f"wall.reflectance.{c}" in out and "+-" in out for c in "rgb")
    facts = json.loads((tmp_path / "f.json").read_text())
    assert facts["converged"] and facts["values"].keys() == {"wall.reflectance"}
    z = (np.array(facts["values"]["wall.reflectance"]) - [0.3, 0.5, 0.7]) / facts["standard_errors"]["wall.reflectance"]
    assert np.abs(z).max() < 4.5
    assert (tmp_path / "f.png").stat().st_size > 0


def test_a_fit_keeps_its_values_whatever_happens_to_its_files(run, root, target, tmp_path, monkeypatch):
    """The names contain characters that markup, terminals and UTF-8 lack; the folder is gone when the fit ends."""
    scene, there = tmp_path / f"{BYTE}.xml", tmp_path / "there"
    scene.write_text((root / FURNACE).read_text().replace('"wall"', '"weiß[/b]"'), encoding="utf-8")
    there.mkdir()
    monkeypatch.chdir(tmp_path)

    def fit(*arguments, plain=inverse.fit, **keywords):
        found = plain(*arguments, **keywords)
        there.rmdir()
        return found

    monkeypatch.setattr(inverse, "fit", fit)
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, "ascii"))
    param = ("--param", "weiß[/b].reflectance=0.6")
    status, _, err = run("fit", scene, target, *SMALL, *param, "-o", there / f"f{BYTE}")
    assert status == 1
    assert rb"wei\xdf[/b].reflectance.r" in shown.getvalue()
    for name in (f"f{BYTE}.json", f"f{BYTE}.png"):
        assert rf"{tmp_path}/{name}".replace(BYTE, r"\udcff") + " was written instead" in err
    facts = json.loads((tmp_path / f"f{BYTE}.json").read_text())
    assert facts["converged"] and facts["values"].keys() == {"weiß[/b].reflectance"}


def test_a_command_does_not_overwrite_what_it_reads(refused, target, tmp_path):
    picture = tmp_path / "target.png"
    write_png(picture, np.full((8, 8, 3), 0.5))
    says = [f"{picture}: is read by the same command"]
    refused("fit", FURNACE, picture, *SMALL, "--param", "wall.reflectance", "-o", tmp_path / "target", says=says)
    refused("compare", picture, target, "-o", picture, says=says)
    both = tmp_path / "a.exr"
    refused("render", FURNACE, *SMALL, "-o", both, "--checkpoint", both, says=[f"{both}: is read by the same command"])


def test_fit_as_json(run, target, tmp_path):
    status, out, _ = run(
        "fit", FURNACE, target, *SMALL, "--param", "wall.reflectance", "--spp", "16", "-o", tmp_path / "f", "--json"
    )
    assert status == 0
    assert json.loads(out) == json.loads((tmp_path / "f.json").read_text())


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--param", "wal.reflectance"], ["wal.reflectance", "did you mean wall.reflectance"]),
        (["--param", "wall.reflectance=2"], ["wall.reflectance", "outside its bounds"]),
        (["--param", "wall.reflectance=red"], ["--param", "a value is a number"]),
        (["--param", "wall.reflectance", "-D", "res=9"], ["(8, 8, 3)", "(9, 9, 3)"]),
        ([], ["--param"]),
    ],
)
def test_fits_that_cannot_be(refused, target, tmp_path, arguments, says):
    refused("fit", FURNACE, target, *SMALL, *arguments, "-o", tmp_path / "f", says=says)


def test_a_png_that_is_clipped_everywhere_is_refused(refused, tmp_path):
    target = write_target(tmp_path / "target.png")
    param = "--param", "wall.reflectance"
    refused("fit", FURNACE, target, *SMALL, *param, "-o", tmp_path / "f", says=["every pixel", "clipped"])


def test_fit_without_a_target_or_a_folder(refused, target, tmp_path):
    param = ["--param", "wall.reflectance"]
    absent = tmp_path / "none.exr"
    refused("fit", FURNACE, absent, *SMALL, *param, "-o", tmp_path / "f", says=["none.exr", "no such file"])
    refused("fit", FURNACE, target, *SMALL, *param, "-o", tmp_path / "none" / "f", says=["there is no folder"])


@pytest.mark.slow
def test_a_fitted_texture_becomes_an_image_beside_its_report(run, root, tmp_path):
    texels = np.random.default_rng(0).uniform(0.3, 0.7, (3, 2, 2)).astype(np.float32)
    write_exr(tmp_path / "texels.exr", dict(zip("RGB", texels, strict=True)), {})
    text = (root / FURNACE).read_text()
    before, _, after = text.partition("<rgb name=\"reflectance\"")
    bitmap = '<texture type="bitmap" name="reflectance"><string name="filename" value="texels.exr"/>'
    bitmap += '<boolean name="raw" value="true"/></texture>'
    (tmp_path / "scene.xml").write_text(before + bitmap + after.partition("/>")[2])
    scene = pj.load_scene(tmp_path / "scene.xml", res=16)
    image = np.moveaxis(np.asarray(pj.render(scene, 64, seed=1)), -1, 0)
    write_exr(tmp_path / "target.exr", dict(zip("RGB", image, strict=True)), {})
    arguments = "-D", "res=16", "--param", "wall.reflectance=0.5", "--smoothness", "auto", "--spp", "16"
    status, out, _ = run("fit", tmp_path / "scene.xml", tmp_path / "target.exr", *arguments, "-o", tmp_path / "f")
    assert status == 0 and "2 x 2 texels, 100% of them seen" in out, out
    facts = json.loads((tmp_path / "f.json").read_text())
    assert not facts["values"] and facts["textures"]["wall.reflectance"]["seen"] == 1
    found, _ = read_exr(tmp_path / "f.wall.reflectance.exr")
    fitted = pj.parameters(pj.load_scene(tmp_path / "f.xml"))["wall.reflectance"]
    for i, c in enumerate("RGB"):
        np.testing.assert_allclose(found[c], fitted[..., i], atol=1e-6)
        assert np.abs(found[c] - texels[i]).max() < 0.05 and (found[f"error.{c}"] < 0.05).all()


@pytest.mark.slow
def test_a_fitted_map_of_roughness_becomes_an_image_of_one_channel(run, tmp_path):
    """Three texels in a row are not taken for a colour, and neighbours are smoothed as those of colours are."""
    texels = np.array([[0.2, 0.3, 0.4], [0.3, 0.4, 0.5]], np.float32)
    write_exr(tmp_path / "alpha.exr", dict.fromkeys("RGB", texels), {})
    image = '<string name="filename" value="alpha.exr"/><boolean name="raw" value="true"/>'
    (tmp_path / "scene.xml").write_text(
        f"""<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
        <sensor type="perspective"><float name="fov" value="32"/>
            <transform name="to_world"><lookat origin="0, 3.2, 2.5" target="0, 0, 0" up="0, 1, 0"/></transform>
            <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
        <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/></transform>
            <bsdf type="roughconductor" id="metal"><texture type="bitmap" name="alpha">{image}</texture></bsdf></shape>
        <emitter type="point"><point name="position" x="-1" y="2" z="-2"/></emitter>
        <emitter type="constant"><float name="radiance" value="0.2"/></emitter></scene>"""
    )
    scene = pj.load_scene(tmp_path / "scene.xml")
    layers = np.moveaxis(np.asarray(pj.render(scene, 1024, seed=1)), -1, 0)
    write_exr(tmp_path / "target.exr", dict(zip("RGB", layers, strict=True)), {})
    arguments = "--param", "metal.alpha=0.3", "--smoothness", "auto", "--spp", "64"
    _, out, _ = run("fit", tmp_path / "scene.xml", tmp_path / "target.exr", *arguments, "-o", tmp_path / "f")
    assert "2 x 3 texels, 100% of them seen" in out, out
    found, _ = read_exr(tmp_path / "f.metal.alpha.exr")
    assert sorted(found) == ["Y", "error.Y"]
    np.testing.assert_allclose(found["Y"], pj.parameters(pj.load_scene(tmp_path / "f.xml"))["metal.alpha"], atol=1e-6)
    assert np.abs(found["Y"] - texels).max() < 0.05
