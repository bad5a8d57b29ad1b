"""Compiled kernels on disk, for programs that start often."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import os
import platform
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import jax
import jaxlib

from pathjax.compile.jax_compat import bytes_of_program, program_of_bytes
from pathjax.compile.lanes import without_collections
from pathjax.system.files import write_whole

# Most bytes of compiled kernels on disk, some 100 kB each; those used longest ago go first.
_CACHE_BYTES = 1 << 28
# Lines of /proc/cpuinfo that tell which machine code a processor runs, on x86 and Arm.
_CPU_LINES = ("vendor_id", "cpu family", "model", "flags", "CPU implementer", "CPU part", "Features")
# JAX's events of kernels that were on disk.
_hits: list[str] = []
# The folder where programs are kept by what they are traced from; None: nowhere.
_programs: Path | None = None
# Programs of this process, by their keys there.
_known: dict[str, Callable] = {}


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
    _keep_programs(folder)
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


def _keep_programs(folder: Path) -> None:
    global _programs
    if _programs is None:
        jax.monitoring.register_event_listener(_hear_hit)
    _programs = folder


def _hear_hit(event: str, **_: str | int) -> None:
    if "cache_hits" in event:
        _hits.append(event)


def compiled(function, *arguments, **static) -> Callable:
    """`function.lower(*arguments, **static).compile()`, of a jitted function of one device that gives one array.

    With `keep_kernels`, a program is found by what it is traced from, without tracing it.
    """
    try:
        if _programs is None or jax.default_backend() != "cpu" or jax.process_count() > 1:
            raise _Unknown
        key = _key(function, arguments, static)
    except _Unknown:
        return _lowered(function, arguments, static).compile()
    if key not in _known:
        file = _programs / f"{key}.program"
        _known[key] = _read(file, arguments) or _made(file, function, arguments, static)
    return _known[key]


def _read(file: Path, arguments) -> Callable | None:
    """The program in a file; None: there is none that can be used."""
    try:
        content = file.read_bytes()
        os.utime(file)  # when it was last used
        return program_of_bytes(content, arguments, 0)
    except Exception:  # whatever XLA says of what it cannot read: the program is made anew
        return None


def _lowered(function, arguments, static):
    with without_collections():
        return function.lower(*arguments, **static)


def _made(file: Path, function, arguments, static) -> Callable:
    lowered, hits = _lowered(function, arguments, static), len(_hits)
    # JAX is not to keep the program too: XLA writes one that it has read without some of its functions.
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", float("inf"))
    try:
        program = lowered.compile()
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    if len(_hits) == hits:
        # Errors of a disk are an InputError, and XLA has its own where a program cannot be kept.
        with contextlib.suppress(Exception):
            content = bytes_of_program(program)
            write_whole(file, lambda out: out.write(content))
            _remove_oldest(file.parent)
    return program


def _remove_oldest(folder: Path) -> None:
    """Remove the programs that were used longest ago, beyond as many bytes as kernels have."""
    used = sorted(folder.glob("*.program"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for path in used:
        total += path.stat().st_size
        if total > _CACHE_BYTES:
            path.unlink(missing_ok=True)


class _Unknown(Exception):
    """Something of which another process cannot tell whether it has the same."""


def _key(function, arguments, static) -> str:
    """Hash of all that a program depends on.

    Raises:
        _Unknown: it depends on what is not pathjax's own, such as a kind of the user's.
    """
    leaves, tree = jax.tree.flatten(arguments)
    given = [(leaf.shape, str(leaf.dtype), getattr(leaf, "weak_type", False)) for leaf in leaves]
    chosen = sorted((name, str(value)) for name, value in jax.config.values.items())
    chosen += sorted((name, x) for name, x in os.environ.items() if name.startswith(("XLA_", "JAX_", "PATHJAX_")))
    versions = platform.python_version(), jax.__version__, jaxlib.__version__
    known = function.__module__, function.__qualname__, _told(static), _told_tree(tree), given
    code = hashlib.sha256(repr((known, chosen, versions, _sources())).encode())
    return code.hexdigest()[:32]


@functools.cache
def _sources() -> list[tuple]:
    """What tells whether the package is the same, as Python tells whether a module is the one that it has compiled."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    return [(str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files]


def _told_tree(tree) -> object:
    """A pytree's structure, in words that are the same in each process."""
    data = tree.node_data()
    return "*" if data is None else (_told(data), [_told_tree(child) for child in tree.children()])


def _told(x: object) -> object:
    if x is None or isinstance(x, bool | int | float | str):
        return repr(x)
    if isinstance(x, type):
        if x.__module__.partition(".")[0] not in ("pathjax", "builtins"):
            raise _Unknown
        return f"{x.__module__}.{x.__qualname__}"
    if isinstance(x, tuple | list):
        return [_told(type(x)), *map(_told, x)]
    if isinstance(x, dict):
        return [_told(list(pair)) for pair in x.items()]
    if is_dataclass(x):
        return [_told(type(x)), *(_told(getattr(x, f.name)) for f in fields(x))]
    raise _Unknown


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
