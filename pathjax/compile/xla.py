"""How XLA is set up so that loops over rays become native code.

XLA:CPU dispatches a kernel for every operation of a loop's body, every trip, unless the loop touches less than a
threshold of bytes: then it compiles the whole nest into one LLVM function. Raising that threshold turns `lax.map` over
single-ray code into a native loop, some twenty times faster than `vmap` over wavefronts.

A kernel on several devices ends in an all-gather, whose parts wait for each other in threads of XLA's pool. XLA aborts
the process where that takes a minute, so two limits are raised too: on those threads, and on that time.
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
# What takes time of compilation, and gives kernels of lanes little: LLVM's last level, a sixth; its unrolling of loops,
# another; and MLIR, a tenth, for what little stands outside of a kernel. The last two together give renders of meshes
# 2 % of their time, and the Cornell box nothing. (To name an extra option is to set it, whatever its value, and one
# that a version of XLA does not know means nothing to it.)
_LEVEL_OPTION = "xla_backend_optimization_level"
_LEVEL_FLAG = f"--{_LEVEL_OPTION}=2"
_QUICK_FLAG = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling=true,xla_cpu_disable_new_fusion_emitters=true"
# XLA moves what a loop computes alike in each trip out of the loop, one value at a time, before LLVM does the same. It
# takes 2 to 8 % of the CPU time of a first render, and kernels of lanes gain nothing by it.
_PASSES_OPTION = "xla_disable_hlo_passes"
_PASSES_FLAG = f"--{_PASSES_OPTION}=while-loop-invariant-code-motion"
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


@functools.cache
def setup() -> None:
    """Set XLA and JAX up for native loops, and make one JAX device for each core. Importing pathjax calls it.

    XLA reads its flags once, when JAX's first array or `jax.devices()` starts the backend, so this must come before;
    afterwards it only warns. Later calls do nothing. What the user chose stands: flags in XLA_FLAGS, a number of
    devices in JAX's configuration, PJRT_NPROC.

    Side effects on other code in the process: a user's own JAX loop over large element-wise arrays is compiled for one
    thread too, and all is optimised to LLVM's second level, of three, without unrolling, emitted without MLIR, and
    moved out of loops by LLVM alone. `PATHJAX_NATIVE_LOOPS=0` in the environment opts out; pathjax still works, slowly.

    Warns:
        UserWarning: the backend was started before, with the remedy.
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
                stacklevel=4,  # who imports pathjax
            )


def native() -> bool:
    """Whether loops over rays become native code here: on CPUs, unless the user opted out."""
    return jax.default_backend() == "cpu" and _OPTION in os.environ.get("XLA_FLAGS", "")
