"""Nothing is lost: a render that was killed, stopped or could not save ends in the image of an undisturbed one."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import pathjax as pj
from pathjax.integrators.options import DEFAULTS
from pathjax.rendering.progressive import checkpoint, passes

HOW = {"target_error": 0.015, "seed": 3}

# Renders with the arguments HOW; after every call of the kernel it saves and prints a line.
CHILD = """
import sys
from pathjax.rendering.progressive import checkpoint
import pathjax as pj

def save_if_due(self, state):
    self.save(state)
    print("rendering", flush=True)

checkpoint.Checkpoint.save_if_due = save_if_due
result = pj.render_until(pj.load_scene("scenes/cornell_box.xml", res=24), 0.015, seed=3, checkpoint=sys.argv[1])
print(result.reason)
"""

# Kills itself in the middle of the tenth file, or when that is whole but not yet moved to its place.
SUICIDE = """
import os, signal, sys
import numpy as np

saved = 0

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def savez(file, plain=np.savez, **arrays):
    global saved
    saved += 1
    if saved == 10 and sys.argv[2] == "half":
        file.write(b"PK" * 1000)
        file.flush()
        die()
    plain(file, **arrays)
    if saved == 10:
        os.replace = die

np.savez = savez
"""

needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="sends signals")


@pytest.fixture(scope="module")
def cornell(shipped):
    return shipped("cornell_box", res=24)


@pytest.fixture(scope="module")
def undisturbed(cornell):
    return pj.render_until(cornell, **HOW)


@pytest.fixture
def child(root):
    """(script, *arguments) -> a process that runs it in the checkout."""

    def start(script, *arguments):
        path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
        command = [sys.executable, "-c", script, *map(str, arguments)]
        return subprocess.Popen(
            command, cwd=root, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, text=True
        )

    return start


def same(a, b):
    for name in ("image", "standard_error", "samples"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.spp, a.error, a.error_bound, a.reason) == (b.spp, b.error, b.error_bound, b.reason)


# ---- killed and taken up again --------------------------------------------------------------------------------------


@needs_signals
@pytest.mark.parametrize("kills", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_at_random_moments(cornell, undisturbed, child, tmp_path, kills):
    """Each child gets about 1 / kills of the way, so that most are killed while they render."""
    rng = np.random.default_rng(kills)
    file = tmp_path / "run.npz"
    for _ in range(kills):
        with child(CHILD, file) as started:
            started.stdout.readline()
            time.sleep(rng.uniform(0, 2 * undisturbed.run_seconds / (kills + 1)))
            started.kill()
    same(pj.render_until(cornell, **HOW, checkpoint=file), undisturbed)
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]


@needs_signals
@pytest.mark.parametrize("moment", ["half", "whole"])
def test_killed_while_it_saves(cornell, undisturbed, child, tmp_path, moment):
    file = tmp_path / "run.npz"
    with child(SUICIDE + CHILD, file, moment) as started:
        started.communicate(timeout=120)
    assert started.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    same(pj.render_until(cornell, **HOW, checkpoint=file), undisturbed)
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]


@needs_signals
def test_terminated(cornell, undisturbed, child, tmp_path):
    with child(CHILD, tmp_path / "run.npz") as started:
        started.stdout.readline()
        started.send_signal(signal.SIGTERM)
        out, _ = started.communicate(timeout=60)
    assert (started.returncode, out.splitlines()[-1]) == (0, "interrupted")
    same(pj.render_until(cornell, **HOW, checkpoint=tmp_path / "run.npz"), undisturbed)


def test_a_finished_render_is_not_done_again(cornell, undisturbed, tmp_path, monkeypatch):
    how = HOW | {"checkpoint": tmp_path / "run.npz"}
    first = pj.render_until(cornell, **how)
    same(first, undisturbed)
    state_before = (tmp_path / "run.npz").read_bytes()
    monkeypatch.setattr(passes, "compile", lambda *_: lambda *_: pytest.fail("it rendered"))
    again = pj.render_until(cornell, **how)
    same(again, first)
    assert again.run_seconds == first.run_seconds
    assert len((tmp_path / "run.npz").read_bytes()) == len(state_before)


def test_more_samples_go_on_from_fewer(cornell, tmp_path):
    file = tmp_path / "run.npz"
    pj.render_until(cornell, spp=64, checkpoint=file)
    more = pj.render_until(cornell, spp=128, checkpoint=file)
    np.testing.assert_array_equal(more.image, pj.render_until(cornell, spp=128).image)
    fewer = pj.render_until(cornell, spp=32, checkpoint=file)
    assert (fewer.reason, fewer.spp) == ("spp", 128)


# ---- refused --------------------------------------------------------------------------------------------------------


@pytest.fixture
def made(cornell, tmp_path):
    """A checkpoint of a uniform render with seed 3."""
    pj.render_until(cornell, spp=4, seed=3, checkpoint=tmp_path / "run.npz")
    return tmp_path / "run.npz"


def test_checkpoints_of_other_renders(cornell, shipped, made, monkeypatch):
    brighter = pj.with_parameters(cornell, {"light.radiance": 2.0})
    deeper = replace(cornell, max_depth=cornell.max_depth + 1)
    hidden = replace(cornell, hide_emitters=True)
    before = made.read_bytes()
    for scene, how, says in (
        (cornell, {"seed": 4}, "was made with seed 3, this is seed 4; delete it, or name another"),
        (cornell, {"strategy": "light"}, "strategy mis, this is strategy light"),
        (cornell, {"target_error": 0.5}, "sampling uniform, this is sampling adaptive"),
        (shipped("cornell_box", res=16), {}, "image size 24x24, this is image size 16x16"),
        (brighter, {}, "made with scene"),
        (deeper, {}, "made with scene"),
        (hidden, {}, "made with scene"),
    ):
        with pytest.raises(pj.InputError, match=f"run.npz .*{says}"):
            pj.render_until(scene, **({"spp": 4, "seed": 3, "checkpoint": made} | how))
    other = f"pathjax {re.escape(pj.__version__)}, this is pathjax 9.9.9"
    monkeypatch.setattr(checkpoint.version, "__version__", "9.9.9")
    with pytest.raises(pj.InputError, match=other):
        pj.render_until(cornell, spp=4, seed=3, checkpoint=made)
    assert made.read_bytes() == before


def test_fingerprints_are_of_values_not_of_names(shipped):
    one, same, other = shipped("mesh", res=8), shipped("mesh", res=8), shipped("mesh", res=9)
    assert checkpoint.fingerprint(one) == checkpoint.fingerprint(same) != checkpoint.fingerprint(other)


@pytest.mark.parametrize("share", [0, 0.001, 0.3, 0.9, 0.999])
def test_truncated_files(cornell, made, share):
    whole = made.read_bytes()
    made.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(pj.InputError, match="run.npz is not a checkpoint, or is damaged"):
        pj.render_until(cornell, spp=4, seed=3, checkpoint=made)


def test_flipped_bytes(cornell, made):
    """All data that is read has a checksum or is compared."""
    whole, rng = made.read_bytes(), np.random.default_rng(0)
    reference = pj.render_until(cornell, spp=4, seed=3).image
    refused = 0
    for place in rng.integers(len(whole), size=30):
        made.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            np.testing.assert_array_equal(pj.render_until(cornell, spp=4, seed=3, checkpoint=made).image, reference)
        except pj.InputError as error:
            refused += 1
            assert "run.npz" in str(error)
    assert refused > 20


@pytest.mark.parametrize("what", ["text", "npy", "npz", "fewer pixels"])
def test_foreign_files(cornell, made, what):
    if what == "text":
        made.write_text("a,b,c\n")
    elif what == "npy":
        with open(made, "wb") as file:
            np.save(file, np.ones(3))
    elif what == "npz":
        np.savez(made, a=np.ones(3))
    else:
        with np.load(made) as file:
            arrays = dict(file)
        np.savez(made, **arrays | {"count": arrays["count"][:-1]})
    with pytest.raises(pj.InputError, match="run.npz is .*damaged"):
        pj.render_until(cornell, spp=4, seed=3, checkpoint=made)


# ---- disks that fail ------------------------------------------------------------------------------------------------


def test_unwritable_places_are_noticed_before_rendering(cornell, tmp_path, monkeypatch):
    monkeypatch.setattr(passes, "compile", lambda *_: pytest.fail("it compiled"))
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(pj.InputError, match="there is no folder"):
        pj.render_until(cornell, spp=4, checkpoint=tmp_path / "none" / "run.npz")
    with pytest.raises(pj.InputError, match="folder.npz"):
        pj.render_until(cornell, spp=4, checkpoint=tmp_path / "folder.npz")
    if hasattr(os, "geteuid") and os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o500)
        with pytest.raises(pj.InputError, match="cannot be written"):
            pj.render_until(cornell, spp=4, checkpoint=tmp_path / "locked" / "run.npz")


def test_a_full_disk_leaves_the_last_checkpoint_and_costs_no_image(cornell, undisturbed, tmp_path, monkeypatch):
    file, saves = tmp_path / "run.npz", iter(range(10**6))

    def savez(stream, plain=np.savez, **arrays):
        if next(saves) >= 6:
            stream.write(b"PK")
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(stream, **arrays)

    monkeypatch.setattr(np, "savez", savez)
    monkeypatch.setattr(checkpoint, "COST", 0)
    with pytest.warns(pj.InputWarning, match="run.npz: cannot be written: No space left") as warned:
        same(pj.render_until(cornell, **HOW, checkpoint=file), undisturbed)
    assert len(warned) == 1
    assert next(saves) > 8  # saving was tried again
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]
    with np.load(file) as saved:
        assert 0 < saved["count"].min() < undisturbed.samples.min()
        assert json.loads(str(saved["facts"]))["seconds"] > 0
    same(pj.render_until(cornell, **HOW, checkpoint=file), undisturbed)


def test_a_failure_that_passes_costs_nothing(cornell, undisturbed, tmp_path, monkeypatch):
    saves = iter(range(10**6))

    def savez(stream, plain=np.savez, **arrays):
        if 3 <= next(saves) < 6:
            raise MemoryError
        plain(stream, **arrays)

    monkeypatch.setattr(np, "savez", savez)
    monkeypatch.setattr(checkpoint, "COST", 0)
    with pytest.warns(pj.InputWarning, match="MemoryError; the render goes on without"):
        same(pj.render_until(cornell, **HOW, checkpoint=tmp_path / "run.npz"), undisturbed)
    monkeypatch.setattr(passes, "compile", lambda *_: lambda *_: pytest.fail("it rendered"))
    same(pj.render_until(cornell, **HOW, checkpoint=tmp_path / "run.npz"), undisturbed)


def test_saving_takes_a_small_share_of_the_time(cornell, tmp_path, monkeypatch):
    """A save that takes a second is made at most every 200 seconds."""
    clock, saved = [0.0], []

    def write_whole(path, write):
        saved.append(clock[0])
        clock[0] += 1

    monkeypatch.setattr(checkpoint, "write_whole", write_whole)
    monkeypatch.setattr(checkpoint.time, "perf_counter", lambda: clock[0])
    store, state = checkpoint.Checkpoint(tmp_path / "run.npz", {}), passes.start(cornell)
    store.save(state)
    state.count[:] = 1
    while clock[0] < 4000:
        clock[0] += 0.3
        store.save_if_due(state)
    assert 15 < len(saved) <= 21


def test_before_the_first_sample_a_checkpoint_holds_no_arrays(cornell, tmp_path):
    store = checkpoint.Checkpoint(tmp_path / "run.npz", {})
    fresh = passes.start(cornell)
    passes.plan(fresh, 16)
    store.save(fresh)
    assert (tmp_path / "run.npz").stat().st_size < 1000
    assert store.load(fresh) is fresh


@pytest.mark.parametrize("adaptive", [False, True])
def test_a_state_saved_after_any_call_comes_back_as_it_was(cornell, tmp_path, monkeypatch, adaptive):
    monkeypatch.setattr(passes, "CHUNK_PIXELS", 100)
    store, state = checkpoint.Checkpoint(tmp_path / "run.npz", {}), passes.start(cornell)
    for spp in (16, 40):
        passes.plan(state, spp)
        for _ in passes.extend(cornell, state, 5, DEFAULTS):
            store.save(state)
            loaded = store.load(passes.start(cornell))
            for name in ("means", "count", "goal", "weights"):
                np.testing.assert_array_equal(getattr(loaded, name), getattr(state, name), strict=True)
            assert loaded.spp == spp
        if adaptive:
            state.weights = np.linspace(0.5, 1.5, len(state.count), dtype=np.float32)
    if not adaptive:
        assert (tmp_path / "run.npz").stat().st_size < state.means.nbytes + 2000
