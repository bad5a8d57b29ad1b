"""What a command hands over: files, results on stdout, messages on stderr. None that fails costs the others."""

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
    """The output of one command; `written` once a file is, `failed` once something could not go where it should."""

    def __init__(self) -> None:
        self.failed = self.written = False
        self._moved: dict[Path, Path] = {}

    def file(self, path: str | Path, write: Callable[[Path], object]) -> Path | None:
        """Let `write` make a file of what was computed: `path`, or where that fails one beside, which a message names.

        Args:
            write: makes the file it is given, whole or not at all, or raises.
        Returns:
            where it is; None: nowhere.
        """
        path, problems = Path(path), []
        for place in self._places(path):
            try:
                write(place)
            except Exception as error:  # whatever it is, the work is done and must not be lost
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
        """`path`; where it went before; a new name in the current folder; one in the folder for temporary files."""
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
            folder.rmdir()  # asked for more: it failed there, too

    def text(self, text: str) -> None:
        """Print a result on stdout."""
        try:
            if sys.stdout is None:
                raise OSError(errno.EBADF, "it is closed")
            print(_encodable_on(sys.stdout, text), flush=True)
        except OSError as error:
            self.failed = True
            # A reader such as `head` that has enough is no news.
            if not isinstance(error, BrokenPipeError):
                say(f"stdout cannot be written: {error.strerror or error}")
            if sys.stdout is not None:
                # What is left in its buffer must not fail again when Python ends.
                with open(os.devnull, "w") as nowhere:
                    os.dup2(nowhere.fileno(), sys.stdout.fileno())
