"""What a mesh file says, as the readers of the formats return it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Raw:
    """Polygons in the file's own space. `load` checks that indices and numbers are sound."""

    vertices: np.ndarray  # (V, 3) float64
    corners: np.ndarray  # (C,) int64, the vertices of the polygons, one polygon after the other
    sizes: np.ndarray | None = None  # (F,) int64, corners of each polygon; None: triangles
    normals: np.ndarray | None = None  # (V, 3); a row of zeros: this vertex has none
    uv: np.ndarray | None = None  # (V, 2), v as the file has it
    notes: tuple[str, ...] = ()
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)  # "vertex_*" (V, 3), "face_*" (F, 3)


def plain_text(data: bytes) -> bytes:
    """Text in which lines end in a line feed alone, without byte order mark; UTF-16 becomes UTF-8."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16").encode()
    return data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def numbers(text: bytes, dtype: type) -> np.ndarray:
    """(N,) what is written in `text`, between white space.

    Raises:
        ValueError: a word is no number. (Two numbers without a space between them, "1-2", are read as two.)
    """
    if not text.strip():
        return np.zeros(0, dtype)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's word for text that it read in part
            return np.fromstring(text, dtype, sep=" ")
    except DeprecationWarning:
        raise ValueError("not a number") from None
