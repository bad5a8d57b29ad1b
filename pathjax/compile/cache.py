"""Compiled kernels on disk, for programs that start often."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import platform
import sys
import warnings
from pathlib import Path

import jax

# Most bytes of compiled kernels on disk, some 100 kB each; those used longest ago go first.
_CACHE_BYTES = 1 << 28
# Lines of /proc/cpuinfo that tell which machine code a processor runs, on x86 and Arm.
_CPU_LINES = ("vendor_id", "cpu family", "model", "flags", "CPU implementer", "CPU part", "Features")


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
