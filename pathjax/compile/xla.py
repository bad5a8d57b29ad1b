"""XLA's configuration for compiling loops over rays to native code.

XLA:CPU dispatches a kernel for every operation of a loop's body, every trip, unless the loop touches less than a
threshold of bytes: then it compiles the whole nest into one LLVM function. Raising that threshold turns `lax.map` over
single-ray code into a native loop, some twenty times faster than `vmap` over wavefronts.

A kernel on several devices ends in an all-gather, whose parts wait for each other in threads of XLA's pool. XLA aborts
the process if that takes a minute, so two limits are raised too: on the number of threads, and on the time.
"""

from __future__ import annotations

import functools
import os
import re
import warnings

import jax
import jaxlib

from pathjax.system.cores import cores

_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_FLAG = f"--xla_backend_extra_options={_OPTION}=1000000000000"
# Optimisations that take compile time and gain kernels of lanes little: LLVM's last level takes a sixth of it, loop
# unrolling another sixth, and MLIR, for the little code outside of kernels, a tenth. With the last two, renders of
# meshes would take 2 % less time, and the Cornell box no less. (Naming an extra option sets it, whatever its value, and
# a version of XLA ignores the options that it does not know.)
_LEVEL_OPTION = "xla_backend_optimization_level"
_LEVEL_FLAG = f"--{_LEVEL_OPTION}=2"
_QUICK_FLAG = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling=true,xla_cpu_disable_new_fusion_emitters=true"
# XLA hoists loop-invariant code, one value at a time, before LLVM does the same. This pass takes 2 to 8 % of the CPU
# time of a first render, and kernels of lanes gain nothing by it.
_PASSES_OPTION = "xla_disable_hlo_passes"
_PASSES_FLAG = f"--{_PASSES_OPTION}=while-loop-invariant-code-motion"
# XLA uses half the width on processors with vectors of 512 bits; kernels of lanes gain a tenth or more from all of it.
_WIDTH_OPTION = "xla_cpu_prefer_vector_width"
_WIDTH_FLAG = f"--{_WIDTH_OPTION}=512"
_DEVICE_FLAG = "xla_force_host_platform_device_count"
# A Python thread that starts computations on several devices faster than they end, 32 on each, holds a pool thread for
# each device until one ends. XLA creates a thread for each core. If all are held, the part of an all-gather for which
# another part waits never begins. With two threads per device one runs kernels; with more, renders take longer. (Two
# Python threads that both run so far ahead can still block each other, as XLA resumes waiting threads in any order.)
_POOL_VARIABLE, _POOL_OF_A_DEVICE = "PJRT_NPROC", 2
# XLA aborts an all-gather whose last part arrives a minute after the first, which happens if one device has the slower
# half of an image, or a busy core. These limits are three years; jaxlib 0.7 does not know the flags.
_PATIENCE_OPTION = "xla_cpu_collective_call"
_PATIENCE_FLAGS = " ".join(
    f"--{_PATIENCE_OPTION}_{what}_timeout_seconds={10**8}"
    for what in ("warn_stuck", "terminate")
    if tuple(map(int, jaxlib.__version__.split(".")[:2])) >= (0, 8)
)


@functools.cache
def setup() -> None:
    """Set XLA and JAX up for native loops, and create one JAX device per core. Importing pathjax calls it.

    XLA reads its flags once, when JAX's first array or `jax.devices()` starts the backend, so this must come before;
    afterwards it only warns. Later calls do nothing. The user's choices take precedence: flags in XLA_FLAGS, the number
    of devices in JAX's configuration, PJRT_NPROC.

    Side effects on other code in the process: a user's own JAX loop over large element-wise arrays is compiled for one
    thread, too, and all code is optimised to LLVM's second level of three, without unrolling, emitted without MLIR, and
    its loop invariants are hoisted by LLVM alone. `PATHJAX_NATIVE_LOOPS=0` in the environment opts out; pathjax still
    works, slowly.

    Warns:
        UserWarning: the backend has started already; the message says the remedy.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    native = os.environ.get("PATHJAX_NATIVE_LOOPS", "1") != "0"
    wanted = native and _OPTION not in flags
    if wanted:
        width = "" if _WIDTH_OPTION in flags else _WIDTH_FLAG
        level = "" if _LEVEL_OPTION in flags else _LEVEL_FLAG
        passes = "" if _PASSES_OPTION in flags else _PASSES_FLAG
        patience = "" if _PATIENCE_OPTION in flags else _PATIENCE_FLAGS
        os.environ["XLA_FLAGS"] = " ".join(filter(None, (flags, _FLAG, _QUICK_FLAG, passes, width, level, patience)))
    devices_chosen = _DEVICE_FLAG in flags or jax.config.jax_num_cpu_devices >= 0
    devices = max(cores(), jax.config.jax_num_cpu_devices, *map(int, re.findall(rf"{_DEVICE_FLAG}=(\d+)", flags)))
    os.environ.setdefault(_POOL_VARIABLE, str(_POOL_OF_A_DEVICE * devices))
    try:
        if not devices_chosen:
            jax.config.update("jax_num_cpu_devices", cores())
        elif wanted:
            # The update raises if the backend has started: the only public way to test that.
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
                stacklevel=4,  # the line that imports pathjax
            )


def native() -> bool:
    """Return whether loops over rays are compiled to native code: on CPUs, unless the user opted out."""
    return jax.default_backend() == "cpu" and _OPTION in os.environ.get("XLA_FLAGS", "")
