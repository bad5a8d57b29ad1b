"""Affine maps of space, composed as Mitsuba composes its own."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jax.typing import ArrayLike

from pathjax.errors import InputError


@dataclass(frozen=True, eq=False)
class Transform:
    """An affine map of space, to place shapes, sensors and lights: like `mitsuba.ScalarTransform4f`.

    Each method returns a new transform with a step that is applied before the existing ones:
    `Transform().translate([0, 0, 4]).rotate([0, 1, 0], 90)` rotates, and then shifts. `a @ b` applies b and then a, and
    `a @ points` maps points (..., 3).

    Args:
        matrix: (4, 4), acting on column vectors; its last row is 0 0 0 1. The identity by default.
    Raises:
        InputError: the matrix has another shape, entries that are not finite, or another last row.
    """

    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self):
        matrix = _numbers("a transform", self.matrix, (4, 4)).copy()
        if not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise InputError(f"the last row of a transform must be 0 0 0 1, is {matrix[3].tolist()}")
        matrix.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)

    def translate(self, v: ArrayLike) -> Transform:
        """Shift by v (3,)."""
        matrix = np.eye(4)
        matrix[:3, 3] = _numbers("translate", v, (3,))
        return self @ Transform(matrix)

    def scale(self, v: ArrayLike) -> Transform:
        """Scale by v: one factor, or three, one for each axis."""
        return self @ Transform(np.diag([*_numbers("scale", v, (3,)), 1.0]))

    def rotate(self, axis: ArrayLike, angle: float) -> Transform:
        """Rotate about an axis (3,) through the origin; angle in degrees, counterclockwise seen against the axis.

        The axis may have any length. (Mitsuba does not normalise it: its map is a rotation only for a unit axis.)

        Raises:
            InputError: the axis is 0.
        """
        axis = _unit("the axis of rotate", _numbers("rotate", axis, (3,)), "is the zero vector")
        return self @ Transform(rotation(axis, float(_numbers("rotate", angle, ()))))

    def look_at(self, origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0, 0, 0)) -> Transform:
        """Map the origin to `origin` and the z axis towards `target`, with y up: the to_world of a camera.

        up: any vector that is not parallel to the line of sight; all zeros: an arbitrary one.

        Raises:
            InputError: origin and target coincide, or up is parallel to the line of sight.
        """
        origin, target, up = (_numbers("look_at", v, (3,)) for v in (origin, target, up))
        forward = _unit("look_at", target - origin, "origin and target coincide")
        if not up.any():  # Mitsuba's choice
            x, y, z = forward
            sign = math.copysign(1, z)
            up = np.array([1 - sign * x * x / (sign + z), -sign * x * y / (sign + z), -sign * x])
        least = 1e-12 * np.linalg.norm(up)  # rounding leaves a sine of some 1e-16 between parallel vectors
        left = _unit("look_at", np.cross(up, forward), "up is parallel to the line of sight", least)
        matrix = np.eye(4)
        matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
        return self @ Transform(matrix)

    def inverse(self) -> Transform:
        """Return the inverse transform.

        Raises:
            InputError: the transform flattens space.
        """
        try:
            linear = np.linalg.inv(self.matrix[:3, :3])
        except np.linalg.LinAlgError:
            raise InputError("the transform has no inverse: it flattens space") from None
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = linear, -linear @ self.matrix[:3, 3]
        return Transform(matrix)

    def __matmul__(self, other: Transform | ArrayLike):
        if isinstance(other, Transform):
            return Transform(self.matrix @ other.matrix)
        return np.asarray(other, float) @ self.matrix[:3, :3].T + self.matrix[:3, 3]


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the matrix (4, 4) of Rodrigues' formula, a rotation if the axis (3,) is unit; angle in degrees."""
    x, y, z = axis
    turn = math.radians(math.fmod(angle, 360))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = math.cos(turn) * np.eye(3) + math.sin(turn) * cross + (1 - math.cos(turn)) * np.outer(axis, axis)
    return matrix


def _numbers(what: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return the value as float64 of this shape; a scalar may set all three components."""
    try:
        made = np.broadcast_to(np.asarray(value, float), shape)
    except (TypeError, ValueError):
        made = None
    if made is None or len(shape) > 1 and np.shape(value) != shape or not np.isfinite(made).all():
        wanted = {(): "one finite number", (3,): "three finite numbers"}.get(shape, f"finite numbers of shape {shape}")
        raise InputError(f"{what} takes {wanted}, not {str(value)[:60]}")
    return made


def _unit(what: str, vector: np.ndarray, complaint: str, least: float = 0.0) -> np.ndarray:
    length = np.linalg.norm(vector)
    if not least < length < math.inf:
        raise InputError(f"{what}: {complaint}")
    return vector / length
