"""Signals that ask the program to end: Ctrl-C, `kill` and a closed terminal. The whole package hears them here.

Work that must not be left half done stands within `Interrupts`, where signals are only noted; parts of it that may
be given up stand within its `raised`. What cannot be stopped, since it runs in XLA, is waited for by `wait_for`; so is
what takes long in Python, as an exception that is raised while Python collects garbage is lost.
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
# Not every system has the one of a closed terminal.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Set at the end of calls that `wait_for` began. (A thread whose `join` was interrupted is said to be dead, in 3.11.)
_ends: list[threading.Event] = []


class Interrupts:
    """Within it signals are noted, however many come, and nothing else happens.

    In other threads than the main one, where Python hears no signals, and for signals that the process ignores it does
    nothing.
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
        """For a part of the work that may be given up: a signal raises KeyboardInterrupt, also one that came before."""
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
    """Return the call's result, or raise KeyboardInterrupt as soon as a signal does, while the call itself goes on.

    It goes on in a thread of its own, so the program must end by `leave`.
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
    """Return a program's exit status; or end it, if a call that it no longer waits for goes on, or `at_once`.

    XLA aborts the process if the interpreter ends under such a call.
    """
    if at_once or not all(end.is_set() for end in _ends):
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os._exit(status)
    return status
