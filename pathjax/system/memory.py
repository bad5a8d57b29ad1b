"""How much memory there is, so that what does not fit is refused before it is begun; and how freed memory is kept."""

from __future__ import annotations

import ctypes
import os

import jax

from pathjax.errors import InputError

# Numbers of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
# Bytes: more that is freed goes back to the system.
MOST_KEPT = 1 << 26
# By which users choose themselves.
_CHOSEN = "GLIBC_TUNABLES", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "MALLOC_ARENA_MAX"


def keep_freed() -> None:
    """Let this process keep `MOST_KEPT` bytes of freed memory, where its C library is glibc and nobody chose otherwise.

    XLA allocates what a kernel needs at each call, and frees it. From 32 MiB on glibc gives that back to the system at
    once, and the next call waits until the system has cleared all pages: 50 ms of a gradient in a million numbers. One
    arena serves all threads, as arenas of their own have no room for that much.
    """
    if any(name in os.environ for name in _CHOSEN):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    for option, value in ((_ARENA_MAX, 1), (_MMAP_THRESHOLD, MOST_KEPT), (_TRIM_THRESHOLD, MOST_KEPT)):
        mallopt(option, value)


def limit() -> int | None:
    """Bytes of all memory where arrays live; None if nobody says."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        return (device.memory_stats() or {}).get("bytes_limit")
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # as on Windows
        return None


def check(needed: int, what: str, remedy: str) -> None:
    """Refuse `what` if it needs more bytes than there are."""
    there = limit()
    if there is not None and needed > there:
        raise InputError(f"{what} take {_text(needed)} of memory, and there are {_text(there)}; {remedy}")


def _text(count: int) -> str:
    return f"{count / 2**30:.3g} GiB"
