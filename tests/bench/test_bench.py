"""`pathjax bench`: its figures are those of the images; it writes a table, JSON and plots."""

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pathjax
from pathjax.bench import bench, peers
from pathjax.bench.peers import mitsuba3
from pathjax.cli import main
from pathjax.images import rel_mse

ROOT = Path(__file__).resolve().parents[2]
FURNACE = str(ROOT / "scenes" / "furnace.xml")
# A floor under a small lamp, which bsdf sampling seldom finds.
FLOOR = """<scene version="3.0.0"><default name="res" value="16"/><integrator type="path"/><sensor type="perspective">
  <transform name="to_world"><lookat origin="0,3,4" target="0,0,0" up="0,1,0"/></transform>
  <float name="fov" value="40"/>
  <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/><rfilter type="box"/>
  </film></sensor>
<shape type="rectangle"><transform name="to_world"><scale value="3"/><rotate x="1" angle="-90"/></transform>
  <bsdf type="diffuse" id="floor"/></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.3"/><rotate x="1" angle="90"/><translate y="1"/>
  </transform><bsdf type="diffuse" id="base"/><emitter type="area" id="lamp"/></shape></scene>
"""
SMALL = ["-D", "res=16", "--spp", "2,32", "--reference-spp", "512", "--repeat", "2"]

needs_mitsuba = pytest.mark.skipif(not importlib.util.find_spec("mitsuba"), reason="Mitsuba is not installed")
needs_matplotlib = pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="no matplotlib")


def no_constants(name):
    raise AssertionError(f"{name} is not JSON")


def run(*arguments, status=0):
    assert main(["bench", *arguments]) == status


@pytest.fixture(scope="module")
def floor(tmp_path_factory):
    file = tmp_path_factory.mktemp("scenes") / "floor.xml"
    file.write_text(FLOOR)
    return str(file)


@pytest.fixture(scope="module")
def folder(floor, tmp_path_factory):
    """A report of all measurements but Mitsuba's."""
    folder = tmp_path_factory.mktemp("bench") / "report"
    run(floor, *SMALL, "-o", str(folder))
    return folder


@pytest.fixture(scope="module")
def scene(folder):
    (scene,) = json.loads((folder / "bench.json").read_text(), parse_constant=no_constants)["scenes"]
    return scene


def test_speed_against_error(folder, scene):
    assert scene["compile_seconds"] > 0 and scene["reference_spp"] == 512
    assert 0 < scene["reference_rel_mse"] < scene["pathjax"][1]["rel_mse"]
    few, many = scene["pathjax"]
    # 16 times the samples: the error falls by about 16; a factor of 3 is beyond chance.
    assert 3 * many["rel_mse"] < few["rel_mse"]
    for row in (few, many):
        assert row["efficiency"] == pytest.approx(1 / (row["rel_mse"] * row["run_seconds"]))
        assert row["mpaths_per_second"] == pytest.approx(256 * row["spp"] / row["run_seconds"] / 1e6)
        assert row["rel_mse"] == pytest.approx(row["rel_mse_to_reference"] - scene["reference_rel_mse"])
    assert scene["slopes"]["pathjax"]["spp"] < -0.3
    assert scene["mitsuba"] == [] and scene["failures"] == []
    assert "| pathjax | 32 |" in (folder / "bench.md").read_text()


def test_strategies(scene):
    assert [row["strategy"] for row in scene["strategies"]] == ["mis", "light", "bsdf"]
    assert {row["spp"] for row in scene["strategies"]} == {32}
    mis, _, bsdf = scene["strategies"]
    assert mis["rel_mse"] == scene["pathjax"][1]["rel_mse"]  # same seeds
    assert 3 * mis["rel_mse"] < bsdf["rel_mse"]


def test_sampler_beside_independent_numbers(scene, floor):
    sampler = scene["sampler"]
    for row in sampler["rows"]:
        assert row["independent_rel_mse"] == pytest.approx(sampler["single_rel_mse"] / row["spp"])
        assert row["ratio"] == pytest.approx(row["independent_rel_mse"] / row["rel_mse"])
    # The mean of one-sample images has the error that the table gives.
    small = pathjax.load_scene(floor, res=16)
    truth = pathjax.render(small, 4096, 1 << 10)
    singles = np.stack([pathjax.render(small, 1, 2000 + k) for k in range(512)])
    means = singles.reshape(16, 32, *singles.shape[1:]).mean(1)
    error = np.mean([rel_mse(mean, truth) for mean in means])
    assert sampler["rows"][1]["independent_rel_mse"] == pytest.approx(error, rel=0.3)


def test_precision_and_memory(scene):
    precision = scene["precision"]
    assert precision["rel_mse"] < 1e-2 * precision["float64"]["rel_mse"]
    assert precision["largest_deviation"] ** 2 >= precision["rel_mse"]
    assert precision["float32"]["rel_mse"] == scene["pathjax"][1]["rel_mse"]  # same seeds, another process
    if sys.platform == "linux":
        assert 1 << 20 < scene["peak_memory_bytes"] < 1 << 32


def test_derivatives(scene, folder):
    """Derivatives in two reflectances and a radiance (9 scalars), whatever the other parameters."""
    derivatives = scene["derivatives"]
    assert derivatives["numbers"] == 9 and derivatives["spp"] == 32
    assert all(len(each) == 2 and min(each) > 0 for each in derivatives["cpu_seconds"].values())
    assert "| J^T v |" in (folder / "bench.md").read_text()


def test_closest_hits(scene):
    assert scene["closest_hits"].keys() == {"camera", "scattered"}
    assert min(scene["closest_hits"].values()) > 0
    assert scene["rays"] is None  # no mesh


@needs_matplotlib
def test_plot(folder, scene):
    assert scene["plot"] == "floor.png"
    assert "](floor.png)" in (folder / "bench.md").read_text()
    with Image.open(folder / "floor.png") as picture:
        assert picture.format == "PNG"
        assert picture.width >= 800 and picture.height >= 500
        assert len(np.unique(np.asarray(picture.convert("L")))) > 10


@pytest.mark.slow
def test_float64_has_a_process_of_its_own():
    request = {"scene": FURNACE, "parameters": {"res": "4"}, "spp": 2, "seeds": [0, 1]}
    report, arrays = peers.call("pathjax_alone", {**request, "dtype": "float64"})
    images = arrays["images"]
    assert images.shape == (2, 4, 4, 3) and images.dtype == np.float64
    assert len(report["seconds"]) == 2
    assert not np.array_equal(images, images.astype(np.float32))
    assert pathjax.render(pathjax.load_scene(FURNACE, res=4), 1).dtype == np.float32
    with pytest.raises(peers.PeerFailed, match="nowhere.xml"):
        peers.call("pathjax_alone", {**request, "scene": "nowhere.xml", "dtype": "float32"})


@pytest.mark.usefixtures("compiled_anew")
def test_several_scenes_without_matplotlib(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    run(FURNACE, FURNACE, *SMALL, "--quick", "-o", str(tmp_path / "report"), "--json")
    told = capsys.readouterr()
    report = json.loads(told.out)
    assert report == json.loads((tmp_path / "report" / "bench.json").read_text())
    assert told.err.count("pip install 'pathjax[bench]'") == 1
    one, other = report["scenes"]
    for scene in (one, other):
        assert scene["plot"] is None and scene["strategies"] is None and scene["rays"] is None
        assert scene["compile_seconds"] > 0.1  # the second compiles anew
    assert [row["rel_mse"] for row in one["pathjax"]] == [row["rel_mse"] for row in other["pathjax"]]


def test_a_scene_without_noise(tmp_path, capsys, write_scene):
    scene = write_scene('<emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>', res=8)
    run(str(scene), "--spp", "1,4", "--reference-spp", "4", "--repeat", "2", "--quick", "-o", str(tmp_path / "report"))
    assert "no noise" in capsys.readouterr().out
    (facts,) = json.loads((tmp_path / "report" / "bench.json").read_text())["scenes"]
    assert [row["efficiency"] for row in facts["pathjax"]] == [None, None]
    assert facts["plot"] is None
    assert not list((tmp_path / "report").glob("*.png"))


@needs_matplotlib
def test_an_interrupt_keeps_the_scenes_that_are_done(scene, floor, tmp_path, capsys, monkeypatch):
    def measure(file, *_):
        if file == floor:
            raise KeyboardInterrupt
        return {name: value for name, value in scene.items() if name != "plot"} | {"file": file}

    monkeypatch.setattr(bench, "measure", measure)
    run(FURNACE, FURNACE, floor, *SMALL, "--quick", "-o", str(tmp_path), status=1)
    assert "interrupted; 2 of 3 scenes are done" in capsys.readouterr().err
    scenes = json.loads((tmp_path / "bench.json").read_text())["scenes"]
    assert [scene["plot"] for scene in scenes] == ["furnace-1.png", "furnace-2.png"]
    assert all((tmp_path / scene["plot"]).exists() for scene in scenes)


@pytest.fixture
def measured(scene, monkeypatch):
    """(*acts) -> None: measuring a scene first calls its act, unless that is None."""

    def install(*happen):
        happen = iter(happen)

        def measure(file, *_):
            if (act := next(happen)) is not None:
                act()
            return {name: value for name, value in scene.items() if name != "plot"} | {"file": file}

        monkeypatch.setattr(bench, "measure", measure)
        monkeypatch.setitem(sys.modules, "matplotlib", None)

    return install


def raises(error):
    def act():
        raise error

    return act


@pytest.mark.parametrize(
    "error, says", [(KeyboardInterrupt(), "interrupted"), (MemoryError("out of memory"), "MemoryError: out of memory")]
)
@pytest.mark.parametrize("written", [False, True])
def test_what_ends_the_work_early_costs_no_scene_that_is_done(measured, tmp_path, capsys, error, says, written):
    measured(None, raises(error))
    run(FURNACE, FURNACE, FURNACE, "--json", *(["-o", str(tmp_path)] if written else []), status=1)
    told = capsys.readouterr()
    assert f"{says}; 1 of 3 scenes are done" in told.err
    assert len(json.loads(told.out)["scenes"]) == 1
    assert (tmp_path / "bench.json").exists() == written


def test_a_report_whose_folder_is_gone_is_written_in_the_current_one(measured, tmp_path, capsys, monkeypatch):
    folder, here = tmp_path / "report", tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    measured(None, lambda: shutil.rmtree(folder), None)
    run(FURNACE, FURNACE, FURNACE, "-o", str(folder), status=1)
    assert sorted(path.name for path in here.iterdir()) == ["bench.json", "bench.md"]
    assert len(json.loads((here / "bench.json").read_text())["scenes"]) == 3
    assert f"{here / 'bench.md'} was written instead" in capsys.readouterr().err


def test_names_that_are_not_utf8(measured, tmp_path):
    scene = tmp_path / "s\udcff.xml"
    shutil.copy(FURNACE, scene)
    measured(None)
    run(str(scene), "-o", str(tmp_path / "r\udcff"))
    assert r"s\udcff.xml, 16 x 16" in (tmp_path / "r\udcff" / "bench.md").read_text(encoding="utf-8")


def test_a_folder_without_parent_is_refused(tmp_path, capsys):
    run(FURNACE, *SMALL, "-o", str(tmp_path / "none" / "report"), status=2)
    assert "there is no folder" in capsys.readouterr().err


# ---- beside Mitsuba ------------------------------------------------------------------------------------------------


def test_a_missing_peer_is_told_before_anything_is_measured(capsys, monkeypatch):
    def call(peer, request):
        raise peers.PeerMissing("pip install mitsuba")

    monkeypatch.setattr(peers, "call", call)
    run(FURNACE, *SMALL, "--against", "mitsuba", status=2)
    told = capsys.readouterr().err.splitlines()
    assert told == ["pathjax: --against mitsuba: pip install mitsuba"]


def test_the_best_sampler_is_named_and_one_that_fails_is_told(tmp_path, capsys, monkeypatch):
    """The peer renders as pathjax does, but takes no time with one sampler and fails with another."""
    scene = pathjax.load_scene(FURNACE, res=16)

    def call(peer, request):
        runs, images = [], {}
        for k, wanted in enumerate(request["runs"]):
            if wanted["sampler"] == "stratified":
                raise peers.PeerFailed("no strata")
            images[f"images_{k}"] = np.stack([pathjax.render(scene, wanted["spp"], 50 + s) for s in wanted["seeds"]])
            second = 1e-6 if wanted["sampler"] == "multijitter" else 1.0
            seconds = [second] * len(wanted["seeds"])
            runs.append({"spp": wanted["spp"], "seconds": seconds, "cpu_seconds": seconds})
        return {"program": "Mitsuba 0", "runs": runs}, images

    monkeypatch.setattr(peers, "call", call)
    run(FURNACE, *SMALL, "--quick", "--against", "mitsuba", "-o", str(tmp_path / "report"), status=1)
    told = capsys.readouterr()
    assert "Mitsuba, stratified: no strata" in told.err and "Mitsuba, stratified: no strata" in told.out
    (facts,) = json.loads((tmp_path / "report" / "bench.json").read_text())["scenes"]
    for row in facts["pathjax"]:
        rows = [peer for peer in facts["mitsuba"] if peer["asked_spp"] == row["spp"]]
        assert len(rows) == 4
        assert row["best_peer"] == "multijitter" and row["best_peer_spp"] == row["spp"]
        best = next(peer for peer in rows if peer["sampler"] == "multijitter")
        assert row["efficiency_over_best_peer"] == pytest.approx(row["efficiency"] / best["efficiency"])
    assert facts["slopes"]["mitsuba"].keys() == {"independent", "multijitter", "orthogonal", "ldsampler"}
    assert " x multijitter |" in told.out


@pytest.mark.slow
@needs_mitsuba
def test_mitsubas_independent_sampler_has_the_error_of_independent_numbers(capsys):
    cornell = str(ROOT / "scenes" / "cornell_box.xml")
    small = ["-D", "res=16", "--spp", "16", "--reference-spp", "4096", "--repeat", "8", "--json"]
    run(cornell, *small, "--against", "mitsuba")
    (scene,) = json.loads(capsys.readouterr().out)["scenes"]
    assert {row["sampler"] for row in scene["mitsuba"]} == set(mitsuba3.SAMPLERS)
    row = next(row for row in scene["mitsuba"] if row["sampler"] == "independent")
    assert abs(row["bias"]["rel_mse"]) < 4 * row["bias"]["standard_error"]
    assert row["rel_mse"] == pytest.approx(scene["sampler"]["rows"][0]["independent_rel_mse"], rel=0.2)
