"""Concurrent calls of one kernel."""

from __future__ import annotations

import threading
import time

import pytest

from pathjax.compile import calls_at_once, concurrently


def test_concurrent_calls_overlap_and_keep_their_order():
    together = threading.Barrier(calls_at_once())

    def square(x):
        together.wait(timeout=20)  # fails unless all threads call at once
        time.sleep(0.01 * (x % 2))
        return x * x

    items = range(6 * calls_at_once())
    assert list(concurrently(square, items)) == [(x, x * x) for x in items]


def test_concurrent_calls_take_few_items_ahead_and_end_when_closed():
    taken, begun, ended = [], [], []

    def call(x):
        begun.append(x)
        time.sleep(0.02)
        ended.append(x)

    results = concurrently(call, (taken.append(x) or x for x in range(1000)))
    next(results)
    results.close()
    assert len(taken) == 2 * calls_at_once() + 1
    assert sorted(begun) == sorted(ended)


def test_an_error_in_a_concurrent_call_is_raised_in_its_place():
    done = []
    with pytest.raises(ZeroDivisionError):
        for item, _ in concurrently(lambda x: 1 / (x - 3), range(10)):
            done.append(item)
    assert done == [0, 1, 2]
