"""Concurrent calls of one kernel, each on a thread of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax

from pathjax.compile.promotion import standard_promotion


def calls_at_once() -> int:
    """Return how many calls of one kernel run at a time: one per device on CPUs, where a call occupies its thread."""
    return len(jax.local_devices()) if jax.default_backend() == "cpu" else 1


def devices_of_a_call() -> int:
    """Return `devices` of `native_map` in a kernel for `concurrently`: 1 on CPUs, as it runs on the calling thread."""
    return 1 if jax.default_backend() == "cpu" else len(jax.local_devices())


def concurrently(f: Callable, items: Iterable) -> Iterator[tuple]:
    """Yield pairs (item, f(item)) in the order of the items, running `calls_at_once` calls, each in its own thread.

    So no device waits for another, nor for the consumer of the results. It takes up to 2 `calls_at_once` more items
    than it has yielded results. Closed early, it cancels the calls that have not begun and waits for those that run.
    """
    workers = calls_at_once()
    waiting: deque[tuple] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append((item, pool.submit(standard_promotion(f), item)))
                # Per thread, one that runs and one that is ready.
                if len(waiting) > 2 * workers:
                    done, result = waiting.popleft()
                    yield done, result.result()
            while waiting:
                done, result = waiting.popleft()
                yield done, result.result()
        finally:
            for _, result in waiting:
                result.cancel()
