"""The command line: exit status, messages, files. Most of it in this process, signals in one of its own."""

import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
import pytest
import trimesh

import pathjax as pj
from pathjax import cli, images, inverse
from pathjax.images import linear_to_srgb, read_exr, read_rgb, write_exr, write_png
from pathjax.rendering import bounces
from pathjax.rendering.progressive import until
from pathjax.system.interrupts import SIGNALS

FURNACE = "scenes/furnace.xml"
SMALL = ("-D", "res=8")

sends_signals = pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}


def environment(root):
    """One in which another process finds this pathjax, installed or not."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))}


@pytest.fixture
def run(root, tmp_path, monkeypatch, capfd):
    """(arguments) -> exit status, stdout, stderr, of `pathjax` in this process, in the checkout."""
    monkeypatch.chdir(root)

    def run(*arguments):
        capfd.readouterr()
        try:
            status = cli.main([str(a) for a in arguments])
        except SystemExit as error:  # argparse
            status = error.code
        return status, *capfd.readouterr()

    return run


@pytest.fixture
def refused(run, tmp_path):
    """Assert exit status 2, one message with all the given parts, and nothing written; returns the message."""

    def refused(*arguments, says=()):
        before = sorted(tmp_path.rglob("*"))
        status, out, err = run(*arguments)
        assert status == 2
        assert out == ""
        assert "Traceback" not in err
        for part in says:
            assert part in err
        assert sorted(tmp_path.rglob("*")) == before
        return err

    return refused


@pytest.fixture
def process(root):
    """Start `python -m pathjax` in the checkout."""

    def start(*arguments):
        command = [sys.executable, "-m", "pathjax", *map(str, arguments)]
        return subprocess.Popen(command, cwd=root, env=environment(root), **PIPES)

    return start


# ---- render ---------------------------------------------------------------------------------------------------------


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
    """As many samples as at 1; bright lamps ended with 16 and an error of 0."""
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


# ---- nothing is lost ------------------------------------------------------------------------------------------------

# A byte that no UTF-8 holds, as Python has it in arguments and names of files.
BYTE = "\udcff"


@pytest.fixture
def meanwhile(monkeypatch):
    """(what happens after the last sample, before anything is written)."""

    def install(act, plain=until.Render.run):
        def run(*arguments, **keywords):
            result = plain(*arguments, **keywords)
            act()
            return result

        monkeypatch.setattr(until.Render, "run", run)

    return install


def fill_disk(path):
    """What is written beside `path`, to be renamed, goes to a full disk."""
    (path.parent / f".{path.name}.{os.getpid()}.part").symlink_to("/dev/full")


@pytest.mark.parametrize(
    "happens, says",
    [
        (lambda path: shutil.rmtree(path.parent), "there is no folder"),
        (lambda path: path.mkdir(), "is a folder"),
        pytest.param(
            fill_disk, "No space left", marks=pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
        ),
    ],
)
@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_an_image_that_cannot_go_where_it_was_asked_for_goes_to_the_current_folder(
    run, root, tmp_path, monkeypatch, meanwhile, happens, says, name
):
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path)
    asked = tmp_path / "there" / name
    arguments = ("render", root / FURNACE, *SMALL, "--spp", 4, "--json", "-o")
    assert run(*arguments, asked)[0] == 0
    expected = asked.read_bytes()
    asked.unlink()
    meanwhile(lambda: happens(asked))
    status, out, err = run(*arguments, asked)
    assert status == 1
    assert f"{asked}: " in err and says in err and f"{tmp_path / name} was written instead" in err
    assert json.loads(out)["output"] == str(tmp_path / name)
    assert (tmp_path / name).read_bytes() == expected


def test_an_image_that_fits_nowhere_is_said_to_be_lost(run, root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(errno.EIO, "Input/output error")))
    status, out, err = run("render", root / FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 4, "--json")
    assert (status, json.loads(out)["output"]) == (1, None)
    assert "Input/output error" in err and "it is lost" in err
    assert not list(tmp_path.iterdir())


def test_a_full_disk_under_the_checkpoint_costs_no_image(run, tmp_path, monkeypatch):
    saves = iter(range(10**6))

    def savez(stream, plain=np.savez, **arrays):
        if next(saves):
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(stream, **arrays)

    monkeypatch.setattr(np, "savez", savez)
    files = ("-o", tmp_path / "a.exr", "--checkpoint", tmp_path / "run.npz")
    status, _, err = run("render", FURNACE, *SMALL, *files, "--spp", 4)
    assert status == 1
    assert (
        err.strip()
        == f"pathjax: {tmp_path}/run.npz: cannot be written: No space left on device; the render goes on without"
    )
    expected = pj.render_until(pj.load_scene(FURNACE, res=8), spp=4).image
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), expected)


def test_names_that_are_not_utf8(run, root, write_scene, tmp_path):
    """Of the scene, its folder, texture and meshes, the image and the checkpoint."""
    folder = tmp_path / f"d{BYTE}"
    folder.mkdir()
    write_png(folder / f"t{BYTE}.png", np.full((2, 2, 3), 0.5))
    mesh = trimesh.creation.box()
    for kind in ("obj", "ply", "stl", "glb"):
        with open(folder / f"m{BYTE}.{kind}", "wb") as file:
            exported = mesh.export(file_type=kind)
            file.write(exported.encode() if isinstance(exported, str) else exported)
    shapes = "".join(
        f'<shape type="{kind}"><string name="filename" value="m$byte.{kind}"/></shape>'
        for kind in ("obj", "ply", "stl", "glb")
    )
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="t$byte.png"/></texture>'
    picture = f'<shape type="rectangle"><bsdf type="diffuse">{texture}</bsdf></shape>'
    scene = folder / f"s{BYTE}.xml"
    shutil.copy(write_scene(shapes + picture + '<emitter type="constant"/>'), scene)
    assert run("info", scene, "-D", f"byte={BYTE}")[0] == 0

    shutil.copy(root / FURNACE, scene)
    files = ("-o", folder / f"o{BYTE}.exr", "--checkpoint", folder / f"c{BYTE}.npz")
    for _ in range(2):  # and again, from the checkpoint
        status, out, err = run("render", scene, *SMALL, *files, "--spp", 4, "--json")
        assert status == 0, err
        assert json.loads(out)["output"] == str(files[1])
    channels, header = read_exr(files[1])
    assert header["pathjax.scene"] == str(scene).replace(BYTE, r"\udcff")
    assert run("compare", files[1], files[1], "-o", folder / f"p{BYTE}.png")[0] == 0
    assert {f"{x}{BYTE}{end}" for x, end in (("o", ".exr"), ("c", ".npz"), ("p", ".png"))} <= set(os.listdir(folder))


def test_names_that_are_not_utf8_in_messages(refused, tmp_path):
    refused("render", f"{BYTE}.xml", "-o", tmp_path / "a.exr", says=[r"\udcff.xml: no such file"])
    refused("render", FURNACE, "-D", f"{BYTE}=1", "-o", tmp_path / "a.exr", says=[r"\udcff"])
    refused("render", FURNACE, "--set", f"{BYTE}=1", "-o", tmp_path / "a.exr", says=[r"\udcff"])
    refused("render", FURNACE, "-o", tmp_path / f"{BYTE}" / "a.exr", says=[r"there is no folder"])


@sends_signals
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_the_image_is_written_costs_nothing(run, tmp_path, monkeypatch, number):
    earlier = signal.signal(number, signal.default_int_handler)

    def write(*arguments, plain=images.write_exr):
        signal.raise_signal(number)
        plain(*arguments)

    monkeypatch.setattr(images, "write_exr", write)
    try:
        assert run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 4)[0] == 0
    finally:
        signal.signal(number, earlier)
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"R", "G", "B"}


@pytest.mark.parametrize(
    "error, says", [(KeyboardInterrupt, "interrupted"), (MemoryError("out of memory"), "out of memory")]
)
def test_bounces_that_fail_cost_no_image(run, tmp_path, monkeypatch, error, says):
    def fail(*_):
        raise error

    monkeypatch.setattr(bounces, "render_bounces", fail)
    arguments = ("-D", "max_depth=3", "--aov", "error,bounces", "--spp", 4)
    status, _, err = run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", *arguments)
    assert status == 1
    assert f"{says}; the bounces are left out" in err
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"R", "G", "B", "error.R", "error.G", "error.B"}


@sends_signals
def test_signals_that_come_after_the_image_is_rendered_cost_the_bounces_alone(run, tmp_path, monkeypatch):
    """One while the bounces are rendered, and two more while the image is written."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    earlier = [signal.signal(number, signal.default_int_handler) for number in numbers]
    rendering, written = [], threading.Event()

    def render_bounces(*arguments):
        rendering.append(threading.current_thread())
        signal.raise_signal(signal.SIGINT)
        written.wait(30)
        return pj.render_bounces(*arguments)

    def write(*arguments, plain=images.write_exr):
        for number in numbers:
            signal.raise_signal(number)
        plain(*arguments)
        written.set()
        rendering[0].join()

    monkeypatch.setattr(bounces, "render_bounces", render_bounces)
    monkeypatch.setattr(images, "write_exr", write)
    arguments = ("-D", "max_depth=3", "--aov", "error,bounces", "--spp", 4)
    try:
        status, _, err = run("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", *arguments)
    finally:
        for number, handler in zip(numbers, earlier, strict=True):
            signal.signal(number, handler)
    assert status == 1
    assert "interrupted; the bounces are left out" in err
    channels, _ = read_exr(tmp_path / "a.exr")
    assert set(channels) == {*"RGB", "error.R", "error.G", "error.B"}
    expected = pj.render_until(pj.load_scene(FURNACE, res=8, max_depth=3), spp=4).image
    np.testing.assert_array_equal(channels["R"], expected[..., 0])


def test_a_terminal_that_lacks_letters_shows_their_codes(run, root, tmp_path, monkeypatch):
    scene = tmp_path / "a.xml"
    scene.write_text((root / FURNACE).read_text().replace('"wall"', '"weiß"'), encoding="utf-8")
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, "ascii"))
    assert run("info", scene)[0] == 0
    assert rb"wei\xdf.reflectance" in shown.getvalue()


# ---- dark scenes ----------------------------------------------------------------------------------------------------


BALL = '<shape type="sphere"/>'


@pytest.mark.parametrize(
    "lights, arguments, says",
    [
        ("", (), "there is no light"),
        ('<emitter type="constant"><rgb name="radiance" value="0"/></emitter>', (), "the radiance of every light is 0"),
        ('<emitter type="constant" id="sky"/>', ("--set", "sky.radiance=0"), "the radiance of every light is 0"),
    ],
)
def test_a_scene_without_light_is_told(run, write_scene, tmp_path, lights, arguments, says):
    scene = write_scene(BALL + lights, res=4)
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


# ---- what is refused ------------------------------------------------------------------------------------------------


def test_missing_scene(refused, tmp_path):
    refused("render", "nowhere.xml", "-o", tmp_path / "a.exr", says=["nowhere.xml"])
    refused("info", "nowhere.xml", says=["nowhere.xml"])


def test_errors_in_a_scene_name_file_and_line(refused, write_scene, tmp_path):
    path = write_scene('<shape type="sphere"><bsdf type="plastic"/></shape>')
    line = 1 + path.read_text().split("plastic")[0].count("\n")
    refused("render", path, "-o", tmp_path / "a.exr", says=[f"{path}:{line}: ", "plastic", "diffuse"])


@pytest.mark.parametrize("text", ["", "not xml", "<scene", "<scene version='3.0.0'></scene>", "\0\1\2"])
def test_what_is_no_scene(refused, tmp_path, text):
    (tmp_path / "bad.xml").write_text(text)
    refused("info", tmp_path / "bad.xml", says=["bad.xml"])


def test_a_folder_is_no_scene(refused, tmp_path):
    refused("info", tmp_path, says=[str(tmp_path)])


def test_missing_output_folder(refused, tmp_path):
    refused("render", FURNACE, "-o", tmp_path / "no" / "a.exr", says=["no folder", str(tmp_path / "no")])


def test_output_that_is_a_folder_or_of_another_kind(refused, tmp_path):
    (tmp_path / "b.exr").mkdir()
    refused("render", FURNACE, "-o", tmp_path / "b.exr", says=["folder"])
    refused("render", FURNACE, "-o", tmp_path / "a.jpg", says=[".exr or .png"])
    refused("render", FURNACE, "-o", tmp_path / "a", says=[".exr or .png"])


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_output_folder_without_the_right_to_write(refused, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    refused("render", FURNACE, *SMALL, "-o", tmp_path / "locked" / "a.exr", "--spp", "1", says=["cannot be written"])


@pytest.mark.parametrize("spp", ["0", "-1", "1.5", "many", "", str(2**31)])
def test_spp_that_is_no_positive_integer(refused, tmp_path, spp):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", f"--spp={spp}", says=["--spp"])


@pytest.mark.parametrize("seed", ["-1", "0.5", str(2**31)])
def test_seed_that_is_no_31_bit_integer(refused, tmp_path, seed):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", f"--seed={seed}", says=["--seed"])


@pytest.mark.parametrize("option", ["--error", "--time"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "much", ""])
def test_limits_that_are_no_positive_number(refused, tmp_path, option, value):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", f"{option}={value}", says=[option])


def test_output_variables_that_cannot_be(refused, tmp_path):
    exr, png = ("-o", tmp_path / "a.exr"), ("-o", tmp_path / "a.png")
    refused("render", FURNACE, *exr, "--aov", "depht", says=["depht", "error, depth, normal, albedo"])
    refused("render", FURNACE, *exr, "--aov", "bounces", "-D", "max_depth=-1", says=["no limit", "1 to 64", "--tail"])
    refused("info", FURNACE, "--tail", "2", says=["error = 2", "between 0 and 1"])
    refused("render", FURNACE, *exr, "--aov", "", says=["error, depth, normal, albedo"])
    refused("render", FURNACE, *exr, "--aov", "depth,error,depth", says=["depth", "twice"])
    refused("render", FURNACE, *png, "--aov", "depth", says=["a.png", ".exr"])


def test_checkpoints_that_cannot_be(refused, run, tmp_path):
    arguments = ("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 1, "--checkpoint")
    refused(*arguments, tmp_path / "none" / "run.npz", says=["no folder"])
    assert run(*arguments, tmp_path / "run.npz")[0] == 0
    refused(*arguments, tmp_path / "run.npz", "--seed", 4, says=["run.npz was made with seed 0, this is seed 4"])


def test_unknown_parameter_offers_names(refused, tmp_path):
    output = ("-o", tmp_path / "a.exr")
    refused("render", FURNACE, *output, "--set", "wal.reflectance=1", says=["wal.reflectance", "wall.reflectance"])
    refused("render", FURNACE, *output, "--set", "zzz=1", says=["zzz", "wall.reflectance", "glow.radiance"])


@pytest.mark.parametrize(
    "setting, says",
    [
        ("wall.reflectance=1,2", "wall.reflectance"),
        ("wall.reflectance=blue", "blue"),
        ("wall.reflectance=1.5", "bounds"),
        ("wall.reflectance=nan", "bounds"),
        ("glow.radiance=-1", "bounds"),
        ("glow.radiance=inf", "radiance"),
        ("wall.reflectance=", "number"),
        ("wall.reflectance", "name=value"),
        ("=1", "name=value"),
    ],
)
def test_values_that_a_parameter_does_not_take(refused, tmp_path, setting, says):
    refused("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", "1", "--set", setting, says=[says])


@pytest.mark.parametrize(
    "define, says",
    [
        ("resolution=8", "resolution"),
        ("res=many", "furnace.xml:32: "),
        ("res=0", "furnace.xml:32: "),
        ("res=-3", "furnace.xml:32: "),
        ("res=99999", "furnace.xml:32: "),
        ("max_depth=0", "max_depth"),
        ("res", "name=value"),
    ],
)
def test_defines_that_a_file_does_not_take(refused, tmp_path, define, says):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", "-D", define, says=[says])


def test_no_command_and_unknown_commands(refused):
    refused()
    refused("paint", FURNACE)
    refused("render", FURNACE, says=["-o"])
    refused("render", FURNACE, "-o", "a.exr", "--strategy", "luck", says=["luck"])


def test_help_is_no_error(run):
    status, out, _ = run("render", "--help")
    assert status == 0
    assert "--spp" in out and "--set" in out


# ---- fit ------------------------------------------------------------------------------------------------------------


def write_target(path, **changes):
    """The furnace's image, of another albedo than its file's."""
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


@pytest.mark.parametrize("kind", ["exr", "png"])
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
    """The names hold what markup, terminals and UTF-8 do not take; the folder is gone when the fit ends."""
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


# ---- info -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["scenes/glass_and_mirror.xml", "tests/scenes/conductors.xml", "scenes/mesh.xml"])
def test_info_lists_every_parameter(run, name):
    status, out, _ = run("info", name)
    parameters = pj.parameters(pj.load_scene(name))
    assert status == 0
    assert parameters
    lines = [line.split() for line in out.splitlines()]
    for parameter in parameters:
        assert any(line[:1] == [parameter] for line in lines), parameter


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


# ---- in a process of its own ----------------------------------------------------------------------------------------


def test_module_renders(process, tmp_path):
    done = process("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 2, "--json")
    out, err = done.communicate(timeout=120)
    assert done.returncode == 0, err
    assert json.loads(out)["spp"] == 2
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"R", "G", "B"}


def test_module_refuses_without_a_traceback(process, tmp_path):
    done = process("render", "nowhere.xml", "-o", tmp_path / "a.exr")
    out, err = done.communicate(timeout=60)
    assert (done.returncode, out) == (2, "")
    assert "nowhere.xml" in err and "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def first_line_with(stream, text):
    for line in iter(stream.readline, ""):
        if text in line:
            return line
    raise AssertionError(f"{text!r} did not come")


# Says when a mesh begins to load, when the first call of the kernel begins, when some calls are done, and when bounces
# begin, so that the signal comes at a known time; then runs the same command line.
TELLTALE = """
import sys
from pathjax import cli
from pathjax.rendering.progressive import passes
from pathjax.rendering import bounces
from pathjax.io import mesh

def tell(what):
    print(what, file=sys.stderr, flush=True)

def load(*arguments, plain=mesh.load, **keywords):
    tell("mesh loads")
    return plain(*arguments, **keywords)

def compile(*arguments, plain=passes.compile):
    tell("kernel compiles")
    return plain(*arguments)

def extend(*arguments, plain=passes.extend):
    for number, _ in enumerate(plain(*arguments)):
        if number == 20:
            tell("kernel ran")
        yield

def render_bounces(*arguments, plain=bounces.render_bounces):
    tell("bounces begin")
    return plain(*arguments)

bounces.render_bounces = render_bounces
mesh.load, passes.compile, passes.extend = load, compile, extend
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.fixture
def interrupt(root):
    """(arguments, event of TELLTALE, seconds to wait after) -> status, stdout, stderr, seconds from the signal on.

    The quickest of three tries, as other work on the machine only ever adds; one that is soon enough is the last.
    """

    def interrupt(arguments, event, seconds):
        tries = []
        while len(tries) < 3 and not (tries and tries[-1][-1] < SOON):
            tries.append(once(arguments, event, seconds))
        return min(tries, key=lambda done: done[-1])

    def once(arguments, event, seconds):
        command = [sys.executable, "-c", TELLTALE, *map(str, arguments)]
        with subprocess.Popen(command, cwd=root, env=environment(root), **PIPES) as started:
            try:
                first_line_with(started.stderr, event)
                time.sleep(seconds)
                begin = time.perf_counter()
                started.send_signal(signal.SIGINT)
                out, err = started.communicate(timeout=20)
                return started.returncode, out, err, time.perf_counter() - begin
            finally:
                started.kill()

    return interrupt


# Ctrl-C is to be heard within a second; half a second more for a busy machine to write and leave.
SOON = 1.5


@sends_signals
def test_interrupt_keeps_what_is_done(interrupt, tmp_path):
    output = tmp_path / "a.exr"
    arguments = ("render", "scenes/cornell_box.xml", "-o", output, "--spp", 1_000_000, "--json")
    status, out, err, seconds = interrupt(arguments, "kernel ran", 0.3)
    assert status == 1
    assert "Traceback" not in err
    assert "interrupted" in err
    assert seconds < SOON
    report = json.loads(out)
    assert report["interrupted"] is True
    assert 0 < report["spp"] < 1_000_000
    channels, header = read_exr(output)
    assert report["fewest_spp"] <= report["spp"] <= report["most_spp"]
    assert header["pathjax.spp"] == pytest.approx(report["spp"])
    assert channels["R"].shape == (256, 256)
    assert np.isfinite(channels["R"]).all() and (channels["R"] > 0).mean() > 0.5
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


@sends_signals
def test_interrupt_while_bounces_are_compiled_writes_the_image_at_once(interrupt, tmp_path):
    output = tmp_path / "a.exr"
    arguments = ("render", "scenes/cornell_box.xml", "-D", "res=32", "-o", output, "--spp", 16, "--aov", "bounces")
    status, _, err, seconds = interrupt(arguments, "bounces begin", 0.2)
    assert status == 1
    assert "Traceback" not in err
    assert "interrupted; the bounces are left out" in err
    assert seconds < SOON
    assert set(read_exr(output)[0]) == {"R", "G", "B"}


@sends_signals
@pytest.mark.parametrize("event, wait", [("mesh loads", 0.1), ("kernel compiles", 1.5)])
def test_interrupt_before_the_first_pass_ends_quickly_and_writes_nothing(interrupt, tmp_path, event, wait):
    arguments = ("render", "scenes/mesh.xml", "-o", tmp_path / "a.exr", "--spp", 1_000_000)
    status, out, err, seconds = interrupt(arguments, event, wait)
    assert (status, out) == (1, ""), err
    assert "Traceback" not in err
    assert "interrupted" in err
    assert seconds < SOON
    assert not list(tmp_path.iterdir())


# ---- compiled kernels on disk ---------------------------------------------------------------------------------------

# The same command line; then says how many programs were wanted of the cache, and how many it held.
COUNTED = """
import sys
from pathjax import cli
import jax

events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event.rpartition("/")[2]))
status = cli.main(sys.argv[1:])
print(events.count("compile_requests_use_cache"), events.count("cache_hits"))
sys.exit(status)
"""


@pytest.fixture
def counted(root, tmp_path):
    """(**environment) -> a process that renders the furnace to a file of its own, and that file."""
    numbers = iter(range(100))

    def start(**variables):
        output = tmp_path / f"{next(numbers)}.exr"
        arguments = ("render", FURNACE, *SMALL, "-o", output, "--spp", 4)
        command = [sys.executable, "-c", COUNTED, *map(str, arguments)]
        plain = {name: value for name, value in environment(root).items() if not name.startswith(("JAX_", "PATHJAX_"))}
        variables = {name: str(value) for name, value in variables.items()}
        return subprocess.Popen(command, cwd=root, env=plain | variables, **PIPES), output

    return start


def end(started):
    """Programs wanted of the cache, those found, and the image's bytes; nothing may be said on stderr."""
    process, output = started
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert err.strip() == ""
    return *map(int, out.split()), read_exr(output)[0]["R"].tobytes()


def entries(folder):
    return sorted(path.name for path in folder.rglob("*-cache"))


linux = pytest.mark.skipif(sys.platform != "linux", reason="kernels are kept on Linux only")


@linux
def test_the_second_run_compiles_nothing_and_gives_the_same_image(counted, tmp_path):
    cache = tmp_path / "cache"
    both = [counted(XDG_CACHE_HOME=cache) for _ in range(2)]  # at once, on an empty cache
    first, other = map(end, both)
    kept = entries(cache)
    assert any(name.startswith("jit__replicate_means") for name in kept)
    assert all(path.relative_to(cache).parts[0] == "pathjax" for path in cache.rglob("*-cache"))
    wanted, found, image = end(counted(XDG_CACHE_HOME=cache))
    assert wanted == found > 0
    assert entries(cache) == kept
    without = end(counted(PATHJAX_CACHE=0, XDG_CACHE_HOME=tmp_path / "none"))
    assert image == first[2] == other[2] == without[2]
    assert without[1] == 0 and not (tmp_path / "none").exists()


@linux
def test_a_cache_of_the_users_choice_is_used_instead(counted, tmp_path):
    variables = {
        "JAX_COMPILATION_CACHE_DIR": tmp_path / "mine",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0,
        "XDG_CACHE_HOME": tmp_path / "cache",
    }
    end(counted(**variables))
    assert entries(tmp_path / "mine")
    assert not (tmp_path / "cache").exists()


@linux
@pytest.mark.parametrize("name", ["file", BYTE])
def test_a_cache_that_cannot_be_written_stops_no_render(counted, tmp_path, name):
    (tmp_path / "file").write_text("")
    assert end(counted(XDG_CACHE_HOME=tmp_path / name))[1] == 0


@linux
def test_a_full_cache_disk_stops_no_render_and_keeps_no_halves(counted, tmp_path):
    import resource

    cache, limits = tmp_path / "cache", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 15, limits[1]))  # of the child; its kernel is larger
    try:
        started = counted(XDG_CACHE_HOME=cache)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    _, found, image = end(started)
    assert found == 0
    assert any(path.stat().st_size == 1 << 15 for path in cache.rglob("*-cache"))
    end(counted(XDG_CACHE_HOME=cache))
    wanted, found, again = end(counted(XDG_CACHE_HOME=cache))
    assert wanted == found > 0
    assert again == image
