"""Batches: scenes of one structure share a kernel, and no job is lost, done twice or half done."""

import errno
import itertools
import json
import os
import random
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
import trimesh

import pathjax as pj
from pathjax.images import read_exr, read_rgb, write_exr
from pathjax.io.load import load_scene
from pathjax.media.gridvolume import write_vol
from pathjax.rendering.progressive import passes
from pathjax.scene.ladder import padded
from pathjax.scene.parameters import nameless

SCENE = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <default name="fov" value="40"/>
    <sensor type="perspective">
        <float name="fov" value="$fov"/>
        <transform name="to_world"><lookat origin="0,1,4" target="0,0,0" up="0,1,0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="8"/></sampler>
        <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/></film>
    </sensor>
    <shape type="ply">
        <string name="filename" value="{mesh}"/>
        <bsdf type="diffuse" id="thing"><texture type="bitmap" name="reflectance">
            <string name="filename" value="{image}"/></texture></bsdf>
    </shape>
    {more}
    <emitter type="constant"/>
</scene>"""
FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><translate y="-1"/></transform>
    <bsdf type="diffuse" id="floor"/></shape>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Scenes that differ in their triangle and texel counts."""
    folder = tmp_path_factory.mktemp("scenes")
    rng = np.random.default_rng(0)
    for number, divisions in enumerate((1, 2, 3, 4)):
        mesh = trimesh.creation.icosphere(subdivisions=divisions)
        mesh.vertices += rng.normal(size=mesh.vertices.shape) * 0.01
        mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.vertices[:, :2] % 1)
        mesh.export(folder / f"{number}.ply")
        texels = rng.uniform(0.2, 0.9, (4 + number, 5, 3))
        write_exr(folder / f"{number}.exr", {c: texels[..., i] for i, c in enumerate("RGB")}, {})
        (folder / f"{number}.xml").write_text(SCENE.format(mesh=f"{number}.ply", image=f"{number}.exr", more=FLOOR))
    return folder


def write_jobs(path, jobs):
    path.write_text("\n".join(json.dumps(job) for job in jobs))
    return path


def some_jobs(count=4):
    return [{"scene": f"{number}.xml", "output": f"{number}.exr", "spp": 8} for number in range(count)]


def key(scene):
    """Return all that a kernel is compiled for: the tree structure, shapes and dtypes."""
    scene = nameless(scene)
    return jax.tree.structure(scene), [(x.shape, x.dtype) for x in jax.tree.leaves(scene)]


def test_scenes_of_one_structure_are_padded_to_the_same_arrays(folder):
    scenes = [load_scene(folder / f"{number}.xml") for number in range(4)]
    assert not any(key(scene) == key(scenes[0]) for scene in scenes[1:])
    assert all(key(padded(scene)) == key(padded(scenes[0])) for scene in scenes[1:])


def test_images_are_those_of_single_renders_and_one_kernel_makes_them(folder, tmp_path, monkeypatch):
    """To the bit: the padding of scenes contributes nothing."""
    jobs = some_jobs()
    jobs[1] |= {"set": {"floor.reflectance": [0.1, 0.2, 0.3]}, "parameters": {"fov": 30}, "seed": 5}
    jobs[2] |= {"output": "deep/er/2.exr"}
    before = passes._sums_of_replicates._cache_size()
    outcomes = pj.render_batch(write_jobs(folder / "jobs.jsonl", jobs), tmp_path)
    assert [outcome.status for outcome in outcomes] == ["done"] * 4
    assert passes._sums_of_replicates._cache_size() - before <= 1
    assert sum(outcome.compile_seconds > 0.1 for outcome in outcomes) <= 1
    scene = pj.with_parameters(load_scene(folder / "1.xml", fov=30), jobs[1]["set"])
    single = pj.render_until(scene, spp=8, seed=5).image
    np.testing.assert_array_equal(read_rgb(tmp_path / "1.exr"), single)
    assert (tmp_path / "deep/er/2.exr").exists()


def things(kind, count, folder):
    """Return the body of a scene with `count` objects of a kind; bodies of one kind have one structure."""
    diffuse = '<bsdf type="diffuse" id="{}"/>'
    ball = '<shape type="ply"><string name="filename" value="2.ply"/>{}{}</shape>'
    place = '<transform name="to_world"><scale value="0.3"/><translate x="{}"/></transform>'
    match kind:
        case "meshes and lights":
            intensity = '<rgb name="intensity" value="{}"/>'
            placed = (f'<point name="position" x="{n - 3}" y="3" z="2"/>{intensity.format(n)}' for n in range(count))
            return FLOOR + "".join(f'<emitter type="point">{light}</emitter>' for light in placed)
        case "instances":
            group = f'<shape type="shapegroup" id="group">{ball.format(diffuse.format("it"), "")}</shape>'
            placed = (place.format(n / 2 - 1) for n in range(count))
            return group + "".join(f'<shape type="instance"><ref id="group"/>{each}</shape>' for each in placed)
        case "bsdfs":
            return "".join(ball.format(diffuse.format(f"b{n}"), place.format(n / 2 - 1)) for n in range(count))
        case "grids":
            write_vol(folder / f"{count}.vol", np.random.default_rng(0).uniform(0, 3, (count, 3, 4, 1)))
            volume = f'<volume name="sigma_t" type="gridvolume"><string name="filename" value="{count}.vol"/></volume>'
            medium = f'<medium type="heterogeneous" name="interior">{volume}</medium>'
            return f'<shape type="cube"><bsdf type="null"/>{medium}</shape>'


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["meshes and lights", "instances", "bsdfs", "grids"])
def test_images_of_every_structure_are_those_of_single_renders(folder, tmp_path, kind, run):
    """To the bit, on the command line too. The scenes differ in their counts, but share a kernel."""
    for place, count in enumerate((6, 7)):
        text = SCENE.format(mesh=f"{place}.ply", image=f"{place}.exr", more=things(kind, count, folder))
        text = text.replace('"path"', '"volpath"') if kind == "grids" else text
        (folder / f"{kind}{place}.xml").write_text(text)
    jobs = [{"scene": f"{kind}{place}.xml", "output": f"{place}.exr", "spp": 8, "seed": 2} for place in range(2)]
    before = passes._sums_of_replicates._cache_size()
    outcomes = pj.render_batch(write_jobs(folder / f"{kind}.jsonl", jobs), tmp_path)
    assert [outcome.status for outcome in outcomes] == ["done"] * 2
    assert passes._sums_of_replicates._cache_size() - before <= 1
    for place in range(2):
        scene, image = folder / f"{kind}{place}.xml", tmp_path / f"{place}.exr"
        assert run("render", scene, "-o", tmp_path / "single.exr", "--spp", 8, "--seed", 2)[0] == 0
        for single in (read_rgb(tmp_path / "single.exr"), pj.render_until(load_scene(scene), spp=8, seed=2).image):
            assert single.any()
            np.testing.assert_array_equal(read_rgb(image), single)


def test_what_fails_is_told_by_line_and_ends_nothing_else(folder, tmp_path, run):
    jobs = [{"scene": "missing.xml", "output": "a.exr"}, *some_jobs(1), {"scene": "0.xml", "output": "c.png", "spp": 4}]
    jobs[1]["set"] = {"flor.reflectance": 0.5}
    status, out, err = run("batch", write_jobs(folder / "some.jsonl", jobs), "-o", tmp_path, "--json")
    assert status == 1
    assert [job["status"] for job in json.loads(out)["jobs"]] == ["failed", "failed", "done"]
    assert "some.jsonl:1: " in err and "missing.xml" in err
    assert "some.jsonl:2: " in err and "floor.reflectance" in err
    assert "2 failed, 1 done" in err
    assert [path.name for path in tmp_path.iterdir()] == ["c.png"]


def test_outputs_that_are_there_are_kept(folder, tmp_path, run):
    (tmp_path / "0.exr").write_text("kept")
    status, _, err = run("batch", write_jobs(folder / "again.jsonl", some_jobs(1)), "-o", tmp_path)
    assert (status, (tmp_path / "0.exr").read_text()) == (0, "kept")
    assert "1 skipped" in err


def test_outputs_that_are_older_than_their_scene_are_kept_and_told(folder, tmp_path, run):
    for name in ("0.exr", "1.exr"):
        (tmp_path / name).touch()
    os.utime(tmp_path / "1.exr", (0, 0))
    status, _, err = run("batch", write_jobs(folder / "old.jsonl", some_jobs(2)), "-o", tmp_path)
    assert (status, (tmp_path / "1.exr").read_text()) == (0, "")
    assert "old.jsonl:2: " in err and "1.exr is older than 1.xml" in err and "old.jsonl:1" not in err


def test_progress_and_the_time_left_are_told_in_lines_where_there_is_no_terminal(folder, tmp_path, run, monkeypatch):
    monkeypatch.setattr("pathjax.batch.run._SECONDS_BETWEEN_LINES", 0)
    for number in range(3):
        (tmp_path / f"{number}.exr").touch()
    _, _, err = run("batch", write_jobs(folder / "lines.jsonl", some_jobs()), "-o", tmp_path)
    assert "pathjax: 3 of 4 jobs, about" in err and "pathjax: 4 of 4 jobs, about 0 s left" in err


def test_parts_share_the_jobs(folder, tmp_path):
    jobs = write_jobs(folder / "parts.jsonl", some_jobs(3))
    for number in range(3):
        (tmp_path / f"{number}.exr").touch()
    parts = [pj.render_batch(jobs, tmp_path, part=(index, 2)) for index in range(2)]
    assert [[outcome.output.name for outcome in part] for part in parts] == [["0.exr", "2.exr"], ["1.exr"]]


def test_a_folder_that_is_full_is_refused_before_anything_is_rendered(folder, tmp_path, refused, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathjax.system.files.os.fsync", full)
    refused("batch", write_jobs(folder / "all.jsonl", some_jobs(1)), "-o", tmp_path, says=["No space left"])
    assert not list(tmp_path.iterdir())


def test_a_disk_that_becomes_full_ends_the_batch_and_leaves_nothing_half_written(folder, tmp_path, monkeypatch):
    def full(_):
        if next(calls):
            raise OSError(errno.ENOSPC, "No space left on device")

    calls = itertools.count()
    monkeypatch.setattr("pathjax.system.files.os.fsync", full)
    outcomes = pj.render_batch(write_jobs(folder / "no_room.jsonl", some_jobs(2)), tmp_path)
    assert [outcome.status for outcome in outcomes] == ["unwritten", "waiting"]
    assert "no_room.jsonl:1" in outcomes[0].message and "No space left" in outcomes[0].message
    assert not list(tmp_path.iterdir())


def test_an_output_that_cannot_be_written_ends_the_batch(folder, tmp_path):
    (tmp_path / "in_the_way").touch()
    jobs = [{"scene": "0.xml", "output": "in_the_way/a.exr", "spp": 1}, *some_jobs(2)]
    outcomes = pj.render_batch(write_jobs(folder / "full.jsonl", jobs), tmp_path)
    assert [outcome.status for outcome in outcomes] == ["unwritten", "waiting", "waiting"]
    assert "in_the_way" in outcomes[0].message and "full.jsonl:1" in outcomes[0].message


GOOD = '{"scene": "a.xml", "output": "a.exr"}'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", ["empty", '"scene"']),
        (GOOD + "\n{\n", ["jobs.jsonl:2", "column"]),
        ("[1]", ["jobs.jsonl:1", "one JSON object"]),
        ('{"scene": "a.xml"}', ["jobs.jsonl:1", '"output"']),
        ('{"scene": "a.xml", "output": "a.jpg"}', ["a.jpg", ".exr or .png"]),
        ('{"scene": "a.xml", "output": "a.exr", "sp": 3}', ['"sp"', 'did you mean "spp"']),
        ('{"scene": "a.xml", "output": "a.exr", "spp": 0}', ["jobs.jsonl:1", "spp = 0"]),
        ('{"scene": "a.xml", "output": "a.exr", "spp": "3"}', ["jobs.jsonl:1", "spp = '3'"]),
        ('{"scene": "a.xml", "output": "a.exr", "error": -1}', ["error", "positive"]),
        ('{"scene": "a.xml", "output": "a.exr", "set": [1]}', ["set", "names and values"]),
        ('{"scene": "a.xml", "output": "a.exr", "strategy": "best"}', ["best", "mis"]),
        (GOOD + '\n\n{"scene": "b.xml", "output": "./a.exr"}', ["jobs.jsonl:3", "jobs.jsonl:1", "a.exr"]),
    ],
)
def test_wrong_lists_are_refused_before_anything_is_rendered(tmp_path, refused, text, says):
    jobs = tmp_path / "jobs.jsonl"
    jobs.write_text(text)
    refused("batch", jobs, "-o", tmp_path, says=says)


def test_two_names_of_one_output_are_refused(tmp_path):
    jobs = [{"scene": "a.xml", "output": output} for output in ("a.exr", tmp_path / "a.exr")]
    with pytest.raises(pj.InputError, match="job 1: .* is the output of job 0 too"):
        pj.render_batch(jobs, tmp_path)


def test_what_is_no_job_is_refused():
    with pytest.raises(pj.InputError, match="job 1: a job is one JSON object or mapping, such as .*, not 7"):
        pj.render_batch([{"scene": "a.xml", "output": "a.exr"}, 7])


@pytest.mark.parametrize("part", ["2/2", "1", "a/b", "-1/2"])
def test_wrong_parts_are_refused(tmp_path, refused, part):
    refused("batch", tmp_path / "jobs.jsonl", "-o", tmp_path, f"--part={part}", says=["I/N"])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGKILL")
def test_killed_at_random_and_started_again_all_outputs_are_there_once_and_whole(folder, tmp_path, environment):
    listed = [{"scene": f"{n % 4}.xml", "output": f"more/{n}.exr", "seed": n, "spp": 256} for n in range(80)]
    jobs = write_jobs(folder / "killed.jsonl", listed)
    whole = tmp_path / "whole"
    pj.render_batch(jobs, whole)
    command = [sys.executable, "-m", "pathjax", "batch", jobs, "-o", tmp_path / "killed"]
    environment = environment | {"PATHJAX_CACHE": "1", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    choose, done = random.Random(0), 0
    for _ in range(10):
        running = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
        while running.poll() is None and len(list((tmp_path / "killed").rglob("*.exr"))) == done:
            time.sleep(0.01)
        time.sleep(choose.uniform(0, 0.1))
        assert running.poll() is None
        running.kill()
        running.wait()
        done = len(list((tmp_path / "killed").rglob("*.exr")))
    assert done < len(listed)
    assert subprocess.run(command, env=environment, stderr=subprocess.DEVNULL).returncode == 0
    written = {path.relative_to(whole) for path in whole.rglob("*.exr")}
    assert {path.relative_to(tmp_path / "killed") for path in (tmp_path / "killed").rglob("*.exr")} == written
    for path in written:
        one, other = (read_exr(place / path)[0] for place in (whole, tmp_path / "killed"))
        assert all((one[channel] == other[channel]).all() for channel in "RGB")
