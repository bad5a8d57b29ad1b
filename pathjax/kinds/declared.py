"""Types of parameters, which a kind declares as class attributes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Declared:
    """A column of a kind's table. In a scene file it has the attribute's name."""

    default: object = None  # None: rows may lack it, and the attribute of a `Row` is None if all rows lack it
    bounds: tuple[float, float] = (-math.inf, math.inf)
    textured: bool = False  # a texture may replace it
    moves_paths: bool = False
    least: float = -math.inf  # smaller values are treated as this one
    required: bool = False  # files must give it
    absent: object = 0.0  # stored in rows that lack it; it is not read there, or has the same effect as no value
    listed: bool = False  # is a parameter of the scene, to be set, differentiated and fitted
    shape = ()  # of a row's value
    dtype = None  # None: the scene's dtype of reals
    shared = False  # one array for all rows
    tag = "float"  # of the element that gives it

    def read(self, loader, fields, name: str, owner: str):
        """Return the value that a file gives, or the default.

        Raises:
            InputError: the value is out of range.
        """
        return self.default


@dataclass(frozen=True)
class Number(Declared):
    """A scalar; where it may be textured, also the mean of a colour, or the luminance of a texture, as in Mitsuba."""

    listed: bool = True

    def read(self, loader, fields, name, owner):
        if self.textured and (made := loader.texture(fields, name, owner, of_number=True)) is not None:
            return _in_range(fields, name, made, self.bounds)
        low, high = self.bounds
        if self.textured and fields.gives_color(name):
            return float(fields.color(name, at_most=high).mean())
        return fields.float(name, self.default, at_least=low, at_most=high)


@dataclass(frozen=True)
class Color(Declared):
    """Linear RGB; a scalar default sets all three channels."""

    bounds: tuple[float, float] = (0, 1)
    textured: bool = True
    radiance: bool = False  # emitted light, for which uniform spectra have another colour, see `Fields.color`
    listed: bool = True
    shape = (3,)
    tag = "rgb"

    def read(self, loader, fields, name, owner):
        if self.textured and (made := loader.texture(fields, name, owner)) is not None:
            if self.radiance and made.kind.mean(made) is None:
                raise fields.error(name, "is a texture without a mean over uv, to choose among lights by; use a bitmap")
            return self.checked(loader, fields, name, made)
        default = None if self.default is None else np.broadcast_to(np.asarray(self.default, float), 3)
        low, high = self.bounds
        color = fields.color(name, default, at_most=high, radiance=self.radiance)
        if color is not None and (color < low).any():
            raise fields.error(name, f"must be at least {low:g}, is {', '.join(f'{c:g}' for c in color)}")
        return color

    def checked(self, loader, fields, name, texture):
        """Return the texture. Its colours may exceed the upper bound of constants, as in Mitsuba, which adds a note."""
        low, high = self.bounds
        made, (_, largest) = _in_range(fields, name, texture, (low, math.inf)), texture.kind.span(texture)
        if largest > high:
            loader.note(fields.where(name), f"has colours up to {largest:.4g}, above {high:g}, which are kept")
        return made


@dataclass(frozen=True)
class Transform2(Declared):
    """A matrix (2, 3) applied to (u, v, 1); in files a transform of x and y."""

    absent: object = field(default_factory=lambda: np.eye(2, 3))
    shape = (2, 3)

    def read(self, loader, fields, name, owner):
        matrix = fields.transform(name)
        if not np.allclose([matrix[:2, 2], matrix[2, :2]], 0, atol=1e-9):
            loader.note(fields.where(name), "mixes z with u and v, which has no effect; shifts are <translate>")
        return matrix[np.ix_([0, 1], [0, 1, 3])]


@dataclass(frozen=True)
class Position(Declared):
    """A point in world space; in files a point, or the origin moved by `to_world`. Not a parameter of the scene."""

    default: object = (0.0, 0.0, 0.0)
    shape = (3,)

    def read(self, loader, fields, name, owner):
        given, to_world = _given_or_placed(fields, name)
        return to_world[:3, 3] if given is None else given


@dataclass(frozen=True)
class Direction(Declared):
    """A unit vector in world space; in files of any length, or the z axis rotated by `to_world`. Not a parameter."""

    default: object = (0.0, 0.0, 1.0)
    shape = (3,)

    def read(self, loader, fields, name, owner):
        given, to_world = _given_or_placed(fields, name)
        if given is not None and not given.any():
            raise fields.error(name, "is the zero vector, which points nowhere")
        return self.of(to_world[:3, 2] if given is None else given)

    @staticmethod
    def of(vector: np.ndarray) -> np.ndarray:
        """Normalise a vector; it is scaled first, so that no square of a component overflows or underflows."""
        vector = vector / np.abs(vector).max()
        return vector / np.linalg.norm(vector)


@dataclass(frozen=True)
class Rotation(Declared):
    """An orthonormal matrix (3, 3): the rotation, or rotation and reflection, of `to_world`, without shift and scale.

    Not a parameter of the scene.
    """

    default: object = field(default_factory=lambda: np.eye(3))
    shape = (3, 3)

    def read(self, loader, fields, name, owner):
        axes = fields.transform(name)[:3, :3]
        axes = axes / np.cbrt(abs(np.linalg.det(axes)))
        if not np.allclose(axes.T @ axes, np.eye(3), atol=4e-3):
            raise fields.error(name, "shears or scales unevenly, where it may only turn and mirror")
        u, _, vt = np.linalg.svd(axes)  # removes the rounding of the file, too
        return u @ vt


@dataclass(frozen=True)
class Angle(Declared):
    """Degrees; in files strictly between the bounds. Not a parameter of the scene."""

    def read(self, loader, fields, name, owner):
        low, high = self.bounds
        return fields.float(name, self.default, above=low, below=high)


@dataclass(frozen=True)
class Setting(Declared):
    """One of several words, the same for all rows of a table: static, not data."""

    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Flag(Declared):
    """A boolean, false in rows that lack it. Not a parameter of the scene."""

    dtype = bool

    def read(self, loader, fields, name, owner):
        return fields.boolean(name, bool(self.default)) or None


@dataclass(frozen=True)
class Choice(Setting):
    """A setting that files give. Rows that differ in it are in different tables."""

    def read(self, loader, fields, name, owner):
        return fields.string(name, self.default, choices=self.options)


@dataclass(frozen=True)
class Internal(Declared):
    """A number that no file gives: the package sets it, for derivatives."""


class PerRow(Declared):
    """A column that the kind's own builder fills, in a shape and dtype of its choice."""


@dataclass(frozen=True)
class Shared(Declared):
    """An array that all rows share, filled by the kind's own builder."""

    by_number: bool = False  # read only at indices that rows of the table hold, so it may be padded
    colors: bool = False  # colours one after another, in an array of one axis
    wider: bool = False  # its rows are colours, and may be padded with further channels, which are not read
    shared = True


@dataclass(frozen=True)
class Unused:
    """A parameter that Mitsuba's plugin accepts, and that has no effect on images here."""

    tag: str  # "float", "color", "integer", "boolean", "string" or "transform"
    why: str = ""  # reason that is appended to the note
    choices: tuple[str, ...] = ()  # of a string; none: any
    at_least: float = -math.inf  # of a number; integers are never negative


def _given_or_placed(fields, name):
    """Return the vector (3,) that the file gives, or None, and the matrix (4, 4) that may replace it."""
    given, to_world = fields.point(name, None), fields.transform("to_world")
    if given is not None and fields.has("to_world"):
        raise fields.error(name, "excludes to_world; give one or the other")
    return given, to_world


def _in_range(fields, name, texture, bounds):
    low, high = texture.kind.span(texture)
    if not (bounds[0] <= low <= high <= bounds[1] and high < math.inf):  # also where one is NaN
        above = f"above {bounds[1]:g}" if bounds[1] < math.inf else "inf"
        raise fields.error(name, f"is a texture with values below {bounds[0]:g}, {above} or NaN")
    return texture
