"""Mitsuba's `serialized` meshes: several compressed streams in a file, with their offsets in a table at its end.

The format (Mitsuba's documentation of the plugin): every mesh begins with an identifier and a version, 3 or 4, followed
by a zlib stream of flags, a name (version 4), counts, positions, normals, uv, colours and triangles.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.io.mesh.raw import Raw

_IDENTIFIER = 0x041C
_NORMALS, _UV, _COLORS, _DOUBLE = 0x0001, 0x0002, 0x0008, 0x2000  # Mitsuba ignores other flags
_LONGEST_NAME = 1 << 12
# Compressed bytes per step, and the most decompressed bytes per step.
_BLOCK, _LARGEST_PIECE = 1 << 16, 1 << 24


def read(path: Path, part: int = 0) -> Raw:
    """Read mesh number `part`, counting from 0. Colours are ignored, as in Mitsuba."""
    data = path.read_bytes()
    version = _version(path, data, 0)
    start = _start(path, data, version, part) if part else 0
    version = _version(path, data, start)
    stream = _Stream(path, memoryview(data)[start + 4 :])
    (flags,) = struct.unpack("<I", stream.take(4))
    if version == 4:
        stream.pass_text()
    vertex_count, face_count = struct.unpack("<QQ", stream.take(16))
    real = np.dtype("<f8" if flags & _DOUBLE else "<f4")
    index = np.dtype("<u4" if vertex_count <= 0xFFFFFFFF else "<u8")
    vertices = stream.array(real, vertex_count, 3)
    normals = stream.array(real, vertex_count, 3) if flags & _NORMALS else None
    uv = stream.array(real, vertex_count, 2) if flags & _UV else None
    if flags & _COLORS:
        stream.take(3 * vertex_count * real.itemsize)
    corners = stream.array(index, face_count, 3).ravel().astype(np.int64)
    return Raw(vertices.astype(np.float64), corners, None, normals, uv)


class _Stream:
    """A zlib stream that is decompressed on demand, piece by piece."""

    def __init__(self, path: Path, packed: memoryview):
        self.path, self.packed = path, packed
        self.unpacker = zlib.decompressobj()

    def take(self, count: int) -> bytes:
        pieces, lacking = [], count
        while lacking and not self.unpacker.eof:
            waiting = self.unpacker.unconsumed_tail
            if not waiting:
                waiting, self.packed = self.packed[:_BLOCK], self.packed[_BLOCK:]
            try:
                piece = self.unpacker.decompress(waiting, min(lacking, _LARGEST_PIECE))
            except zlib.error:
                raise InputError(f"{self.path}: cannot be read as SERIALIZED: a compressed stream is damaged") from None
            if not piece and not len(waiting):
                break
            pieces.append(piece)
            lacking -= len(piece)
        if lacking:
            raise InputError(f"{self.path}: cannot be read as SERIALIZED: a mesh ends before its numbers do")
        return b"".join(pieces)

    def array(self, dtype: np.dtype, rows: int, columns: int) -> np.ndarray:
        return np.frombuffer(self.take(rows * columns * dtype.itemsize), dtype).reshape(-1, columns)

    def pass_text(self) -> None:
        for _ in range(_LONGEST_NAME):
            if self.take(1) == b"\0":
                return
        raise InputError(f"{self.path}: cannot be read as SERIALIZED: the name of a mesh does not end")


def _version(path: Path, data: bytes, start: int) -> int:
    identifier, version = struct.unpack_from("<HH", data, start) if start + 4 <= len(data) else (0, 0)
    if identifier != _IDENTIFIER:
        raise InputError(f"{path}: cannot be read as SERIALIZED: there is no mesh at byte {start}")
    if version not in (3, 4):
        raise InputError(f"{path}: is of version {version} of the serialized format; 3 and 4 are supported")
    return version


def _start(path: Path, data: bytes, version: int, part: int) -> int:
    """Return the byte at which a mesh begins, from the table at the end."""
    (count,) = struct.unpack("<I", data[-4:])
    place = np.dtype("<u8" if version == 4 else "<u4")
    if count == 0 or 4 + count * place.itemsize > len(data):
        raise InputError(f"{path}: cannot be read as SERIALIZED: it does not end in the table of its meshes")
    if part >= count:
        raise InputError(f"{path}: holds {count} meshes, 0 to {count - 1}; there is no shape_index {part}")
    return int(np.frombuffer(data, place, count, len(data) - 4 - count * place.itemsize)[part])
