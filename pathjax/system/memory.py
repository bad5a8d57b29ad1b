"""The size of memory, to refuse work that does not fit before it begins."""

from __future__ import annotations

import os

import jax

from pathjax.errors import InputError


def limit() -> int | None:
    """Return the bytes of memory of the device that holds arrays; None: unknown."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        return (device.memory_stats() or {}).get("bytes_limit")
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # as on Windows
        return None


def check(needed: int, what: str, remedy: str) -> None:
    """Refuse `what` if it needs more bytes than there are.

    Raises:
        InputError: it does not fit.
    """
    there = limit()
    if there is not None and needed > there:
        raise InputError(f"{what} take {_text(needed)} of memory, and there are {_text(there)}; {remedy}")


def _text(count: int) -> str:
    return f"{count / 2**30:.3g} GiB"
