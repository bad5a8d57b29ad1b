"""The cores that this process may use."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

SMALL = 1 << 15  # as many primitives or faces are done before threads have begun


def cores() -> int:
    """Return the number of cores that this process may use; of all, if the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def over_cores(size: int) -> Iterator[Callable]:
    """`map` whose calls go on beside each other, in threads, where NumPy works on arrays of at least SMALL rows.

    What is mapped must not map anything itself, and all results must be asked for.
    """
    if size < SMALL or cores() == 1:
        yield map
        return
    with ThreadPoolExecutor(cores()) as pool:
        yield pool.map
