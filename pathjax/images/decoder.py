"""Image files as OpenImageIO reads them: their format, size and stored numbers; what goes wrong is an InputError."""

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
# Formats of linear numbers, which are measured; the others are looked at.
LINEAR = ("OpenEXR", "Radiance HDR")


def file_format(path: str | Path) -> str:
    """Return "OpenEXR", "Radiance HDR", "PNG", "JPEG" or "BMP", by the file's first bytes, whatever its name says.

    What begins like none of them is "TGA", which has no mark of its own, if it is named so.

    Raises:
        InputError: no such file, no right to read it, or another format.
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
    """The file as OpenImageIO has it; whatever goes wrong with it is an InputError that names it."""
    import OpenImageIO

    found = file_format(path)
    how = OpenImageIO.ImageSpec()
    how.attribute("oiio:UnassociatedAlpha", 1)  # else colours of PNG would be multiplied by it
    with open(path, "rb") as file:
        try:
            name = str(path)
            if name.encode("utf-8", "ignore").decode() != name:  # OpenImageIO takes no other bytes
                name = f"/dev/fd/{file.fileno()}"
            image = OpenImageIO.ImageInput.open(name, how)
            reason = OpenImageIO.geterror()
            if image is None:
                remedy = "write all channels at full size" if "ubsampled" in reason else "it is damaged, write it anew"
                raise Unreadable(f"{reason}; {remedy}")
            yield image
        except Exception as error:  # also UnicodeDecodeError and others, as the file's bytes have it
            raise InputError(f"{path}: cannot be read as {found}: {' '.join(str(error).split())}") from None


def read_pixels(image, part: int, first: int, end: int, number) -> np.ndarray:
    """(h, w, end - first) of one part as `number`."""
    pixels = image.read_image(part, 0, first, end, number)
    reason = image.geterror()
    if pixels is None or reason:  # a JPEG that is cut off gives both
        raise Unreadable(f"{reason}; it is damaged, write it anew")
    return pixels


def require_size(spec) -> None:
    if max(spec.width * spec.height, spec.full_width * spec.full_height) > MAX_PIXELS:
        raise Unreadable(f"it has more than {MAX_PIXELS:.0e} pixels; scale it down")
