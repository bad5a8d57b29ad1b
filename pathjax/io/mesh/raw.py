"""The contents of a mesh file, which the readers of all formats return."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Raw:
    """Polygons in the file's own space. `load` checks indices, vertices, normals and uv."""

    vertices: np.ndarray  # (V, 3) float64
    corners: np.ndarray  # (C,) int64 vertex indices of the polygons, one polygon after the other
    sizes: np.ndarray | None = None  # (F,) int64 number of corners of each polygon; None: triangles
    normals: np.ndarray | None = None  # (V, 3); a row of zeros: this vertex has no normal
    uv: np.ndarray | None = None  # (V, 2), v as in the file
    notes: tuple[str, ...] = ()
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)  # "vertex_*" (V, 3), "face_*" (F, 3)


def plain_text(data: bytes) -> bytes:
    """Convert line ends to line feeds and UTF-16 to UTF-8, and remove the byte order mark."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16").encode()
    return data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def numbers(text: bytes, dtype: type) -> np.ndarray:
    """Parse (N,) numbers separated by white space.

    Raises:
        ValueError: a word is not a number. (Two numbers without a space between them, "1-2", are read as two.)
    """
    if not text.strip():
        return np.zeros(0, dtype)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # given by NumPy for text that it can parse only in part
            return np.fromstring(text, dtype, sep=" ")
    except DeprecationWarning:
        raise ValueError("not a number") from None
