"""Signals that ask the program to end, held back while work is finished."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# Ctrl-C, `kill`, and a terminal that was closed, which not every system knows.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Interrupts:
    """Within it the signals are only noted, so that no work is left half done; a second one acts as ever.

    In other threads than the main one, where Python hears no signals, and for signals that the process ignores it does
    nothing.
    """

    heard = False
    _raises = False

    def __enter__(self):
        self._earlier = {}
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._earlier[number] = signal.signal(number, self._hear)
        return self

    @contextmanager
    def let_through(self) -> Iterator[None]:
        """For a part of the work that may be given up: a signal raises KeyboardInterrupt, also one heard before."""
        self._raises = True
        try:
            if self.heard:
                raise KeyboardInterrupt
            yield
        finally:
            self._raises = False

    def _hear(self, number, frame):
        self.heard = True
        self._restore()
        if self._raises:
            raise KeyboardInterrupt

    def __exit__(self, *_):
        self._restore()

    def _restore(self):
        while self._earlier:
            number, handler = self._earlier.popitem()
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
