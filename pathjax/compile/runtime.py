"""The only module that touches XLA or devices: how a function of one ray becomes a native kernel over millions.

XLA:CPU dispatches a kernel for every operation of a loop's body, every trip, unless the loop touches less than a
threshold of bytes: then it compiles the whole nest into one LLVM function. Raising that threshold turns `lax.map` over
single-ray code into a native loop, some twenty times faster than `vmap` over wavefronts. The option is read once,
when the backend starts, so this module sets it on import.

Side effect on other code in the process: a user's own JAX loop over large element-wise arrays is then compiled for
one thread. `PATHJAX_NATIVE_LOOPS=0` in the environment opts out; pathjax still works, slowly.

A kernel on several devices ends in an all-gather, whose parts wait for each other in threads of XLA's pool. XLA aborts
the process where that takes a minute, so two limits are raised on import too: on those threads, and on that time.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import platform
import re
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial, wraps
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.sharding import Mesh, PartitionSpec

from pathjax.compile.lanes import lanes

_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_FLAG = f"--xla_backend_extra_options={_OPTION}=1000000000000"
# XLA halves the vectors of processors that have them this wide; kernels of lanes gain a tenth or more from whole ones.
_WIDTH_OPTION = "xla_cpu_prefer_vector_width"
_WIDTH_FLAG = f"--{_WIDTH_OPTION}=512"
_DEVICE_FLAG = "xla_force_host_platform_device_count"
# A Python thread that starts computations on several devices faster than they end, 32 on each, holds a thread of the
# pool for each device until one ends. XLA makes a thread for each core, and where all are held, the part of an
# all-gather that another one waits for never begins. Of two for each device one runs kernels; with more of them renders
# take longer. (Two Python threads that both run so far ahead can still stop each other, as XLA lets those that wait go
# on in any order.)
_POOL_VARIABLE, _POOL_OF_A_DEVICE = "PJRT_NPROC", 2
# Of an all-gather XLA aborts where the last part comes a minute after the first: of two devices one may have the longer
# half of an image, or a busy core. These are three years; jaxlib 0.7 does not know the flags.
_PATIENCE_OPTION = "xla_cpu_collective_call"
_PATIENCE_FLAGS = " ".join(
    f"--{_PATIENCE_OPTION}_{what}_timeout_seconds={10**8}"
    for what in ("warn_stuck", "terminate")
    if tuple(map(int, jaxlib.__version__.split(".")[:2])) >= (0, 8)
)
# Items that a native loop takes at once: enough that loops over them vectorise and their overheads vanish, few enough
# that what they keep stays in the nearest caches. Few items would leave most of the lanes idle.
_LANES, _FEW_LANES = 256, 64
MANY_ITEMS = 2 * _LANES
# Bytes of live values that one lane of a vmapped path keeps; sizes the chunks on an accelerator.
_BYTES_PER_LANE = 4096
_CHUNK_BYTES = 1 << 30
# Of compiled kernels on disk, some 100 kB each; those used longest ago go first.
_CACHE_BYTES = 1 << 28
# Lines of /proc/cpuinfo that tell which machine code a processor runs, on x86 and Arm.
_CPU_LINES = ("vendor_id", "cpu family", "model", "flags", "CPU implementer", "CPU part", "Features")


def _set_up() -> None:
    flags = os.environ.get("XLA_FLAGS", "")
    native = os.environ.get("PATHJAX_NATIVE_LOOPS", "1") != "0"
    wanted = native and _OPTION not in flags
    if wanted:
        width = "" if _WIDTH_OPTION in flags else _WIDTH_FLAG
        patience = "" if _PATIENCE_OPTION in flags else _PATIENCE_FLAGS
        os.environ["XLA_FLAGS"] = " ".join(filter(None, (flags, _FLAG, width, patience)))
    devices_chosen = _DEVICE_FLAG in flags or jax.config.jax_num_cpu_devices >= 0
    devices = max(_cores(), jax.config.jax_num_cpu_devices, *map(int, re.findall(rf"{_DEVICE_FLAG}=(\d+)", flags)))
    os.environ.setdefault(_POOL_VARIABLE, str(_POOL_OF_A_DEVICE * devices))
    try:
        if not devices_chosen:
            jax.config.update("jax_num_cpu_devices", _cores())
        elif wanted:
            # The update refuses a started backend: the one public way to ask whether it has started.
            chosen = jax.config.jax_num_cpu_devices
            jax.config.update("jax_num_cpu_devices", chosen + 1)
            jax.config.update("jax_num_cpu_devices", chosen)
    except RuntimeError:
        if wanted:
            os.environ["XLA_FLAGS"] = flags
            warnings.warn(
                "JAX's backend was started before pathjax was imported, so renders will be about 20 times slower. "
                "Import pathjax before the first JAX array or jax.devices(), or set in the environment "
                f"XLA_FLAGS='{_FLAG} {_WIDTH_FLAG}'",
                stacklevel=3,
            )


def _cores() -> int:
    """Those that this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_set_up()


def keep_kernels() -> None:
    """Let this process find the kernels that earlier ones compiled, and leave its own to later ones.

    For programs, not libraries: it sets JAX's persistent compilation cache to `pathjax` in the user's cache folder,
    and silences XLA's log, which takes a compiler's preferences for instructions that the processor lacks. What the
    user chose, in JAX's configuration or by `PATHJAX_CACHE=0`, stands; without a folder to write in, or on a full disk,
    nothing is kept, and JAX's warnings of that are silenced.
    Linux only: other systems do not tell their processors apart here, and XLA loads what a processor cannot run.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache", UserWarning)
    chosen = "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir is not None
    if chosen or os.environ.get("PATHJAX_CACHE", "1") == "0" or sys.platform != "linux":
        return
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        folder = (base if base.is_absolute() else Path.home() / ".cache") / "pathjax" / _processor()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        str(folder).encode()  # XLA takes names in UTF-8 alone
    except (OSError, RuntimeError, UnicodeError):  # RuntimeError: nobody knows the home folder
        return
    if not os.access(folder, os.W_OK):
        return
    _remove_halves(folder)
    options = {
        "jax_compilation_cache_dir": str(folder),
        "jax_compilation_cache_max_size": _CACHE_BYTES,
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_logging_level": "CRITICAL",
    }
    for name, value in options.items():
        if name.upper() not in os.environ and hasattr(jax.config, name):
            jax.config.update(name, value)


def _remove_halves(folder: Path) -> None:
    """Remove kernels whose writing a full disk cut short: one without its time of use stops JAX from keeping others."""
    with contextlib.suppress(OSError):
        for kernel in folder.glob("*-cache"):
            if not kernel.with_name(kernel.name.removesuffix("-cache") + "-atime").exists():
                kernel.unlink(missing_ok=True)


def _processor() -> str:
    """A name that processors share if they run the same machine code."""
    with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        first = [line for line in itertools.takewhile(str.strip, file) if line.partition("\t")[0] in _CPU_LINES]
    return f"{platform.machine()}-{hashlib.sha256(''.join(first).encode()).hexdigest()[:16]}"


def usual_promotion(f: Callable) -> Callable:
    """f, within which JAX promotes dtypes and ranks as by default: what the user forbids is meant for the user's code.

    For what is called from outside, and for what JAX calls later, such as rules of differentiation.
    """

    @wraps(f)
    def usual(*args, **kwargs):
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return f(*args, **kwargs)

    return usual


def native() -> bool:
    """Whether loops over rays become native code here: on CPUs, unless the user opted out."""
    return jax.default_backend() == "cpu" and _OPTION in os.environ.get("XLA_FLAGS", "")


def calls_at_once() -> int:
    """How many calls of one kernel run at a time: on CPUs, where a call keeps its thread, one for each device."""
    return len(jax.local_devices()) if jax.default_backend() == "cpu" else 1


def devices_of_a_call() -> int | None:
    """`devices` of `native_map` in a kernel for `concurrently`: one of a CPU runs on the thread that calls it."""
    return 1 if jax.default_backend() == "cpu" else None


def concurrently(f: Callable, items: Iterable) -> Iterator[tuple]:
    """Pairs (item, f(item)) in the order of the items, `calls_at_once` of them at a time, each in a thread of its own.

    So no device waits for another, nor for what is done with the results. Of the items, a few more are taken than
    results are given. Closed early, it waits for the calls that run.
    """
    workers = calls_at_once()
    waiting = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append((item, pool.submit(usual_promotion(f), item)))
                # One that is ready for each thread, and one whose result is being used.
                if len(waiting) > 2 * workers:
                    done, result = waiting.popleft()
                    yield done, result.result()
            while waiting:
                done, result = waiting.popleft()
                yield done, result.result()
        finally:
            for _, result in waiting:
                result.cancel()


@usual_promotion
def native_map(f: Callable, xs, *shared, form: str | None = None, devices: int | None = None):
    """`f(x, *shared)` for every x of `xs`, on all local devices.

    Args:
        f: pure function of one item, with real control flow.
        xs: pytree of arrays (N, ...).
        shared: pytrees that every item sees whole.
        form: "lanes" (one native loop a device over groups of items, see `lanes`), "loop" (the same, item by item),
            "vmap" (chunks of vectorised items), or None: what suits the backend. All give the same results up to
            rounding.
        devices: how many local devices to use; None: all.
    Returns:
        pytree of arrays (N, ...); bitwise the same for every number of devices.
    Under `jax.vmap` each item loops over the batch, within the same kernel.
    """

    @custom_vmap
    def run(xs, *shared):
        return _map(f, xs, shared, form, devices)

    @run.def_vmap
    @usual_promotion
    def run_batch(size, batched, xs, *shared):
        xs_batched, *shared_batched = batched

        def entries(x, *shared):
            def entry(b):
                def pick(leaf, is_batched):
                    return lax.dynamic_index_in_dim(leaf, b, keepdims=False) if is_batched else leaf

                picked = jax.tree.map(pick, (x, *shared), (xs_batched, *shared_batched))
                return f(*picked)

            return lax.map(entry, jnp.arange(size))

        def swap(y):
            return jnp.swapaxes(y, 0, 1)

        xs = jax.tree.map(lambda x, is_batched: swap(x) if is_batched else x, xs, xs_batched)
        ys = jax.tree.map(swap, native_map(entries, xs, *shared, form=form, devices=devices))
        return ys, jax.tree.map(lambda _: True, ys)

    return run(xs, *shared)


def _map(f, xs, shared, form, devices):
    count = jax.tree.leaves(xs)[0].shape[0]
    form = form or ("lanes" if native() else "vmap")
    devices = jax.local_devices()[:devices]
    each = -(-count // len(devices))
    run = {
        # By the items of all devices, so that their number does not change the program.
        "lanes": partial(_lanes, width=_LANES if count >= MANY_ITEMS else _FEW_LANES),
        "loop": _loop,
        "vmap": partial(_vmap_chunks, chunk=_CHUNK_BYTES // _BYTES_PER_LANE),
    }[form]
    if len(devices) == 1:
        return run(f, xs, shared)

    # Device i takes items i, i + D, i + 2 D, ...: each gets its share of the expensive part of an image.
    def deal(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[:1], (each * len(devices) - count, *x.shape[1:]))])
        return x.reshape(each, len(devices), *x.shape[1:]).swapaxes(0, 1)

    def gather(y):
        return y.swapaxes(0, 1).reshape(each * len(devices), *y.shape[2:])[:count]

    def on_one_device(xs, *shared):
        return jax.tree.map(lambda y: y[None], run(f, jax.tree.map(lambda x: x[0], xs), shared))

    spec = PartitionSpec("device")
    mapped = jax.shard_map(
        on_one_device,
        mesh=Mesh(np.array(devices), ("device",)),
        in_specs=(spec, *(PartitionSpec() for _ in shared)),
        out_specs=spec,
        check_vma=False,
    )
    return jax.tree.map(gather, mapped(jax.tree.map(deal, xs), *shared))


def _loop(f, xs, shared):
    return lax.map(lambda x: f(x, *shared), xs)


def _lanes(f, xs, shared, width):
    return lanes(f, width)(xs, *shared)


def _vmap_chunks(f, xs, shared, chunk):
    return lax.map(lambda x: f(x, *shared), xs, batch_size=min(chunk, jax.tree.leaves(xs)[0].shape[0]))
