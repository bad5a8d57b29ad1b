"""PLY: text, and binary of either byte order, with polygons of any size or triangle strips.

The format (Turk 1994, "The PLY polygon file format"): a header declares elements and the types of their properties;
the data follows. trimesh 5.2 reads rows of differing lengths wrongly or not at all.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.io.mesh.polygons import enumerated, strips
from pathjax.io.mesh.raw import Raw, numbers

# Type codes of NumPy and `struct`.
TYPES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q"},
    **{"uint64": "Q", "float16": "e", "float32": "f", "float64": "d"},
}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# Suffixes of the channels of an attribute: those of COLORS are whole names, the others follow a stem.
COLORS = ("r", "red")
CHANNELS = (("r", "g", "b"), ("red", "green", "blue"), ("_r", "_g", "_b"), ("_x", "_y", "_z"), ("_0", "_1", "_2"))
UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))


@dataclass(frozen=True)
class _Element:
    """An element as the header declares it, and its columns by name after they are read."""

    name: str
    rows: int
    text: bool  # the file is text, whose numbers were converted to doubles
    types: dict[str, tuple[str, str | None]] = field(default_factory=dict)  # type of the numbers; of a list's length
    columns: dict[str, np.ndarray] = field(default_factory=dict)  # (rows,); for lists, all their numbers concatenated
    lengths: dict[str, np.ndarray] = field(default_factory=dict)  # (rows,) lengths of lists

    def layout(self) -> list[tuple[str, str, str | None]]:
        """Return name, type code of the numbers and type code of a list's length, as in the bytes to be read."""
        each = [(name, *codes) for name, codes in self.types.items()]
        return [(name, "=d", length and "=d") for name, _, length in each] if self.text else each


def read(path: Path) -> Raw:
    data = path.read_bytes()
    elements, at, text = _header(path, data)
    if text:
        try:
            data, at = numbers(data[at:], np.float64).tobytes(), 0
        except ValueError:
            raise InputError(f"{path}: after the header there is something that is not a number") from None
    for element in elements.values():
        at = _read_rows(path, data, at, element)
    if data[at:].strip(b"" if text else b"\0 \t\r\n"):
        raise InputError(f"{path}: {len(data) - at} bytes are left behind the last element that the header describes")

    vertex = elements.get("vertex", _Element("vertex", 0, text))
    uv = next((names for names in UV if vertex.types.keys() >= set(names)), None)
    corners, sizes = _faces(path, elements)
    return Raw(
        _table(path, vertex, ("x", "y", "z")),
        corners,
        sizes,
        _table(path, vertex, ("nx", "ny", "nz")) if "nx" in vertex.types else None,
        _table(path, vertex, uv) if uv else None,
        *_attributes(elements),
    )


def _header(path: Path, data: bytes) -> tuple[dict[str, _Element], int, bool]:
    """Return the elements in order, the byte at which their data begins, and whether the data is text."""
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not start:
        raise InputError(f'{path}: cannot be read as PLY: the first line is not "ply"')
    end = re.compile(rb"%b[ \t]*end_header[ \t]*(%b|\Z)" % (start[1], start[1])).search(data)
    if not end:
        raise InputError(f"{path}: cannot be read as PLY: no line end_header ends the header")
    elements: dict[str, _Element] = {}
    order, types = None, None

    for line in data[start.end() : end.start()].decode("latin-1").split(start[1].decode()):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in ORDERS and not order:
                order = ORDERS[name]
            case ["element", name, rows] if rows.isdecimal() and name not in elements and order:
                elements[name] = _Element(name, int(rows), order == "=")
                types = elements[name].types
            case ["property", "list", length, kind, name] if {length, kind} <= TYPES.keys() and types is not None:
                types[name] = order + TYPES[kind], order + TYPES[length]
            case ["property", kind, name] if kind in TYPES and types is not None:
                types[name] = order + TYPES[kind], None
            case _:
                raise InputError(f'{path}: cannot be read as PLY: the header says "{line[:60].strip()}"')
    return elements, end.end(), order == "="


def _read_rows(path: Path, data: bytes, at: int, element: _Element) -> int:
    """Fill the columns of an element that begins at byte `at`; return the byte after its end."""
    lists = [name for name, (_, length) in element.types.items() if length]
    row = _first_row(data, at, element)
    if row is None or at + element.rows * row.itemsize > len(data):
        return _read_uneven_rows(path, data, at, element)
    table = np.frombuffer(data, row, element.rows, at)
    if any((table[f"length of {name}"] != row[name].shape[0]).any() for name in lists):
        return _read_uneven_rows(path, data, at, element)
    for name in element.types:
        element.columns[name] = table[name].ravel()
    for name in lists:
        element.lengths[name] = np.full(element.rows, row[name].shape[0])
    return at + table.nbytes


def _first_row(data: bytes, at: int, element: _Element) -> np.dtype | None:
    """Return the layout of the first row, which all rows have if their lists have equal lengths; None: no such row."""
    layout = []
    for name, kind, length in element.layout():
        shape = ()
        if length:
            layout.append((f"length of {name}", length))
            head = np.dtype(layout)
            if at + head.itemsize > len(data):
                return None
            long = np.frombuffer(data, head, 1, at)[layout[-1][0]][0]
            if not 0 <= long <= len(data):
                return None
            shape = (int(long),)
        layout.append((name, kind, shape))
    return np.dtype(layout) if layout and element.rows else None


def _read_uneven_rows(path: Path, data: bytes, at: int, element: _Element) -> int:
    """Fill the columns row by row, as the start of a row depends on the lists before; return the byte after the end."""
    # A row is a stretch of single numbers, a list, the next stretch, and so on.
    place, plan, offset = {}, [], 0
    for name, kind, length in element.layout():
        place[name] = len(plan), offset
        size = struct.calcsize(kind)
        offset += 0 if length else size
        if length:
            plan.append((offset, struct.Struct(length), size))
            offset = 0
    begins: list[list[int]] = [[] for _ in range(len(plan) + 1)]  # first bytes of the stretches
    lengths: list[list[int]] = [[] for _ in plan]
    for number in range(element.rows if element.types else 0):
        try:
            for k, (skip, head, size) in enumerate(plan):
                begins[k].append(at)
                (long,) = head.unpack_from(data, at + skip)
                if long < 0 or long % 1:
                    raise InputError(f"{path}: {element.name} {number} (counting from 0) has a list of length {long}")
                lengths[k].append(int(long))
                at += skip + head.size + int(long) * size
            begins[-1].append(at)
            at += offset
        except struct.error:
            at = len(data) + 1
        if at > len(data):
            raise InputError(f"{path}: the file ends after {number} of {element.rows} {element.name} rows")

    for name, kind, length in element.layout():
        stretch, offset = place[name]
        starts = np.array(begins[stretch], np.int64) + offset
        if length:
            element.lengths[name] = np.array(lengths[stretch], np.int64)
            own, within = enumerated(element.lengths[name])
            starts = starts[own] + struct.calcsize(length) + struct.calcsize(kind) * within
        # A view of the number at every byte, from which the wanted ones are taken.
        every = np.ndarray((max(len(data) - struct.calcsize(kind) + 1, 0),), kind, data, strides=(1,))
        element.columns[name] = every[starts]
    return at


def _table(path: Path, element: _Element, names: tuple[str, ...]) -> np.ndarray:
    """Return (rows, len(names)) float64 values of these properties."""
    for name in names:
        if name not in element.types or element.types[name][1]:
            raise InputError(f"{path}: element {element.name} lacks the property {name}")
    with np.errstate(over="ignore"):  # numbers in text may exceed their type; `mesh.load` refuses infinities
        return np.stack([element.columns[name].astype(element.types[name][0]) for name in names], 1).astype(np.float64)


def _attributes(elements: dict[str, _Element]) -> tuple[tuple[str, ...], dict[str, np.ndarray]]:
    """Return notes, and (N, 3) attributes of vertices and faces by Mitsuba's names, after "vertex_" or "face_".

    Properties r, g, b or red, green, blue give "color"; N_r, N_g, N_b "N_color"; N_x, N_y, N_z or N_0, N_1, N_2 "N".
    N_r, N_x or N_0 alone is used for all three channels.
    """
    found, notes = {}, []
    for element in (elements[kind] for kind in ("vertex", "face") if kind in elements and "tristrips" not in elements):
        single = [key for key, (_, length) in element.types.items() if not length]
        for first, *others in CHANNELS:
            for key in (key for key in single if key.endswith(first)):
                stem = key.removesuffix(first)
                keys = [key, *(stem + other for other in others if stem + other in single)]
                if len(keys) == 2 or (stem or len(keys) == 1 if first in COLORS else not stem):
                    continue
                values = np.stack([element.columns[each].astype(np.float64) for each in keys], axis=1)
                number = element.types[key][0]
                if np.dtype(number).kind in "iu":
                    values = values / np.iinfo(number).max
                    notes.append(f"{', '.join(keys)} of each {element.name} are integers, divided by the largest one")
                words = [element.name, stem, "color" if first.strip("_") in COLORS else ""]
                found["_".join(word for word in words if word)] = np.broadcast_to(values, (len(values), 3))
    return tuple(notes), found


def _faces(path: Path, elements: dict[str, _Element]) -> tuple[np.ndarray, np.ndarray]:
    """Return (C,) vertex indices of the corners of all polygons, and (F,) sizes of the polygons."""
    corners, sizes = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for element in (elements[name] for name in ("face", "tristrips") if name in elements):
        if element.lengths.get("texcoord", np.zeros(0)).any():
            remedy = "save them per vertex, as u and v"
            raise InputError(f"{path}: texture coordinates per face are not supported; {remedy}")
        name = next((name for name in ("vertex_indices", "vertex_index") if name in element.lengths), None)
        if name is None:
            if element.rows:
                raise InputError(f"{path}: element {element.name} lacks the list vertex_indices")
            continue
        index, size = element.columns[name], element.lengths[name]
        if index.dtype.kind == "f" and (index % 1 != 0).any():
            raise InputError(f"{path}: {element.name}: the list {name} holds something that is not a whole number")
        index = index.astype(np.int64)
        if element.name == "tristrips":  # -1 ends a strip within a row
            strip = (enumerated(size)[0] + np.cumsum(index == -1))[index != -1]
            index = strips(index[index != -1], np.unique(strip, return_counts=True)[1]).ravel()
            size = np.full(len(index) // 3, 3)
        elif (size < 3).any():
            bad = (size < 3).argmax()
            raise InputError(f"{path}: face {bad} (counting from 0) has {size[bad]} vertices")
        corners.append(index)
        sizes.append(size)
    return np.concatenate(corners), np.concatenate(sizes)
