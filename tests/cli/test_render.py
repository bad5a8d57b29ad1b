"""`pathjax render`: images, their channels and headers, limits, scenes without light."""

import json

import numpy as np
import pytest

import pathjax as pj
from pathjax.images import linear_to_srgb, read_exr

FURNACE = "scenes/furnace.xml"
SMALL = ("-D", "res=8")


def test_render_writes_the_image_of_render_until(run, tmp_path):
    status, out, _ = run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 4, "--seed", 3)
    assert (status, out) == (0, "")
    channels, header = read_exr(tmp_path / "a.exr")
    assert set(channels) == {"R", "G", "B"}
    assert all(channel.dtype == np.float32 and channel.shape == (8, 8) for channel in channels.values())
    image = np.stack([channels[c] for c in "RGB"], -1)
    np.testing.assert_array_equal(image, pj.render_until(pj.load_scene(FURNACE, res=8), spp=4, seed=3).image)
    assert header["pathjax.seed"] == 3
    assert header["pathjax.spp"] == 4
    assert header["pathjax.version"] == pj.__version__
    assert header["pathjax.scene"] == FURNACE
    assert "res=8" in header["pathjax.parameters"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_render_writes_png_in_srgb(run, tmp_path):
    from PIL import Image

    arguments = ("render", FURNACE, *SMALL, "-D", "max_depth=1", "--set", "glow.radiance=0.2,0.5,1", "-o")
    assert run(*arguments, tmp_path / "a.png", "--spp", 2)[0] == 0
    image = np.asarray(Image.open(tmp_path / "a.png"))
    assert image.dtype == np.uint8
    expected = np.rint(255 * linear_to_srgb(np.array([0.2, 0.5, 1])))
    np.testing.assert_array_equal(image, np.broadcast_to(expected, (8, 8, 3)))


def test_same_command_writes_the_same_pixels_and_another_seed_others(run, tmp_path):
    images = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        path = tmp_path / f"{name}.exr"
        assert run("render", FURNACE, *SMALL, "-o", path, "--spp", 40, "--seed", seed)[0] == 0
        images.append(read_exr(path)[0]["R"])
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_json_is_one_object_on_stdout(run, tmp_path):
    status, out, _ = run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 8, "--json")
    report = json.loads(out)
    assert status == 0
    assert out.count("\n") == 1
    assert (report["width"], report["height"], report["spp"], report["seed"]) == (8, 8, 8, 0)
    assert report["output"] == str(tmp_path / "a.exr")
    assert report["interrupted"] is False
    assert report["not_finite_pixels"] == 0
    assert report["reason"] == "spp"
    assert 0 <= report["error"] <= report["error_bound"]
    assert report["fewest_spp"] == report["most_spp"] == 8
    assert report["compile_seconds"] > 0 and report["run_seconds"] > 0


def test_spp_defaults_to_the_files(run, tmp_path):
    _, out, _ = run("render", FURNACE, *SMALL, "-D", "spp=5", "-o", tmp_path / "a.exr", "--json")
    assert json.loads(out)["spp"] == 5


def test_set_changes_parameters(run, tmp_path):
    settings = ("--set", "wall.reflectance=0", "--set", "glow.radiance=0.5,2,3")
    assert run("render", FURNACE, *SMALL, *settings, "-o", tmp_path / "a.exr", "--spp", 1)[0] == 0
    channels, header = read_exr(tmp_path / "a.exr")
    assert [channels[c][3, 4] for c in "RGB"] == [0.5, 2, 3]
    assert "glow.radiance=0.5,2,3" in header["pathjax.parameters"]


def test_strategy_is_heard(run, tmp_path):
    arguments = ("render", FURNACE, *SMALL, "-D", "max_depth=4", "--strategy", "bsdf")
    assert run(*arguments, "-o", tmp_path / "a.exr", "--spp", 1)[0] == 0
    red = read_exr(tmp_path / "a.exr")[0]["R"]
    np.testing.assert_allclose(red, 1.248, rtol=1e-5)  # without light sampling a furnace has no noise


def test_an_existing_file_is_replaced_whole(run, tmp_path):
    (tmp_path / "a.exr").write_bytes(b"old")
    assert run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 1)[0] == 0
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"R", "G", "B"}


# ---- errors, time and checkpoints -----------------------------------------------------------------------------------


def test_error_is_reached(run, tmp_path):
    _, out, _ = run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--error", 0.05, "--json")
    report = json.loads(out)
    assert report["reason"] == "target error"
    assert report["error"] < report["error_bound"] <= 0.05
    assert report["spp"] != 64  # the file's


@pytest.mark.parametrize(
    "limit, reason, says", [(("--time", 0.2), "time limit", "out of time"), (("--spp", 20), "spp", "out of samples")]
)
def test_an_error_that_is_not_reached_is_a_failure(run, tmp_path, limit, reason, says):
    arguments = ("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", *limit, "--json")
    status, out, err = run(*arguments, "--error", 1e-5)
    report = json.loads(out)
    assert (status, report["reason"]) == (1, reason)
    assert says in err and f"at most {report['error_bound']:.3g}, not yet 1e-05" in err
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"R", "G", "B"}
    assert run(*arguments)[0] == 0


@pytest.mark.parametrize(
    "radiance, says",
    [("0", "it is black"), ("1e-36", "it is black, or nearly so"), ("3e38", "64 of its pixels are not finite")],
)
def test_an_error_that_cannot_be_told_is_a_failure(run, tmp_path, radiance, says):
    arguments = ("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--set", f"glow.radiance={radiance}", "--json")
    status, out, err = run(*arguments, "--error", 0.02)
    report = json.loads(out)
    assert (status, report["reason"], report["error"]) == (1, "no estimate", None)
    assert f"its error cannot be told, for {says}" in err and "from 1e-31 to 1e36" in err
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"R", "G", "B"}


@pytest.mark.parametrize("radiance", ["1e-20", "1e20", "2.2e25"])
def test_error_is_reached_in_any_unit_of_radiance(run, tmp_path, radiance):
    """As many samples as for radiance 1; bright lamps once ended with 16 samples and an error of 0."""
    arguments = ("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--aov", "error", "--error", 0.01, "--json")
    one = json.loads(run(*arguments)[1])
    status, out, _ = run(*arguments, "--set", f"glow.radiance={radiance}")
    report = json.loads(out)
    assert (status, report["reason"]) == (0, "target error")
    assert report["spp"] == pytest.approx(one["spp"], rel=0.1) and one["spp"] > 16
    assert report["error"] == pytest.approx(one["error"], rel=0.1)
    errors = read_exr(tmp_path / "a.exr")[0]["error.R"]
    assert (errors > 1e-4 * float(radiance)).all() and (errors < 0.1 * float(radiance)).all()


def test_checkpoint_is_taken_up(run, tmp_path):
    files = ("-o", tmp_path / "a.exr", "--checkpoint", tmp_path / "run.npz")
    # Portions of 4 and 12, as without a stop.
    assert run("render", FURNACE, *SMALL, *files, "--spp", 4)[0] == 0
    assert run("render", FURNACE, *SMALL, *files, "--spp", 16)[0] == 0
    expected = pj.render_until(pj.load_scene(FURNACE, res=8), spp=16).image
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0]["R"], expected[..., 0])


def test_output_variables_are_channels(run, tmp_path):
    arguments = ("--aov", "normal,error,depth,albedo", "--spp", 4, "--seed", 2)
    assert run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", *arguments)[0] == 0
    channels, _ = read_exr(tmp_path / "a.exr")
    scene = pj.load_scene(FURNACE, res=8)
    expected = pj.render_aovs(scene, ["depth", "normal", "albedo"], spp=4, seed=2)
    result = pj.render_until(scene, spp=4, seed=2)
    expected |= {"error": result.standard_error}
    names = {"error": "RGB", "depth": "Z", "normal": "XYZ", "albedo": "RGB"}
    assert set(channels) == {*"RGB", *(f"{name}.{c}" for name, letters in names.items() for c in letters)}
    for name, letters in names.items():
        image = np.stack([channels[f"{name}.{c}"] for c in letters], -1)
        np.testing.assert_array_equal(image, expected[name])


def test_bounces_are_channels_that_add_up_to_the_image(run, tmp_path):
    arguments = ("-D", "max_depth=3", "--aov", "bounces", "--spp", 4, "--seed", 2)
    assert run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", *arguments)[0] == 0
    channels, _ = read_exr(tmp_path / "a.exr")
    layers = {f"bounces.{k}.{what}{c}" for k in range(3) for what in ("", "error.") for c in "RGB"}
    assert set(channels) == {*"RGB", *layers}
    for c in "RGB":
        np.testing.assert_allclose(sum(channels[f"bounces.{k}.{c}"] for k in range(3)), channels[c], rtol=1e-6)
        assert (channels[f"bounces.2.error.{c}"] > 0).all()


# ---- dark scenes ----------------------------------------------------------------------------------------------------


BALL = '<shape type="sphere"/>'


@pytest.mark.parametrize(
    "lights, arguments, says",
    [
        ("", (), "there is no light"),
        ('<emitter type="constant"><rgb name="radiance" value="0"/></emitter>', (), "the radiance of every light is 0"),
        ('<emitter type="constant" id="sky"/>', ("--set", "sky.radiance=0"), "the radiance of every light is 0"),
        (
            '<emitter type="spot"/><emitter type="point"/>',
            (),
            "the point and spot emitters shine on smooth glass and mirrors alone, which show no light without size",
        ),
    ],
)
def test_a_scene_without_light_is_told(run, write_scene, tmp_path, lights, arguments, says):
    ball = BALL.replace("/>", '><bsdf type="dielectric"/></shape>') if "point" in lights else BALL
    scene = write_scene(ball + lights, res=4)
    status, _, err = run("render", scene, *arguments, "-o", tmp_path / "a.exr")
    assert status == 0
    assert err.strip() == f"pathjax: {scene}: {says}, so the image will be black"
    assert f"note        {says}, so images are black" in run("info", scene, *arguments)[1]


def test_a_light_that_was_set_is_one(run, write_scene, tmp_path):
    scene = write_scene(BALL + '<emitter type="constant" id="sky"><rgb name="radiance" value="0"/></emitter>', res=4)
    status, _, err = run("render", scene, "--set", "sky.radiance=1", "-o", tmp_path / "a.exr")
    assert (status, err.strip()) == (0, "")
    assert "black" not in run("info", scene, "--set", "sky.radiance=1")[1]


def test_light_that_is_never_met_is_told(run, write_scene, tmp_path):
    """The camera is in a closed box, the light outside."""
    box = '<shape type="cube"><transform name="to_world"><scale value="9"/></transform><bsdf type="twosided">'
    scene = write_scene(f'{box}<bsdf type="diffuse"/></bsdf></shape><emitter type="constant"/>', res=4, depth=3)
    status, _, err = run("render", scene, "-o", tmp_path / "a.exr")
    assert status == 0
    assert err.strip() == "pathjax: every pixel is black: none of the paths met a light"
