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

# Limit on the bytes of compiled kernels on disk, some 100 kB each; the least recently used are removed first.
_CACHE_BYTES = 1 << 28
# Fields of /proc/cpuinfo that determine which machine code a processor runs, on x86 and Arm.
_CPU_LINES = ("vendor_id", "cpu family", "model", "flags", "CPU implementer", "CPU part", "Features")
# JAX's events for kernels that it found on disk.
_hits: list[str] = []
# Folder of the kept programs, whose file names are their keys; None: no program is kept.
_programs: Path | None = None
# Programs that this process has compiled or loaded, by key.
_known: dict[str, Callable] = {}


def keep_kernels() -> None:
    """Let this process load the kernels that earlier processes compiled, and keep its own for later ones.

    For programs, not libraries: it sets JAX's persistent compilation cache to `pathjax` in the user's cache folder,
    and silences XLA's log, which mistakes a compiler's preferences for instructions that the processor lacks. The
    user's choices, in JAX's configuration or by `PATHJAX_CACHE=0`, take precedence. Without a writable folder, or on a
    full disk, nothing is kept, and JAX's warnings about that are silenced.
    Linux only: processors are not told apart on other systems, where XLA would load code that the processor cannot run.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache", UserWarning)
    chosen = "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir is not None
    if chosen or os.environ.get("PATHJAX_CACHE", "1") == "0" or sys.platform != "linux":
        return
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        folder = (base if base.is_absolute() else Path.home() / ".cache") / "pathjax" / _processor()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        str(folder).encode()  # XLA accepts only names in UTF-8
    except (OSError, RuntimeError, UnicodeError):  # RuntimeError: the home folder is unknown
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
        jax.monitoring.register_event_listener(_note_hit)
    _programs = folder


def _note_hit(event: str, **_: str | int) -> None:
    if "cache_hits" in event:
        _hits.append(event)


def compiled(function, *arguments, **static) -> Callable:
    """Return `function.lower(*arguments, **static).compile()` for a jitted one-device function that returns one array.

    After `keep_kernels`, a program that is known is looked up by a key, without tracing the function.
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
    """Return the program in a file; None: the file is missing or unusable."""
    try:
        content = file.read_bytes()
        os.utime(file)  # records the time of last use
        return program_of_bytes(content, arguments, 0)
    except Exception:  # any error of XLA's in reading it: the program is compiled again
        return None


def _lowered(function, arguments, static):
    with without_collections():
        return function.lower(*arguments, **static)


def _made(file: Path, function, arguments, static) -> Callable:
    lowered, hits = _lowered(function, arguments, static), len(_hits)
    # Keep JAX from caching the program, too: XLA omits some functions when it writes a program that it has loaded.
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", float("inf"))
    try:
        program = lowered.compile()
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    if len(_hits) == hits:
        # `write_whole` raises InputError on disk errors; XLA raises its own where a program cannot be serialised.
        with contextlib.suppress(Exception):
            content = bytes_of_program(program)
            write_whole(file, lambda out: out.write(content))
            _remove_oldest(file.parent)
    return program


def _remove_oldest(folder: Path) -> None:
    """Remove the least recently used programs beyond `_CACHE_BYTES`."""
    used = sorted(folder.glob("*.program"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for path in used:
        total += path.stat().st_size
        if total > _CACHE_BYTES:
            path.unlink(missing_ok=True)


class _Unknown(Exception):
    """An object that cannot be identified across processes."""


def _key(function, arguments, static) -> str:
    """Return a hash of everything that a program depends on.

    Raises:
        _Unknown: it depends on something outside pathjax, such as a kind defined by the user.
    """
    leaves, tree = jax.tree.flatten(arguments)
    given = [(leaf.shape, str(leaf.dtype), getattr(leaf, "weak_type", False)) for leaf in leaves]
    chosen = sorted((name, str(value)) for name, value in jax.config.values.items())
    chosen += sorted((name, x) for name, x in os.environ.items() if name.startswith(("XLA_", "JAX_", "PATHJAX_")))
    versions = platform.python_version(), jax.__version__, jaxlib.__version__
    known = function.__module__, function.__qualname__, _canonical(static), _canonical_tree(tree), given
    code = hashlib.sha256(repr((known, chosen, versions, _sources())).encode())
    return code.hexdigest()[:32]


@functools.cache
def _sources() -> str:
    """Return a hash of the path, time and size of each source file, by which Python knows compiled modules, too."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    told = [(str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files]
    return hashlib.sha256(repr(told).encode()).hexdigest()


def _canonical_tree(tree) -> object:
    """Return a pytree's structure as values whose `repr` is the same in each process."""
    data = tree.node_data()
    return "*" if data is None else (_canonical(data), [_canonical_tree(child) for child in tree.children()])


def _canonical(x: object) -> object:
    if x is None or isinstance(x, bool | int | float | str):
        return repr(x)
    if isinstance(x, type):
        if x.__module__.partition(".")[0] not in ("pathjax", "builtins"):
            raise _Unknown
        return f"{x.__module__}.{x.__qualname__}"
    if isinstance(x, tuple | list):
        return [_canonical(type(x)), *map(_canonical, x)]
    if isinstance(x, dict):
        return [_canonical(list(pair)) for pair in x.items()]
    if is_dataclass(x):
        return [_canonical(type(x)), *(_canonical(getattr(x, f.name)) for f in fields(x))]
    raise _Unknown


def _remove_halves(folder: Path) -> None:
    """Remove kernels that a full disk left incomplete: one without an `-atime` file keeps JAX from caching others."""
    with contextlib.suppress(OSError):
        for kernel in folder.glob("*-cache"):
            if not kernel.with_name(kernel.name.removesuffix("-cache") + "-atime").exists():
                kernel.unlink(missing_ok=True)


def _processor() -> str:
    """Return a name that is the same for processors that run the same machine code."""
    with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        first = [line for line in itertools.takewhile(str.strip, file) if line.partition("\t")[0] in _CPU_LINES]
    return f"{platform.machine()}-{hashlib.sha256(''.join(first).encode()).hexdigest()[:16]}"
