"""The cores that this process may use."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

SMALL = 1 << 15  # so many primitives or faces are processed before threads have started


def cores() -> int:
    """Return the number of cores that this process may use, or of all cores if the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def over_cores(size: int) -> Iterator[Callable]:
    """Yield a `map` that runs its calls in threads, if NumPy works on arrays of at least SMALL rows (`size`).

    A mapped function must not use it again, and the caller must read all results.
    """
    if size < SMALL or cores() == 1:
        yield map
        return
    with ThreadPoolExecutor(cores()) as pool:
        yield pool.map
