"""Volumes with values in a grid, as in scene files and `.vol` files."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from pathjax.errors import InputError
from pathjax.kinds import Stored, Unused
from pathjax.system.files import write_whole

_HEADER = struct.Struct("<3sB5i6f")  # "VOL", version, encoding, x, y, z, channels, the corners of the box
_VERSION, _FLOAT32 = 3, 1
# Largest size of a grid that repeats: 4 GB of colours in float32.
MOST_CELLS = 4e9 / 12
UNIT = np.array([[0.0] * 3, [1.0] * 3])


@dataclass(frozen=True, eq=False)
class GridVolume(Stored):
    """Values at the centres of the cells of a box, trilinearly interpolated or not.

    They are constant beyond the outermost centres.
    """

    data: np.ndarray  # (Z, Y, X, C), C being 1 or 3
    to_grid: np.ndarray  # (3, 4), from world space to cell coordinates x, y, z; the centre of cell i is at i
    box: np.ndarray  # (2, 3) lower and upper corner of its bounding box in world space; nothing is outside
    wrap: str = "clamp"  # how it continues beyond the box on surfaces; for "repeat" see also `repeated`
    nearest: bool = False  # each value fills its cell
    listed: bool = False  # its values are a parameter of the scene
    box_of_file: np.ndarray = field(default_factory=lambda: UNIT)  # (2, 3), to state in a file of its values

    unused: ClassVar[Mapping[str, Unused]] = {
        "accel": Unused("boolean"),
        "max_value": Unused("float", "it bounds Mitsuba's steps", at_least=0),
        "raw": Unused("boolean", "its colours are linear RGB"),
    }

    @classmethod
    def read(cls, loader, fields, high: float) -> GridVolume:
        data, box = fields.array("data", None), UNIT
        if data is None:
            path = loader.find(fields, "filename")
            data, of_file = read_vol(path)
            if fields.boolean("use_grid_bbox", False):
                box = of_file
        else:
            path = fields.element.place
            data = np.asarray(data, np.float64)
            data = data[..., None] if data.ndim == 3 else data
            if data.ndim != 4 or data.shape[3] not in (1, 3) or not data.size:
                raise fields.error("data", f"must have the shape (Z, Y, X) or (Z, Y, X, 1 or 3), has {data.shape}")
        if not ((data >= 0) & (data <= high)).all():  # also where one is NaN
            what = "not be negative" if high == np.inf else f"lie between 0 and {high:g}"
            raise fields.element.error(f"{path}: its values must {what}, and are {data.min():g} to {data.max():g}")
        wrap = fields.string("wrap_mode", "clamp", choices=("clamp", "mirror", "repeat"))
        placed = _placed(fields.transform("to_world"), box, data.shape[2::-1])
        nearest = fields.string("filter_type", "trilinear", choices=("trilinear", "nearest")) == "nearest"
        return cls(data, *placed, wrap, nearest, listed=wrap != "repeat", box_of_file=box)

    @property
    def repeats(self) -> bool:
        return self.wrap == "repeat"

    def write(self, path: Path, data: np.ndarray) -> None:
        write_vol(path, data, self.box_of_file)

    def repeated(self, box: np.ndarray) -> GridVolume:
        """Return copies of the grid side by side that cover a box (2, 3) in world space.

        Raises:
            InputError: this takes more than MOST_CELLS.
        """
        corners = corners_of(box) @ self.to_grid[:, :3].T + self.to_grid[:, 3]
        low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
        if (cells := math.prod((high - low + 1).tolist())) > MOST_CELLS:
            raise InputError(f"a repeated grid fills its medium with {cells:.2g} cells, more than {MOST_CELLS:.2g}")
        x, y, z = (np.arange(low[k], high[k] + 1) % self.data.shape[2 - k] for k in range(3))
        moved = self.to_grid - np.pad(low[:, None], ((0, 0), (3, 0)))
        return GridVolume(self.data[np.ix_(z, y, x)], moved, self.box, nearest=self.nearest)


def boxed(value: np.ndarray, to_world: np.ndarray) -> GridVolume:
    """Return a volume of one value (3,) in the unit cube, placed by a (4, 4) matrix."""
    data = np.reshape(value, (1, 1, 1, 3))
    return GridVolume(data, *_placed(to_world, UNIT, (1, 1, 1)))


def _placed(to_world: np.ndarray, box: np.ndarray, size: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return `to_grid` and `box` of a grid of cells x, y, z that fills a box of its local space."""
    extent = box[1] - box[0]
    to_cells = np.diag([*(np.array(size) / extent), 1.0])
    to_cells[:3, 3] = -box[0] * np.array(size) / extent - 0.5
    corners = corners_of(box) @ to_world[:3, :3].T + to_world[:3, 3]
    return (to_cells @ np.linalg.inv(to_world))[:3], np.stack([corners.min(0), corners.max(0)])


def corners_of(box: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3)."""
    return np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)


def read_vol(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read values (Z, Y, X, C) and the box (2, 3) from a file in Mitsuba's own format.

    Raises:
        InputError: it cannot be read, is of another format, or is cut off.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) < _HEADER.size or content[:3] != b"VOL" or content[3] != _VERSION:
        raise InputError(f"{path}: not a volume of Mitsuba's format, version {_VERSION}")
    _, _, encoding, x, y, z, channels, *box = _HEADER.unpack_from(content)
    if encoding != _FLOAT32 or channels not in (1, 3):
        raise InputError(f"{path}: has encoding {encoding} and {channels} channels; use float32, and 1 or 3 channels")
    if min(x, y, z) < 1 or len(content) - _HEADER.size < 4 * x * y * z * channels:
        raise InputError(f"{path}: cut off: {x} x {y} x {z} cells are announced")
    data = np.frombuffer(content, "<f4", x * y * z * channels, _HEADER.size)
    box = np.reshape(box, (2, 3))
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise InputError(f"{path}: its box is empty")
    return data.reshape(z, y, x, channels).astype(np.float64), box


def write_vol(path: Path, data: np.ndarray, box: np.ndarray = UNIT) -> None:
    """Write values (Z, Y, X, C) in a box (2, 3), as float32."""
    z, y, x, channels = data.shape
    header = _HEADER.pack(b"VOL", _VERSION, _FLOAT32, x, y, z, channels, *box.ravel())
    write_whole(path, lambda file: file.write(header + data.astype("<f4").tobytes()))
