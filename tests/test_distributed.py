"""Scripts in several processes: every function of a scene gives the bits of one process, inside a user's jit too."""

import os
import re
import signal
import socket
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj

PREAMBLE = """
import sys
import jax, jax.numpy as jnp, numpy as np
import pathjax as pj
from pathjax import distributed

port, processes, process, out = sys.argv[1:5]
distributed.start(f"127.0.0.1:{port}", int(processes), int(process))
"""


@pytest.fixture
def started(root, tmp_path):
    """(script, processes) -> running processes with one device each; each may save its results."""
    running = []

    def start(script, processes):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        environment = os.environ | {"JAX_NUM_CPU_DEVICES": "1", "PYTHONPATH": str(root)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        for process in range(processes):
            out = tmp_path / f"{processes}_{process}.npz"
            command = [sys.executable, "-u", "-c", PREAMBLE + script, *map(str, (port, processes, process, out))]
            running.append(subprocess.Popen(command, cwd=root, env=environment, **pipes))
        return running[-processes:]

    yield start
    for process in running:
        process.kill()
        process.communicate()


@pytest.fixture
def found(started, tmp_path):
    """(script, processes) -> the results that each process saved."""

    def found(script, processes):
        for process in started(script, processes):
            told, _ = process.communicate(timeout=600)
            assert process.returncode == 0, told
        return [dict(np.load(tmp_path / f"{processes}_{process}.npz")) for process in range(processes)]

    return found


@pytest.fixture
def here(root, tmp_path, monkeypatch):
    """(script) -> the results that it saves in this process, which has one device per core."""

    def here(script):
        monkeypatch.chdir(root)
        exec(script, {"jax": jax, "jnp": jnp, "np": np, "pj": pj, "out": tmp_path / "here.npz"})
        return dict(np.load(tmp_path / "here.npz"))

    return here


def assert_same(*results):
    first, *others = results
    assert first
    for other in others:
        assert first.keys() == other.keys()
        for name, value in first.items():
            np.testing.assert_array_equal(value, other[name], err_msg=name)


MAPS = """
from pathjax.compile import native_fold, native_map, persistent_loop, split_map, together

xs = jnp.linspace(0, 3, 601)

def add(x, total):
    def step(state):
        gathered = together(lambda total, here, x: total + jnp.where(here, x, 0).sum())(state[1], x)
        return state[0] + 1, gathered

    return persistent_loop(lambda state: state[0] != 1 + jnp.int32(x), step, (jnp.int32(0), total))[1]

@jax.jit
def all_of(xs):
    squares = native_map(lambda x: (x > 1, jnp.sin(x) ** 2), xs)
    total = native_fold(add, xs, start=lambda lanes: jnp.zeros(()), finish=lambda total: total)
    columns = split_map(lambda first, size, xs: jnp.cumsum(jnp.ones(size)) + first, 7, xs)
    return squares, total, columns, jnp.mean(squares[1])

(low, squares), total, columns, mean = all_of(xs)
np.savez(out, low=low, squares=squares, total=total, columns=columns, mean=mean)
"""
REFUSED = """
for says, call in (
    ("directions for closest_hit", lambda: pj.closest_hit(None, xs, xs + int(process))),
    ("call", lambda: (pj.any_hit if process == "1" else pj.closest_hit)(None, xs, xs)),
):
    try:
        call()
    except pj.InputError as error:
        assert f"another {says} than process" in str(error), error
    else:
        raise AssertionError(f"{says} was not refused")
"""


def test_kernels_are_dealt_to_all_processes_and_what_differs_is_refused(found, here):
    assert_same(here(MAPS), *found(MAPS + REFUSED, 2))


# All functions of a scene, outside jit and inside a user's jit.
EVERYTHING = """
from pathjax.inverse import normal as module

scene = pj.load_scene("scenes/cornell_box.xml", res=12)
names = ["white.reflectance", "light.radiance"]
image, J = pj.jacobian(scene, names, spp=4, seed=1)
many = dict(pj.jacobian(scene, [*names, "red.reflectance", "green.reflectance"], spp=4, seed=1)[1].derivatives)
normal = pj.normal_equations(scene, names, 1.1 * np.asarray(image), spp=4)
module.ITEMS_OF_A_PART, module.LEAST_PARTS, usual = 36, 4, (module.ITEMS_OF_A_PART, module.LEAST_PARTS)
module._compiled.clear_cache()
dealt = pj.normal_equations(scene, names, 1.1 * np.asarray(image), spp=4)
module.ITEMS_OF_A_PART, module.LEAST_PARTS = usual
module._compiled.clear_cache()

def loss(values):
    return jnp.mean((pj.render(pj.with_parameters(scene, values), 4, 1) - 0.5) ** 2)

textured = pj.load_scene("tests/scenes/textures.xml", res=12)
name = next(n for n, x in pj.parameters(textured).items() if np.ndim(x) == 3)
texels = pj.parameters(textured)[name]
seen, pull = jax.vjp(lambda x: pj.render(pj.with_parameters(textured, {name: x}), 4, 1), texels)
everything = {
    "image": pj.render(scene, 4, 1), "jacobian": (image, J.derivatives, many), "J^T v of texels": pull(seen),
    "in jit": jax.jit(jax.grad(loss))({name: pj.parameters(scene)[name] for name in names}),
    "normal": (normal.matrix, normal.gradient, normal.loss, normal.scatter, normal.residuals),
    "dealt normal": (dealt.matrix, dealt.gradient, dealt.loss, dealt.scatter, dealt.residuals),
}
leaves, _ = jax.tree_util.tree_flatten_with_path(everything)
np.savez(out, **{jax.tree_util.keystr(path): np.asarray(x) for path, x in leaves})
"""
FITS = """
scene = pj.load_scene("scenes/cornell_box.xml", res=12)
target = pj.render_until(scene, spp=64).image
few = pj.fit(scene, target, ["white.reflectance"], start={"white.reflectance": 0.5}, spp=8)
textured = pj.load_scene("tests/scenes/textures.xml", res=16)
name = next(n for n, x in pj.parameters(textured).items() if np.ndim(x) == 3)
many = pj.fit(textured, pj.render_until(textured, spp=64).image, [name], spp=8, smoothness=0.1)
assert "interrupted" not in (few.message, many.message)
np.savez(out, few=few.values["white.reflectance"], covariance=few.covariance, many=many.values[name],
         errors=many.standard_errors[name], steps=[len(few.history), len(many.history)])
"""
LOOP = """
scene = pj.load_scene("scenes/cornell_box.xml", res=64)
for number in range(1, 1000):
    print("called", number, flush=True)
    pj.jacobian(scene, ["white.reflectance"], spp={spp})
"""


@pytest.mark.slow
def test_images_derivatives_and_normal_equations_are_those_of_one_process(found, here):
    assert_same(here(EVERYTHING), *found(EVERYTHING, 2), *found(EVERYTHING, 3))


@pytest.mark.slow
def test_fits_of_few_numbers_and_of_textures_are_those_of_one_process(found, here):
    assert_same(here(FITS), *found(FITS, 2))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("victim", [0, 1])
@pytest.mark.parametrize(
    ("sends", "spp", "says"), [("SIGKILL", 8, "ended"), ("SIGKILL", 20000, "ended"), ("SIGSTOP", 8, "not answered")]
)
def test_a_process_is_killed_or_stopped_and_the_other_ends_and_names_it(started, victim, sends, spp, says):
    """Between calls, and within a long call of many samples, which does not check on the other process."""
    running = started(LOOP.format(spp=spp), 2)
    for line in running[1 - victim].stdout:
        if line == "called 2\n" or (line == "called 1\n" and spp > 8):
            break
    time.sleep(0.5 if spp == 8 else 3)
    running[victim].send_signal(getattr(signal, sends))
    sent = time.monotonic()
    told, _ = running[1 - victim].communicate(timeout=15)
    assert time.monotonic() - sent < 15
    assert running[1 - victim].returncode == 1
    assert re.search(f"process {1 - victim} ends, as process {victim} has {says}", told), told


@pytest.mark.slow
@pytest.mark.parametrize("faulty", [0, 1])
def test_an_error_in_one_process_ends_it_and_the_other(started, faulty):
    """Without pathjax, Python would first wait for the other process, which waits for this one."""
    fails = f'if process == "{faulty}":\n    raise KeyError("of this script")\n'
    running = started(fails + LOOP.format(spp=8), 2)
    told, _ = running[faulty].communicate(timeout=60)
    assert running[faulty].returncode == 1
    assert "of this script" in told
    told, _ = running[1 - faulty].communicate(timeout=15)
    assert running[1 - faulty].returncode == 1
    assert f"as process {faulty} has ended: KeyError: 'of this script'" in told
