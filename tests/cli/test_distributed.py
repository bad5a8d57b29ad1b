"""Several processes that share one render: the bits of one process, and an end when one of them is lost."""

import json
import random
import re
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from pathjax.images import read_rgb

SCENE = "scenes/cornell_box.xml"
# The longest that survivors may take.
PATIENCE = 15


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--coordinator", "127.0.0.1:1"], "give all three"),
        (["--processes", 2, "--process", 0], "give all three"),
        (["--coordinator", "127.0.0.1:1", "--processes", 2, "--process", 2], "counted from 0"),
    ],
)
def test_wrong_numbers_are_refused(refused, tmp_path, arguments, says):
    refused("render", SCENE, "-o", tmp_path / "a.exr", *arguments, says=[says])


@pytest.fixture
def together(root, environment):
    """(processes, *arguments) -> running processes of one render.

    devices: of each; each: further arguments, with the number of the process for {}.
    """
    running = []

    def start(processes, *arguments, devices=1, each=()):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        own = environment | {"JAX_NUM_CPU_DEVICES": str(devices)}
        command = [sys.executable, "-m", "pathjax", "render", *map(str, arguments)]
        numbers = ["--coordinator", address, "--processes", str(processes), "--process"]
        started = [
            subprocess.Popen(
                command + [word.format(i) for word in each] + [*numbers, str(i)] * (processes > 1),
                **{"cwd": root, "env": own, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True},
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
    """Of one with two devices. Under a wide filter three devices sum up in another order."""
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
    given = SCENE, "-D", "res=32", "--spp", 40000, "--json"
    outcome(together(1, *given, "-o", tmp_path / "whole.exr", devices=2))
    checkpoint, image = tmp_path / "state.npz", tmp_path / "parts.exr"
    choose = random.Random(1)
    for processes in (2, 3, 2):
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
            # One that has noticed ends too, maybe before the next one looks.
            assert number == victim or re.search(rf"process (\d, )*{victim}(, \d)* has ended", err)
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
