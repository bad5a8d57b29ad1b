"""Wavefront OBJ: polygons whose uv and normals have separate indices. Materials, points and lines are not read.

trimesh 5.2 counts negative indices from the end of the file rather than from the current line, reads index 0 as 1, and
silently drops the normals and uv of a file in which one index is wrong.

Large files have millions of lines, so NumPy processes the bytes of all lines at once.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn

import numpy as np

from pathjax.errors import InputError
from pathjax.io.mesh.polygons import enumerated
from pathjax.io.mesh.raw import Raw, numbers, plain_text

# Keyword of a line of numbers -> count it needs; a weight, a colour or a third uv coordinate may follow.
TABLES = {"v": 3, "vt": 1, "vn": 3}
FACE, OTHER, EMPTY = range(len(TABLES), len(TABLES) + 3)  # further kinds of lines

# Keywords of lines that say nothing about triangles, or draw points and lines.
WITHOUT_SURFACE = frozenset("o g s mg usemtl mtllib usemap maplib l p bevel c_interp d_interp lod".split())
KEYWORDS = frozenset(name.encode() for name in [*TABLES, "f", *WITHOUT_SURFACE])

NEWLINE, SLASH = b"\n/"
SPACE = np.zeros(256, bool)
SPACE[list(b" \t\v\f\n")] = True


def read(path: Path) -> Raw:
    """Read a file; corners with the same position, uv and normal become one vertex."""
    text = _logical_lines(plain_text(path.read_bytes()) + b"\n")
    data = np.frombuffer(text, np.uint8).copy()
    lines = np.diff(np.flatnonzero(data == NEWLINE), prepend=-1)
    kind, words = _keywords(path, text, data, lines)
    try:
        tables = [_table(data[np.repeat(kind == k, lines)], words[kind == k], n) for k, n in enumerate(TABLES.values())]
        corners = _corners(data[np.repeat(kind == FACE, lines)], words[kind == FACE])
    except ValueError:
        _refuse(path, text)

    sizes = words[kind == FACE]
    for k, (name, table) in enumerate(zip(TABLES, tables, strict=True)):
        said = corners[:, k].copy()
        above = np.repeat(np.cumsum(kind == k)[kind == FACE], sizes)  # rows of the table above the line
        corners[:, k] += np.where(said < 0, above + 1, 0)
        beyond = np.flatnonzero((said != 0) & ((corners[:, k] < 1) | (corners[:, k] > len(table))))
        if beyond.size:
            line = np.repeat(np.flatnonzero(kind == FACE), sizes)[beyond[0]] + 1
            raise InputError(f"{path}:{line}: {name} {said[beyond[0]]} does not exist; there are {len(table)}")

    rows, corners = _distinct(corners)
    vertices, uv, normals = (_picked(table, rows[:, k]) for k, table in enumerate(tables))
    if vertices is None:
        vertices = tables[0]
    lacking = 0 if uv is None else np.count_nonzero(rows[:, 1] == 0)
    notes = (f"{lacking} vertices without texture coordinates got (0, 0)",) if lacking else ()
    return Raw(vertices, corners, sizes, normals, uv, notes=notes)


def _logical_lines(text: bytes) -> bytes:
    """Remove comments and join continued lines, after which empty lines are added to keep the line numbers.

    A line that ends in a backslash is continued, unless the next line begins with a keyword, as names of materials and
    groups may end in a backslash too.
    """
    text = re.sub(rb"#(?<!\.#)[^\n]*", b"", text)  # not "1.#IND", as some programs write NaN
    if b"\\\n" not in text:
        return text
    joined: list[bytes] = []
    for line in text.split(b"\n"):
        above = joined[-1].rstrip(b"\n") if joined else b""
        if not above.endswith(b"\\"):
            joined.append(line)
            continue
        empty = joined[-1][len(above) :]
        if any(word in KEYWORDS for word in line.split(maxsplit=1)[:1]):
            joined[-1:] = above[:-1] + empty, line
        else:
            joined[-1] = above[:-1] + b" " + line + empty + b"\n"
    return b"\n".join(joined)


def _keywords(path: Path, text: bytes, data: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (L,) kinds of the lines and (L,) counts of words after the keyword, which is blanked in `data`."""
    starts, ends = np.flatnonzero(_word_starts(SPACE[data])), np.cumsum(lines)
    words = np.diff(np.searchsorted(starts, ends), prepend=0)
    filled = np.flatnonzero(words)
    first = starts[(np.cumsum(words) - words)[filled]]
    kind = np.full(len(lines), EMPTY, np.int8)
    kind[filled] = OTHER
    for k, name in enumerate([*TABLES, "f"]):
        here = SPACE[data[np.minimum(first + len(name), len(data) - 1)]]
        for place, letter in enumerate(name.encode()):
            here &= data[np.minimum(first + place, len(data) - 1)] == letter
        kind[filled[here]] = k
    for line, at in zip(filled[kind[filled] == OTHER], first[kind[filled] == OTHER], strict=True):
        word = text[at : ends[line]].split(maxsplit=1)[0].decode("latin-1")
        if word not in WITHOUT_SURFACE:
            raise InputError(f'{path}:{line + 1}: "{word[:20]}" is not supported')
    data[first] = data[first + 1] = ord(" ")
    return kind, np.maximum(words - 1, 0)


def _word_starts(space: np.ndarray) -> np.ndarray:
    starts = ~space
    starts[1:] &= space[:-1]
    return starts


def _table(data: np.ndarray, words: np.ndarray, needed: int) -> np.ndarray:
    """Return the first three numbers of each line, or the first two for uv, whose second defaults to 0."""
    values = numbers(data.tobytes(), np.float64)
    if len(values) != words.sum() or (words < needed).any():
        raise ValueError
    width = max(needed, 2)
    table = np.append(values, 0.0)[(np.cumsum(words) - words)[:, None] + np.arange(width)]
    table[words < width, 1:] = 0
    return table


def _corners(data: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return (C, 3) indices of the corners as written, `v`, `v/vt`, `v//vn` or `v/vt/vn`; 0: none."""
    space, slash = SPACE[data], data == SLASH
    starts = _word_starts(space)
    fields = starts.copy()  # a field begins at the start of a word and after a slash
    fields[1:] |= slash[:-1]
    fields = np.flatnonzero(fields)
    filled = ~(space | slash)[fields]
    data[slash] = ord(" ")
    values = numbers(data.tobytes(), np.int64)
    sizes = np.diff(np.flatnonzero(starts[fields]), append=len(fields))  # fields of each word
    if len(values) != filled.sum() or (values == 0).any() or (sizes > len(TABLES)).any() or (words < 3).any():
        raise ValueError
    word, place = enumerated(sizes)
    if not filled[place == 0].all():
        raise ValueError
    corners = np.zeros((len(sizes), len(TABLES)), np.int64)
    corners[word[filled], place[filled]] = values
    return corners


def _distinct(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (K, 3) unique rows of (C, 3), in order of appearance, and (C,) the index into them for each row."""
    key = corners[:, 0]
    for column in corners.T[1:]:
        if column.any():
            key = np.unique(key, return_inverse=True)[1] * (column.max() + 1) + column
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[which]


def _picked(table: np.ndarray, rows: np.ndarray) -> np.ndarray | None:
    """Return rows of a table, counted from 1; zeros for row 0; None if all rows are 0."""
    return np.concatenate([np.zeros((1, table.shape[1])), table])[rows] if rows.any() else None


def _refuse(path: Path, text: bytes) -> NoReturn:
    """Raise an InputError that names the faulty line."""
    for number, line in enumerate(text.decode("latin-1").split("\n"), start=1):
        name, *words = line.split() or [""]
        try:
            if name in TABLES:
                if len([float(word) for word in words]) < TABLES[name]:
                    raise ValueError(f"{name} has too few numbers")
            elif name == "f":
                for word in words:
                    parts = word.split("/")
                    if len(parts) > len(TABLES) or not parts[0]:
                        raise ValueError(f'"{word[:40]}" is no corner of a face')
                    if 0 in [int(part) for part in parts if part]:
                        raise ValueError(f'"{word[:40]}" has the index 0; indices count from 1')
                if len(words) < 3:
                    raise ValueError(f"a face of {len(words)} vertices")
        except ValueError as error:
            raise InputError(f"{path}:{number}: {error}") from None
    raise InputError(f"{path}: cannot be read as OBJ: a line holds something that is not a number")
