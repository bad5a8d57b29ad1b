"""Several processes that share one render give the bits of one process, and end when one of them is lost."""

import json
import os
import random
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from pathjax.images import read_rgb

SCENE = "scenes/cornell_box.xml"
# Seconds within which the surviving processes must end.
PATIENCE = 15


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--coordinator", "127.0.0.1:1"], "give all three"),
        (["--processes", 2, "--process", 0], "give all three"),
        (["--coordinator", "127.0.0.1:1", "--processes", 2, "--process", 2], "counted from 0"),
        (["--coordinator", "auto"], "no cluster is found here"),
    ],
)
def test_wrong_numbers_are_refused(refused, tmp_path, arguments, says):
    refused("render", SCENE, "-o", tmp_path / "a.exr", *arguments, says=[says])


@pytest.fixture
def together(root, environment, tmp_path):
    """(processes, *arguments) -> running processes of one command.

    devices, command: the device count and the command of each, or a tuple of them.
    each: further arguments, with the process index for {}.
    """
    running = []

    def start(processes, *arguments, devices=1, each=(), command="render"):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        devices, commands = (x if isinstance(x, tuple) else (x,) * processes for x in (devices, command))
        own = environment | {"PATHJAX_CACHE": "1", "XDG_CACHE_HOME": str(tmp_path / "cache")}
        numbers = ["--coordinator", address, "--processes", str(processes), "--process"]
        started = [
            subprocess.Popen(
                [sys.executable, "-m", "pathjax", commands[i], *map(str, arguments)]
                + [word.format(i) for word in each]
                + [*numbers, str(i)] * (processes > 1),
                env=own | {"JAX_NUM_CPU_DEVICES": str(devices[i])},
                **{"cwd": root, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True},
            )
            for i in range(processes)
        ]
        running.extend(started)
        return started

    yield start
    for process in running:
        process.kill()
        process.communicate()


def outcome(processes):
    told = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), told
    assert not any(out for out, _ in told[1:])
    return json.loads(told[0][0])


@pytest.mark.slow
@pytest.mark.parametrize(("film", "others"), [("box", [2, 3]), ("gaussian", [2])])
def test_images_are_those_of_one_process(together, tmp_path, root, film, others):
    """The one process has two devices. With a wide filter three devices would sum in another order."""
    scene = tmp_path / "box.xml"
    scene.write_text((root / SCENE).read_text().replace('type="box"', f'type="{film}"'))
    images = []
    for processes, devices in ((1, 2), *((other, 1) for other in others)):
        image = tmp_path / f"{processes}.exr"
        given = scene, "-D", "res=48", "--error", 0.05, "-o", image, "--json"
        facts = outcome(together(processes, *given, devices=devices))
        assert facts["reason"] == "target error"
        images.append(read_rgb(image))
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGKILL")
def test_one_is_killed_the_others_end_and_another_number_goes_on(together, tmp_path):
    given = SCENE, "-D", "res=32", "--spp", 120000, "--json"
    outcome(together(1, *given, "-o", tmp_path / "whole.exr", devices=2))
    checkpoint, image = tmp_path / "state.npz", tmp_path / "parts.exr"
    choose = random.Random(1)
    for processes in (2, 3, 2, 2, 3, 2, 3, 2, 2, 3):
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        running = together(processes, *given, "-o", image, "--checkpoint", checkpoint)
        while not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before or checkpoint.stat().st_size < 2000:
            assert running[0].poll() is None, running[0].communicate()
            time.sleep(0.05)
        time.sleep(choose.uniform(0, 0.5))
        victim = choose.randrange(processes)
        running[victim].kill()
        killed = time.monotonic()
        for number, process in enumerate(running):
            _, err = process.communicate(timeout=PATIENCE)
            assert process.returncode not in (0, None)
            assert number == victim or f"process {number} ends, as process {victim} has ended" in err, err
        assert time.monotonic() - killed < PATIENCE
        assert not image.exists()
    outcome(together(3, *given, "-o", image, "--checkpoint", checkpoint))
    np.testing.assert_array_equal(read_rgb(image), read_rgb(tmp_path / "whole.exr"))


@pytest.mark.slow
def test_scenes_that_differ_are_refused(together, tmp_path):
    running = together(
        2, SCENE, "-D", "res=8", "--spp", 4, "-o", tmp_path / "a.exr", each=["--set", "light.radiance={}"]
    )
    for process in running:
        _, err = process.communicate(timeout=60)
        assert process.returncode == 2
        assert "another scene than process" in err


@pytest.mark.slow
def test_commands_that_differ_are_refused(together, tmp_path):
    for process in together(2, SCENE, "--spp", 4, "-o", tmp_path / "a.exr", command=("render", "bench")):
        _, err = process.communicate(timeout=60)
        assert process.returncode == 2 and "another command than process" in err


@pytest.mark.slow
def test_processes_with_other_numbers_of_devices_are_refused(together, tmp_path):
    running = together(2, SCENE, "-D", "res=8", "--spp", 4, "-o", tmp_path / "a.exr", devices=(1, 2))
    for process in running:
        _, err = process.communicate(timeout=60)
        assert process.returncode == 2
        assert err.startswith("pathjax: process 1 has 2 devices and process 0 has 1; give all as many")


@pytest.mark.slow
def test_a_scene_that_one_process_cannot_load_ends_all(together, tmp_path):
    for number, text in enumerate(('<scene version="3.0.0"/>', "<scene")):
        (tmp_path / f"{number}.xml").write_text(text)
    running = together(2, "-o", tmp_path / "a.exr", each=[tmp_path.as_posix() + "/{}.xml"])
    told = [process.communicate(timeout=60)[1] for process in running]
    assert [process.returncode for process in running] == [1, 2]
    assert "process 0 ends, as process 1 has ended: " in told[0]
    assert all("1.xml" in each for each in told)


@pytest.mark.slow
def test_a_scene_and_a_target_that_the_first_process_alone_sees_are_sent(together, tmp_path, root, run):
    (tmp_path / "scene0.xml").write_text((root / SCENE).read_text())
    image = tmp_path / "target0.exr"
    assert run("render", SCENE, "-D", "res=12", "--spp", 16, "-o", image)[0] == 0
    scene = tmp_path.as_posix() + "/scene{}.xml"
    given = "-D", "res=12", "--spp", 16, "--json", "-o", tmp_path / "a.exr"
    outcome(together(3, *given, each=[scene]))
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), read_rgb(image))
    given = "-D", "res=12", "--param", "white.reflectance=0.5", "--spp", 8, "--json", "-o", tmp_path / "fit"
    each = [scene, tmp_path.as_posix() + "/target{}.exr"]
    assert outcome(together(2, *given, each=each, command="fit"))["values"]


@pytest.mark.slow
def test_a_cluster_is_found(together, tmp_path, root, monkeypatch):
    """Processes learn their indices as under SLURM."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        monkeypatch.setenv("JAX_COORDINATOR_PORT", str(free.getsockname()[1]))
    for name, value in {"JOB_ID": "1", "STEP_NODELIST": "localhost", "NTASKS": "2", "LOCALID": "0"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    script = "import os, sys; os.environ['SLURM_PROCID'] = sys.argv.pop(); from pathjax.cli import main; main()"
    command = sys.executable, "-c", script, "render", SCENE, "-D", "res=8", "--spp", "4", "--coordinator", "auto"
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "1", "PYTHONPATH": str(root)}
    pipes = {"cwd": root, "env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    out = "-o", str(tmp_path / "a.exr"), "--json"
    running = [subprocess.Popen([*command, *out, str(i)], **pipes) for i in range(2)]
    assert outcome(running)["spp"] == 4
    assert (tmp_path / "a.exr").exists()


@pytest.mark.slow
def test_fits_are_those_of_one_process(together, tmp_path, run):
    target = tmp_path / "target.exr"
    assert run("render", SCENE, "-D", "res=12", "--spp", 64, "-o", target)[0] == 0
    facts = []
    for processes, devices in ((1, 2), (2, 1)):
        given = SCENE, "-D", "res=12", target, "--param", "white.reflectance=0.5", "--spp", 8, "--json"
        files = "-o", tmp_path / str(processes)
        facts.append(outcome(together(processes, *given, *files, devices=devices, command="fit")))
    one, two = facts
    for name in ("values", "standard_errors", "covariance", "message"):
        assert one[name] == two[name]
    assert (tmp_path / "1.png").read_bytes() == (tmp_path / "2.png").read_bytes()


@pytest.mark.slow
def test_a_bench_is_shared_and_goes_on_where_the_first_process_stopped(together, tmp_path):
    """All processes agree on the remaining work, although only the first one has the report."""
    report = tmp_path / "report"
    options = "-D", "res=12", "--spp", "1,4", "--reference-spp", 8, "--repeat", 2, "--json"
    alone = outcome(together(1, SCENE, *options, devices=2, command="bench"))
    outcome(together(2, SCENE, "--quick", *options, "-o", report, command="bench"))
    shared = (SCENE, "scenes/glass_ball.xml", "--quick", *options, "-o", report, "--resume")
    both = outcome(together(2, *shared, command="bench"))
    assert alone["machine"] | {"processes": 2} == both["machine"]
    assert [scene["file"] for scene in both["scenes"]] == [SCENE, "scenes/glass_ball.xml"]
    for one, two in zip(alone["scenes"][0]["pathjax"], both["scenes"][0]["pathjax"], strict=True):
        assert one["rel_mse"] == two["rel_mse"]
