"""Calls of one kernel beside each other, each on a thread of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax

from pathjax.compile.promotion import usual_promotion


def calls_at_once() -> int:
    """How many calls of one kernel run at a time: on CPUs, where a call keeps its thread, one for each device."""
    return len(jax.local_devices()) if jax.default_backend() == "cpu" else 1


def devices_of_a_call() -> int:
    """`devices` of `native_map` in a kernel for `concurrently`: one of a CPU runs on the thread that calls it."""
    return 1 if jax.default_backend() == "cpu" else len(jax.local_devices())


def concurrently(f: Callable, items: Iterable) -> Iterator[tuple]:
    """Pairs (item, f(item)) in the order of the items, `calls_at_once` of them at a time, each in a thread of its own.

    So no device waits for another, nor for what is done with the results. Of the items, a few more are taken than
    results are given. Closed early, it waits for the calls that run.
    """
    workers = calls_at_once()
    waiting: deque[tuple] = deque()
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
