"""STL: binary and text, flat triangles. Stored normals are not read; the order of vertices gives the orientation.

A file that is long enough for the number of triangles at byte 80 is binary, even if it begins with "solid", as many
binary headers do: in a text file these bytes give a number that would need gigabytes.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.io.mesh.raw import Raw, plain_text

HEADER = 84
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
# The words of a facet; None is a number.
FACET = ["facet", "normal", *[None] * 3, "outer", "loop", *["vertex", *[None] * 3] * 3, "endloop", "endfacet"]


def read(path: Path) -> Raw:
    data = path.read_bytes()
    count = int.from_bytes(data[80:HEADER], "little")
    end = HEADER + count * TRIANGLE.itemsize
    if HEADER <= len(data) and end <= len(data):
        corners = np.frombuffer(data, TRIANGLE, count, HEADER)["corners"]
        behind = len(data) - end
        notes = (f"{behind} bytes behind its {count} triangles are not read",) if behind else ()
        return _separate(corners, notes)
    text = plain_text(data)
    if text.lstrip()[:5].lower() == b"solid" and b"\0" not in text:
        return _separate(_text_corners(path, text))
    if len(data) < HEADER:
        raise InputError(f'{path}: cannot be read as STL: it begins without "solid" and is too short to be binary')
    found = (len(data) - HEADER) // TRIANGLE.itemsize
    raise InputError(f"{path}: the file ends after {found} of {count} triangles")


def _text_corners(path: Path, text: bytes) -> np.ndarray:
    """Return (F, 3, 3) corners; the names after `solid` and `endsolid` may be anything."""
    words = re.sub(rb"(?mi)^[ \t]*(end[ \t]*)?solid\b.*$", b"", text).split()
    if len(words) % len(FACET):
        raise InputError(f"{path}: cannot be read as STL: facets have three vertices each, and {len(FACET)} words")
    for k, word in enumerate(FACET):
        for found in set(words[k :: len(FACET)]) if word else ():
            if found.lower() != word.encode():
                raise InputError(f'{path}: cannot be read as STL: "{found[:40].decode("latin-1")}" for "{word}"')
    places = [k for k, word in enumerate(FACET) if word is None][3:]
    try:
        columns = [np.array(words[k :: len(FACET)], np.float64) for k in places]
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as STL: {error}") from None
    return np.stack(columns, axis=1).reshape(-1, 3, 3)


def _separate(corners: np.ndarray, notes: tuple[str, ...] = ()) -> Raw:
    """Return triangles that share no vertices."""
    vertices = corners.reshape(-1, 3).astype(np.float64)
    return Raw(vertices, np.arange(len(vertices)), notes=notes)
