"""Signals that ask the program to end: Ctrl-C, `kill` and a closed terminal. The whole package handles them here.

Work that must not be left half done runs within `Interrupts`, where signals are only noted; parts of it that may be
abandoned run within its `raised`. Calls that cannot be stopped, since they run in XLA, go through `wait_for`; so do
long calls in Python, as an exception that is raised during garbage collection is lost.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, TypeVar

R = TypeVar("R")
# Not every system has SIGHUP, the signal of a closed terminal.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Events that are set at the end of the calls of `wait_for`. (In 3.11 a thread whose `join` was interrupted counts as
# dead.)
_ends: list[threading.Event] = []


class Interrupts:
    """Context in which signals, however many come, are only noted.

    It does nothing in threads other than the main one, where Python handles no signals, and for signals that the
    process ignores.
    """

    heard = False  # whether a signal came, also to an `Interrupts` around or within this one
    _raises = False

    def __enter__(self) -> Interrupts:
        self._earlier: dict[int, Callable | int | None] = {}
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._earlier[number] = signal.signal(number, self._note)
        owners = [getattr(handler, "__self__", None) for handler in self._earlier.values()]
        self._around = [owner for owner in owners if isinstance(owner, Interrupts)]
        self.heard = any(around.heard for around in self._around)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for around in self._around:
            around.heard |= self.heard

    @contextmanager
    def raised(self) -> Iterator[None]:
        """Context for work that may be abandoned: a signal, also an earlier one, raises KeyboardInterrupt."""
        self._raises = True
        try:
            if self.heard:
                raise KeyboardInterrupt
            yield
        finally:
            self._raises = False

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.heard = True
        if self._raises:
            raise KeyboardInterrupt


def wait_for(call: Callable[[], R]) -> R:
    """Return the call's result, or raise KeyboardInterrupt as soon as a signal does, while the call continues.

    The call runs in a thread of its own, so the program must end by `leave`.
    """
    outcome: list[tuple[bool, Any]] = []
    end = threading.Event()

    def work() -> None:
        try:
            outcome.append((True, call()))
        except BaseException as error:
            outcome.append((False, error))
        end.set()

    _ends.append(end)
    threading.Thread(target=work, daemon=True).start()
    while not end.wait(0.1):
        pass
    succeeded, result = outcome[0]
    if not succeeded:
        raise result
    return result


def leave(status: int, at_once: bool = False) -> int:
    """Return a program's exit status, or end the process with it if `at_once` or if a call of `wait_for` still runs.

    XLA aborts the process if the interpreter ends during such a call.
    """
    if at_once or not all(end.is_set() for end in _ends):
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os._exit(status)
    return status
