"""`python -m pathjax`."""

import gc
import os
import signal
import sys


def main() -> int:
    """Run the command line; handles Ctrl-C during imports, as importing JAX takes a while."""
    _open_streams()
    sys.stderr = _Messages(sys.stderr)
    try:
        _end_like_ctrl_c()
        from pathjax import cli

        gc.freeze()  # modules live to the end; collecting garbage among them, also at exit, takes a fifth of a second
        return cli.main()
    except KeyboardInterrupt:
        print("pathjax: interrupted; nothing was written", file=sys.stderr)
        return 1


def _open_streams() -> None:
    """Open stdin, stdout and stderr where they are closed (`>&-`): a file opened later would take their place."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    # Without a stderr, `print` would write to stdout.
    sys.stderr = sys.stderr or open(os.devnull, "w")


class _Messages:
    """Stderr that ignores errors: the work continues where messages cannot be written (full disk, closed terminal)."""

    def __init__(self, stream):
        self._stream = stream

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError:
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            pass


def _end_like_ctrl_c() -> None:
    """Handle `kill` and the end of the terminal like Ctrl-C."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


if __name__ == "__main__":
    sys.exit(main())
