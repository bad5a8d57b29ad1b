"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from pathjax.errors import InputError


def write_text(path: str | Path, text: str) -> None:
    write_whole(Path(path), lambda file: file.write(encodable(text).encode()))


def encodable(text: str, encoding: str = "utf-8") -> str:
    r"""Return the text with \escapes for characters that the encoding lacks, such as non-UTF-8 bytes of file names."""
    return text.encode(encoding, "backslashreplace").decode(encoding)


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a file beside `path`, then move it to `path`: readers of `path` never see an incomplete file.

    Raises:
        InputError: the file cannot be written; `path` is unchanged.
    """
    with _beside(path) as beside:
        with open(beside, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())  # quotas and network disks may refuse only here
        os.replace(beside, path)


def check_writable(path: str | Path, sources: Iterable[str | Path] = ()) -> None:
    """Raise before the work the errors that `write_whole` would raise after it, as far as they can be known.

    Args:
        sources: files that must not be overwritten.
    Raises:
        InputError: the folder is missing or not writable, or `path` is too long a name, a folder, a read-only file or a
            source.
    """
    path = Path(path)
    with _beside(path) as beside:
        beside.touch()
        for source in sources:
            if os.path.realpath(path) == os.path.realpath(source):
                raise InputError(f"{path}: is read by the same command; name another file to write")


def check_room(folder: Path) -> None:
    """Check that a file of one page can be written in a folder; whether more fits is known only when the disk is full.

    Raises:
        InputError: it cannot be written.
    """
    probe = folder / f".{os.getpid()}.part"
    try:
        try:
            with open(probe, "wb") as file:
                file.write(bytes(1 << 12))
                file.flush()
                os.fsync(file.fileno())
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: nothing can be written there: {error.strerror or error}") from None


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; any failure to write becomes an InputError that names `path`."""
    try:
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}; make it first")
        if path.is_dir():
            raise InputError(f"{path}: is a folder; name a file")
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError(f"{path}: is read-only; name another file, or delete it")
        beside = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            yield beside
        finally:
            with contextlib.suppress(OSError):
                beside.unlink()
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError) as error:  # ValueError: a name that the system cannot encode
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None
