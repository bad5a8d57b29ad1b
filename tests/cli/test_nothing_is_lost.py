"""Results are kept: on full disks, when folders are gone, under any name and after any signal."""

import errno
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import threading

import numpy as np
import pytest
import trimesh

import pathjax as pj
from pathjax import images
from pathjax.images import read_exr, read_rgb, write_png
from pathjax.rendering import bounces
from pathjax.rendering.progressive import until
from pathjax.system.interrupts import SIGNALS

FURNACE = "scenes/furnace.xml"
SMALL = ("-D", "res=8")
sends_signals = pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")


# A byte that UTF-8 never contains, as Python represents it in arguments and file names.
BYTE = "\udcff"


@pytest.fixture
def meanwhile(monkeypatch):
    """(act) -> None: `act` is called after the last sample, before anything is written."""

    def install(act, plain=until.Render.run):
        def run(*arguments, **keywords):
            result = plain(*arguments, **keywords)
            act()
            return result

        monkeypatch.setattr(until.Render, "run", run)

    return install


def fill_disk(path):
    """Send the file that is written beside `path`, before it is renamed, to a full disk."""
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
    """Names of the scene, its folder, texture and meshes, the image and the checkpoint."""
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
    """One signal while the bounces are rendered, and two more while the image is written."""
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
