"""The twelve scenes are the same wherever they are made; both programs load them and render the same images."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import pathjax as pj
from pathjax.bench import bench, peers, twelve
from pathjax.bench.summary import summary
from pathjax.cli import main
from pathjax.io.mesh import load

ROOT = Path(__file__).resolve().parents[2]
KNOT = ROOT / "scenes" / "meshes" / "knot.ply"
MADE = "blob", "million", "sky", "lights", "rough", "caustics", "window"


@pytest.fixture
def small(monkeypatch):
    """The twelve scenes with 1280 triangles instead of 1.3 million."""
    monkeypatch.setattr(twelve, "blob", lambda folder: twelve_blob(folder, 3))
    monkeypatch.setattr(twelve, "million", lambda folder: twelve_million(folder, 3))


twelve_blob, twelve_million = twelve.blob, twelve.million


def test_there_are_twelve_and_each_time_the_same(small, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    one, other = (twelve.twelve(tmp_path / name) for name in ("a", "b"))
    assert [file.stem for file in one] == [*twelve.SHIPPED, *MADE] == [file.stem for file in other]
    made = sorted((tmp_path / "a").iterdir())
    assert [file.name for file in made] == sorted(file.name for file in (tmp_path / "b").iterdir())
    for file in made:
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes(), file.name


@pytest.mark.parametrize("name, size", [("blob", 81_920), ("million", 1_310_720)])
def test_solids_have_the_triangles_that_are_told(name, size):
    make = getattr(twelve, name)
    level = make.__defaults__[0]
    assert 20 * 4**level == size


def test_what_makes_solids_is_named_where_it_is_missing(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(pj.InputError, match="pathjax\\[bench\\]"):
        twelve.blob(tmp_path)


@pytest.mark.parametrize("waves", [12, 40])
def test_solids_are_closed_and_turned_outwards(waves):
    vertices, faces = twelve.bumpy(4, waves)
    assert len(faces) == 20 * 4**4 and len(vertices) == 10 * 4**4 + 2
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)  # each is walked once in each direction
    np.testing.assert_array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.sum(np.cross(a, b) * c) / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.3)


def test_a_mesh_of_the_users_stands_in_the_box(small, tmp_path):
    files = twelve.twelve(tmp_path, KNOT)
    assert "bunny" in [file.stem for file in files] and "blob" not in [file.stem for file in files]
    mesh, _ = load(tmp_path / "bunny.ply", "ply", np.eye(4))
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert len(mesh.faces) == 20_800 and (high - low).max() == pytest.approx(1.3)
    assert low[1] == pytest.approx(0.001) and (low + high)[[0, 2]] == pytest.approx(0, abs=1e-6)


def test_a_file_that_is_no_mesh_is_refused(small, tmp_path, capsys):
    assert main(["bench", "--bunny", "bunny.txt"]) == 2
    assert "bunny.txt: a mesh for the box is an .obj, .ply or .stl file" in capsys.readouterr().err


def test_where_the_shipped_scenes_are_missing_the_remedy_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(twelve, "__file__", str(tmp_path / "pathjax" / "bench" / "twelve.py"))
    with pytest.raises(pj.InputError, match="run this in a clone of pathjax, or name scenes"):
        twelve.twelve(tmp_path)


# ---- the summary ---------------------------------------------------------------------------------------------------


def measured(file, seconds, error, peer_seconds, peer_error):
    def row(seconds, error, **more):
        efficiency = 1 / (seconds * error)
        same = {"asked_spp": 64, "spp": 64, "run_seconds": seconds, "cpu_seconds": 2 * seconds}
        return {**same, "rel_mse": error, "rel_mse_standard_error": 0.03 * error, "efficiency": efficiency, **more}

    peers = [row(peer_seconds, peer_error, sampler="multijitter"), row(peer_seconds, 2 * peer_error, sampler="other")]
    return {"file": file, "compile_seconds": 1.0, "pathjax": [row(seconds, error)], "mitsuba": peers}


def test_the_summary_is_that_of_the_ratios():
    found = summary([measured("a.xml", 1, 0.1, 4, 0.2), measured("x/b.xml", 2, 0.1, 1, 0.1)])
    a, b = found["rows"]
    assert (a["scene"], b["scene"], found["spp"]) == ("a", "b", 64)
    assert a["best_peer"] == "multijitter"
    assert a["efficiency_ratio"] == pytest.approx(8) and a["cpu_ratio"] == pytest.approx(8)
    assert (a["time_ratio"], a["rel_mse_ratio"]) == (pytest.approx(4), pytest.approx(2))
    assert a["relative_error"] == pytest.approx(0.03 * 2**0.5)
    assert b["efficiency_ratio"] == pytest.approx(0.5)
    assert found["wall"]["geometric_mean"] == pytest.approx(2)
    assert (found["wall"]["worst_scene"], found["wall"]["worst"]) == ("b", pytest.approx(0.5))


def test_scenes_without_a_peer_or_noise_have_no_ratios():
    alone = measured("a.xml", 1, 0.1, 4, 0.2) | {"mitsuba": []}
    still = measured("b.xml", 1, 0.1, 4, 0.2)
    still["pathjax"][0]["efficiency"] = None
    found = summary([alone, still])
    assert [row["efficiency_ratio"] for row in found["rows"]] == [None, None] and found["wall"] is None


@pytest.fixture
def quick(monkeypatch):
    """Scenes that measure themselves in no time, and the list of those that did."""
    done = []

    def measure(file, defines, plan):
        done.append(file)
        nothing = dict.fromkeys("sampler strategies derivatives precision peak_memory_bytes closest_hits rays".split())
        scene = measured(file, 1, 0.1, 4, 0.2)
        rest = {"mpaths_per_second": 1.0, "reference_too_noisy": False, "bias": {"rel_mse": 0.0, "standard_error": 0.1}}
        for row in scene["pathjax"]:
            row |= {**rest, "best_peer": "multijitter", "best_peer_spp": 64, "efficiency_over_best_peer": 8.0}
        for row in scene["mitsuba"]:
            row |= {**rest, "program": "Mitsuba 0"}
        size = {"width": 8, "height": 8, "reference_spp": 4, "reference_rel_mse": 1e-3, "failures": []}
        return scene | size | nothing | {"slopes": {"pathjax": {"spp": None, "seconds": None}, "mitsuba": {}}}

    monkeypatch.setattr(bench, "measure", measure)
    monkeypatch.setattr(bench, "_find_mitsuba", lambda *_: None)
    monkeypatch.setattr(bench.pathjax, "load_scene", lambda *_, **__: None)
    monkeypatch.setattr(bench.plot, "available", lambda: False)
    return done


def test_without_scenes_the_twelve_are_measured_and_summed_up(small, quick, tmp_path, capsys):
    folder = tmp_path / "report"
    assert main(["bench", "--against", "mitsuba", "-o", str(folder)]) == 0
    told, report = capsys.readouterr(), json.loads((folder / "bench.json").read_text())
    assert [Path(scene["file"]).stem for scene in report["scenes"]] == [*twelve.SHIPPED, *MADE]
    assert report["plan"] == {"spp": [64], "reference_spp": 2048, "quick": True, "parameters": {"res": "128"}}
    assert report["summary"]["wall"]["geometric_mean"] == pytest.approx(8)
    assert "scene 12 of 12" in told.err
    assert "Geometric mean of the 12 efficiency ratios: 8.00, the worst 8.00" in told.out
    assert told.out == (folder / "bench.md").read_text() + "\n"
    assert sorted(file.stem for file in folder.glob("scenes/*.xml")) == sorted(MADE)


def test_a_bench_that_was_ended_goes_on(small, quick, tmp_path, capsys, monkeypatch):
    folder, measure = tmp_path / "report", bench.measure

    def interrupted(file, *rest):
        if len(quick) == 5:
            raise KeyboardInterrupt
        return measure(file, *rest)

    monkeypatch.setattr(bench, "measure", interrupted)
    assert main(["bench", "-o", str(folder)]) == 1
    monkeypatch.setattr(bench, "measure", measure)
    assert main(["bench", "-o", str(folder), "--resume"]) == 0
    assert len(quick) == 12 and len(set(quick)) == 12
    report = json.loads((folder / "bench.json").read_text())
    assert [scene["file"] for scene in report["scenes"]] == quick and len(report["summary"]["rows"]) == 12
    assert main(["bench", "-o", str(folder), "--resume", "--spp", "16"]) == 2
    assert "bench.json has another plan; ask for the same, or for another folder" in capsys.readouterr().err
    (folder / "bench.json").write_text("[]")
    assert main(["bench", "-o", str(folder), "--resume"]) == 2
    assert "bench.json is no report to go on with" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [["--resume"], [str(KNOT), "--bunny", str(KNOT)]])
def test_options_that_say_nothing_are_refused(wrong):
    assert main(["bench", *wrong]) == 2


# ---- the scenes ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("twelve")
    twelve.twelve(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", MADE)
def test_a_made_scene_shows_the_same_in_mitsuba(name, made, estimate, estimate_type, agree):
    """The image is finite, not black, and the same in both programs."""
    pytest.importorskip("mitsuba")
    res, spp, count = 24, 256, 12
    run = {"sampler": "independent", "spp": spp, "seeds": list(range(1, count + 1))}
    request = {"scene": str(made / f"{name}.xml"), "parameters": {"res": res}, "runs": [run]}
    try:
        _, arrays = peers.call("mitsuba3", request)
    except peers.PeerMissing as error:
        pytest.skip(str(error))
    images = arrays["images_0"].astype(float)
    theirs = estimate_type(images.mean(0), images.var(0, ddof=1) / count, count)
    ours = estimate(pj.load_scene(made / f"{name}.xml", res=res), spp=spp, count=count)
    assert (ours.mean > 0).any(-1).mean() > 0.5  # it is dark around a box
    # Two float32 programs: edges and contacts of small triangles move by some 1e-3.
    agree(ours, theirs, rounding=3e-3)
