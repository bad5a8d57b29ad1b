"""Output of a command: files, results on stdout, messages on stderr. A failure of one does not affect the others."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

from pathjax.system.files import encodable


def say(message: str) -> None:
    print(_encodable_on(sys.stderr, f"pathjax: {message}"), file=sys.stderr)


def _encodable_on(stream: TextIO | None, text: str) -> str:
    return encodable(text, getattr(stream, "encoding", None) or "utf-8")


class Output:
    """The output of one command; `written`: a file was written; `failed`: something could not be written as asked."""

    def __init__(self) -> None:
        self.failed = self.written = False
        self._moved: dict[Path, Path] = {}

    def file(self, path: str | Path, write: Callable[[Path], object]) -> Path | None:
        """Let `write` create the file `path`, or, if that fails, a file elsewhere, which a message names.

        Args:
            write: creates the file that it is given, completely or not at all, or raises.
        Returns:
            path of the file; None: it could not be written anywhere.
        """
        path, problems = Path(path), []
        for place in self._places(path):
            try:
                write(place)
            except Exception as error:  # any error: the work is done and must not be lost
                problems.append(str(error) or type(error).__name__)
                continue
            self.written = True
            if problems:
                self.failed, self._moved[path] = True, place
                say(f"{problems[0]}; {place} was written instead")
            return place
        self.failed = True
        say(f"{'; '.join(problems)}; it is lost")
        return None

    def _places(self, path: Path) -> Iterator[Path]:
        """Yield `path`, its earlier replacement, a new name in the current folder, one in a temporary folder."""
        yield path
        if path in self._moved:
            yield self._moved[path]
        with contextlib.suppress(OSError):  # the current folder may be gone
            here, numbers = Path.cwd() / path.name, itertools.count(1)
            while here.exists():
                here = here.with_name(f"{path.stem}-{next(numbers)}{path.suffix}")
            yield here
        with contextlib.suppress(OSError):
            folder = Path(tempfile.mkdtemp(prefix="pathjax-"))
            yield folder / path.name
            folder.rmdir()  # resumed: writing failed there, too

    def text(self, text: str) -> None:
        """Print a result on stdout."""
        try:
            if sys.stdout is None:
                raise OSError(errno.EBADF, "it is closed")
            print(_encodable_on(sys.stdout, text), flush=True)
        except OSError as error:
            self.failed = True
            # A reader that stops early, such as `head`, needs no message.
            if not isinstance(error, BrokenPipeError):
                say(f"stdout cannot be written: {error.strerror or error}")
            if sys.stdout is not None:
                # Flushing the rest of its buffer must not fail again when Python exits.
                with open(os.devnull, "w") as nowhere:
                    os.dup2(nowhere.fileno(), sys.stdout.fileno())
