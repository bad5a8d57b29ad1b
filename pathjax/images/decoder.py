"""Reading of image files by OpenImageIO: format, size and stored values; every failure is an InputError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from pathjax.errors import InputError

MAX_PIXELS = 10**9
_FIRST_BYTES = {
    "OpenEXR": b"\x76\x2f\x31\x01",
    "Radiance HDR": b"#?",
    "PNG": b"\x89PNG\r\n\x1a\n",
    "JPEG": b"\xff\xd8\xff",
    "BMP": b"BM",
}
# Formats of linear values, for measurement; the others are for viewing.
LINEAR = ("OpenEXR", "Radiance HDR")


def file_format(path: str | Path) -> str:
    """Return "OpenEXR", "Radiance HDR", "PNG", "JPEG" or "BMP", by the file's first bytes, regardless of its name.

    A file that begins like none of them is "TGA", a format without magic bytes, if its name ends in .tga.

    Raises:
        InputError: the file does not exist, cannot be read, or has another format.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: {'not a file' if Path(path).exists() else 'no such file'}")
    try:
        with open(path, "rb") as file:
            start = file.read(8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    for name, first in _FIRST_BYTES.items():
        if start.startswith(first):
            return name
    if start and Path(path).suffix.lower() == ".tga":
        return "TGA"
    reason = "begins like another format" if start else "is empty"
    raise InputError(f"{path}: not supported, as it {reason}; use OpenEXR, Radiance HDR, PNG, JPEG, BMP or TGA")


class Unreadable(Exception):
    """A file cannot be read; the message says why, and what to do about it."""


@contextmanager
def opened(path: str | Path) -> Iterator:
    """Open a file by OpenImageIO; any failure, also in the `with` block, becomes an InputError that names the file."""
    import OpenImageIO

    found = file_format(path)
    how = OpenImageIO.ImageSpec()
    how.attribute("oiio:UnassociatedAlpha", 1)  # else colours of PNG would be multiplied by alpha
    with open(path, "rb") as file:
        try:
            name = str(path)
            if name.encode("utf-8", "ignore").decode() != name:  # OpenImageIO accepts only UTF-8 names
                name = f"/dev/fd/{file.fileno()}"
            image = OpenImageIO.ImageInput.open(name, how)
            reason = OpenImageIO.geterror()
            if image is None:
                remedy = "write all channels at full size" if "ubsampled" in reason else "it is damaged, write it anew"
                raise Unreadable(f"{reason}; {remedy}")
            yield image
        except Exception as error:  # also UnicodeDecodeError and others, depending on the file
            raise InputError(f"{path}: cannot be read as {found}: {' '.join(str(error).split())}") from None


def read_pixels(image, part: int, first: int, end: int, number) -> np.ndarray:
    """Read the channels first to end - 1 of one part as type `number`: (h, w, end - first)."""
    pixels = image.read_image(part, 0, first, end, number)
    reason = image.geterror()
    if pixels is None or reason:  # a truncated JPEG returns pixels and a reason
        raise Unreadable(f"{reason}; it is damaged, write it anew")
    return pixels


def require_size(spec) -> None:
    if max(spec.width * spec.height, spec.full_width * spec.full_height) > MAX_PIXELS:
        raise Unreadable(f"it has more than {MAX_PIXELS:.0e} pixels; scale it down")
