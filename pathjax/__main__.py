"""`python -m pathjax`."""

import gc
import os
import signal
import sys


def main() -> int:
    """The command line; handles Ctrl-C during imports, for importing JAX takes a while."""
    _open_streams()
    sys.stderr = _Messages(sys.stderr)
    try:
        _end_like_ctrl_c()
        from pathjax import cli

        gc.freeze()  # modules live to the end; to search them for garbage, at exit too, takes a fifth of a second
        return cli.main()
    except KeyboardInterrupt:
        print("pathjax: interrupted; nothing was written", file=sys.stderr)
        return 1


def _open_streams() -> None:
    """Let no file of the work become stdin, stdout or stderr: it would where these are closed (`>&-`)."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    # Else what is printed there would go to stdout.
    sys.stderr = sys.stderr or open(os.devnull, "w")


class _Messages:
    """Stderr on which nothing fails: where nobody can hear a message (a full disk, a closed terminal) work goes on."""

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
    """Let `kill`, and the end of the terminal, keep what Ctrl-C keeps."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


if __name__ == "__main__":
    sys.exit(main())
