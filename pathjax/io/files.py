"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pathjax.errors import InputError


def write_text(path: str | Path, text: str) -> None:
    write_whole(Path(path), lambda beside: Path(beside).write_text(text, encoding="utf-8"))


def write_whole(path: Path, write: Callable[[str], None]) -> None:
    """Let `write` fill a file beside `path`, then put it in its place: who reads `path` never sees half a file."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(str(beside))
        os.replace(beside, path)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written: {error}") from None
    finally:
        beside.unlink(missing_ok=True)
