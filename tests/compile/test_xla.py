"""The setup of XLA on import."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from pathjax.compile import xla

OPTION = "xla_cpu_small_while_loop_byte_threshold"


@pytest.fixture(scope="module")
def python(root):
    """(code, **environment) -> the JSON on the last line of its output, and its stderr, from a separate process."""

    def run(code, **environment):
        ours = "XLA_", "JAX_", "PATHJAX_", "PJRT_"
        kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
        kept["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
        command = [sys.executable, "-c", "import json\n" + code]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=kept | environment)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1]), done.stderr

    return run


FLAGS_AND_DEVICES = """
import os, pathjax, jax
print(json.dumps([os.environ.get("XLA_FLAGS", ""), jax.local_device_count(), pathjax.compile.native()]))
"""


@pytest.fixture(scope="module")
def untouched(python):
    """Flags, device count, whether loops are native, and stderr, where the user has set nothing."""
    values, err = python(FLAGS_AND_DEVICES)
    return *values, err


def test_import_turns_native_loops_on_with_a_device_per_core(untouched):
    flags, devices, native, err = untouched
    assert OPTION in flags
    assert native
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert devices == cores
    assert "Warning" not in err


def test_users_flags_are_kept(python, untouched):
    """Both the flags that pathjax does not know and those that it would set; pathjax adds its other flags."""
    users = "--xla_cpu_enable_fast_math=false --xla_cpu_prefer_vector_width=128 --xla_backend_optimization_level=3"
    if "terminate_timeout" in xla._PATIENCE_FLAGS:  # jaxlib 0.7 has no such flag
        users += " --xla_cpu_collective_call_terminate_timeout_seconds=50"
    (flags, _, native), _ = python(FLAGS_AND_DEVICES, XLA_FLAGS=users)
    assert native and flags.startswith(f"{users} ")
    ours = [each for each in untouched[0].split() if each.split("=")[-2] not in users and "collective" not in each]
    assert flags.removeprefix(f"{users} ").split() == ours


def test_users_own_threshold_and_number_of_threads_are_kept(python):
    mine = f"--xla_backend_extra_options={OPTION}=2048"
    code = FLAGS_AND_DEVICES.replace("[", "[os.environ['PJRT_NPROC'], ", 1)
    (threads, flags, _, _), _ = python(code, XLA_FLAGS=mine, PJRT_NPROC="3")
    assert flags == mine and threads == "3"


@pytest.mark.parametrize(
    "code, environment",
    [
        ("", {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}),
        ("", {"JAX_NUM_CPU_DEVICES": "3"}),
        ("import jax; jax.config.update('jax_num_cpu_devices', 3)", {}),
    ],
)
def test_users_number_of_devices_is_kept(python, code, environment):
    (flags, devices, native), err = python(code + FLAGS_AND_DEVICES, **environment)
    assert devices == 3
    assert native
    assert "Warning" not in err


def test_import_after_jax_is_in_time_and_setting_up_again_changes_nothing(python):
    """In time: before JAX's backend starts."""
    again = "import jax\nimport pathjax.compile; pathjax.compile.setup()"
    (flags, _, native), err = python(again + FLAGS_AND_DEVICES)
    assert flags.count(OPTION) == 1
    assert native
    assert "Warning" not in err


STARTED = "import jax; jax.devices()\n"


@pytest.mark.parametrize("number", [{}, {"JAX_NUM_CPU_DEVICES": "2"}])
def test_import_after_the_backend_warns_once_with_the_remedy(python, number):
    """Only once, even if pathjax is set up again."""
    again = "import pathjax; pathjax.compile.setup()"
    (flags, _, native), err = python(STARTED + again + FLAGS_AND_DEVICES, **number)
    assert err.count("UserWarning") == 1
    assert "before" in err and f"XLA_FLAGS='{xla._FLAG} {xla._WIDTH_FLAG}'" in err
    assert OPTION not in flags
    assert not native


def test_import_after_the_backend_is_silent_where_the_user_set_the_option(python):
    remedy = f"{xla._FLAG} {xla._WIDTH_FLAG}"
    (_, _, native), err = python(STARTED + FLAGS_AND_DEVICES, XLA_FLAGS=remedy)
    assert native
    assert "Warning" not in err


RENDER = """
import pathjax, numpy
scene = pathjax.load_scene("{scene}", res=4, max_depth=4)
image = numpy.asarray(pathjax.render(scene, 2, strategy="bsdf"))
print(json.dumps([pathjax.compile.native(), image.tolist()]))
"""


@pytest.mark.slow  # test_vectorised.py compares image and derivatives of the opted-out form with native loops
@pytest.mark.parametrize("opted_out", [True, False])
def test_renders_are_right_without_native_loops(python, root, opted_out):
    """Opted out, or imported too late."""
    code = RENDER.format(scene=(root / "scenes" / "furnace.xml").as_posix())
    environment = {"PATHJAX_NATIVE_LOOPS": "0"} if opted_out else {}
    (native, image), err = python(code if opted_out else STARTED + code, **environment)
    assert not native
    assert ("UserWarning" in err) == (not opted_out)
    rho = np.array([0.2, 0.5, 0.8])
    np.testing.assert_allclose(image, np.broadcast_to((1 - rho**4) / (1 - rho), (4, 4, 3)), rtol=1e-5)


def test_parts_of_a_kernel_may_end_long_after_each_other(untouched):
    """XLA takes such a delay for a hang and aborts; jaxlib 0.7 has no flag to raise the limit."""
    flags = untouched[0]
    if "terminate_timeout" not in xla._PATIENCE_FLAGS:
        pytest.skip("this jaxlib has no such flag")
    year = 365 * 86400
    assert all(int(seconds) > year for seconds in re.findall(r"collective_call_\w+_timeout_seconds=(\d+)", flags))
    assert len(re.findall("collective_call", flags)) == 2


UNEVEN = """
import jax, jax.numpy as jnp
from pathjax.compile import native_map

def spin(item, times):
    def turn(state):
        return state[0] + 1, jnp.sin(state[1]) + 1
    return jax.lax.while_loop(lambda state: state[0] < jnp.where(item == 1, times, 1), turn, (0, 0.0))[1]

run = jax.jit(lambda times: native_map(spin, jnp.arange(2), times))
"""


@pytest.mark.slow
def test_one_device_may_need_minutes_longer_than_the_other(python):
    code = UNEVEN + "import time\nrun(1)\nbegin, times = time.time(), 1 << 24\n"
    code += "while time.time() < begin + 1: run(times).block_until_ready(); times *= 2\n"
    code += "begin = time.time(); run(times).block_until_ready(); each = (time.time() - begin) / times\n"
    code += "print(json.dumps(run(int(70 / each)).tolist()))"
    python(code, JAX_NUM_CPU_DEVICES="2")


AHEAD = """
import os
import jax, jax.numpy as jnp, numpy as np
from functools import partial
from jax.sharding import Mesh, PartitionSpec as P
from pathjax.compile import native_map

@jax.jit
@partial(jax.shard_map, mesh=Mesh(np.array(jax.devices()), "d"), in_specs=(P("d"), P()), out_specs=P("d"))
def late_on_one(device, times):
    def turn(state):
        return state[0] + 1, jnp.sin(state[1]) + 1
    return jax.lax.while_loop(lambda state: state[0] < device[0] * times, turn, (0 * device[0], 0.0 * device))[1]

kernel = jax.jit(lambda xs: native_map(jnp.sin, xs))
devices, xs = jnp.arange(2), jnp.arange(64.0)
for _ in range(40):
    late_on_one(devices, 1 << 20)
    y = kernel(xs)
    for _ in range(70):
        y = y + y
    y.block_until_ready()
print(json.dumps(len(jax.devices())))
"""


def test_many_operations_may_wait_for_a_kernel_on_several_devices(python):
    """XLA holds operations beyond 32 in the threads that the kernel needs. Some versions of jaxlib then hang in about
    one of ten of these rounds, until XLA's time limit ends them, here after 20 seconds.
    """
    limits = "".join(f" --xla_cpu_collective_call_{what}_timeout_seconds=10" for what in ("warn_stuck", "terminate"))
    python(AHEAD, JAX_NUM_CPU_DEVICES="2", XLA_FLAGS=limits if xla._PATIENCE_FLAGS else "")


IMPORTS = """
import sys, time
import jax
before = set(sys.modules)
begin = time.process_time()
import pathjax
seconds = time.process_time() - begin
import pathjax.cli.render
heavy = {"trimesh", "OpenEXR", "OpenImageIO", "rich", "PIL", "optimistix", "scipy", "mitsuba", "matplotlib"}
print(json.dumps([seconds, sorted(heavy & (set(sys.modules) - before))]))
"""


def test_import_is_light(python, tmp_path):
    """The import takes at most 0.3 s of CPU time beyond `import jax`, in one of a few tries: other work only ever adds.

    Neither the import nor the command `render` imports modules that only some uses need.
    The test uses the bytecode cache, as installed packages do; some environments turn it off.
    """
    bytecode = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(tmp_path)}
    for _ in range(8):  # the first try writes the bytecode
        (seconds, heavy), _ = python(IMPORTS, **bytecode)
        assert heavy == []
        if seconds < 0.3:
            return
    pytest.fail(f"import pathjax took {seconds:.2f} s")


@pytest.mark.parametrize("before", ["enable", "disable"])
def test_import_starts_no_backend_and_leaves_the_collector_as_it_was(python, before):
    """The collector is off during the import."""
    code = f"import gc\ngc.{before}()\nimport pathjax\nfrom jax._src import xla_bridge\n"
    (collects, started), _ = python(code + "print(json.dumps([gc.isenabled(), xla_bridge.backends_are_initialized()]))")
    assert collects is (before == "enable") and started is False
