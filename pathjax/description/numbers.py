"""Parsing of numbers, vectors and transforms in elements of scene files."""

from __future__ import annotations

import re

import numpy as np

from pathjax.description.elements import Element, require_attributes
from pathjax.description.transform import Transform, rotation
from pathjax.errors import InputError

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def number(element: Element, text: str) -> float:
    """Parse one decimal number that is finite in float32, too."""
    if not NUMBER.fullmatch(text.strip()) or not abs(float(text)) < 3e38:
        raise element.error(f"{element}: {text.strip()[:40]!r} is not a finite number")
    return float(text)


def numbers(element: Element, text: str) -> list[float]:
    """Parse numbers separated by commas or blanks; at least one."""
    return [number(element, part) for part in re.split(r"[\s,]+", text.strip().rstrip(","))]


def triple(element: Element, default: float | None, extra: tuple[str, ...] = ()) -> np.ndarray:
    """Parse (3,) from x, y, z attributes or `value` (one number sets all three); `default` None: all are required."""
    require_attributes(element, optional=("value", "x", "y", "z", *extra))
    attributes = element.attributes
    if "value" in attributes:
        if set("xyz") & set(attributes):
            raise element.error(f"{element} mixes value with x, y, z; give one or the other")
        values = numbers(element, attributes["value"])
        if len(values) not in (1, 3):
            raise element.error(f"{element} has {len(values)} numbers; it takes 1 or 3")
        return np.broadcast_to(np.array(values), 3).copy()
    missing = [axis for axis in "xyz" if axis not in attributes]
    if missing and default is None:
        raise element.error(f'{element} lacks the attribute "{missing[0]}"')
    return np.array([number(element, attributes[axis]) if axis in attributes else default for axis in "xyz"])


def transform(element: Element) -> np.ndarray:
    """Parse the steps of a <transform>, the first in the file applied first: (4, 4) float64, affine and invertible."""
    require_attributes(element, required=("name",))
    matrix = np.eye(4)
    for step in element.children:
        if step.tag not in STEPS:
            raise step.error(f"{step} is not supported inside {element}; use one of: {', '.join(STEPS)}")
        if step.children:
            raise step.error(f"{step} takes nothing inside")
        matrix = STEPS[step.tag](step) @ matrix
        if not (np.abs(matrix) < 3e38).all():
            raise step.error(f"{step} makes {element} overflow")
        if np.linalg.cond(matrix[:3, :3]) > 1e12:
            raise step.error(f"{step} makes {element} singular: it flattens space")
    return matrix


def _rotate(step: Element) -> np.ndarray:
    axis = triple(step, default=0.0, extra=("angle",))
    require_attributes(step, required=("angle",), optional=("value", "x", "y", "z"))
    if not axis.any():
        raise step.error(f"{step}: the axis is the zero vector")
    # As in Mitsuba the axis is not normalised: an axis that is not a unit vector scales, too.
    return rotation(axis, number(step, step.attributes["angle"]))


def _lookat(step: Element) -> np.ndarray:
    require_attributes(step, required=("origin", "target"), optional=("up",))
    vectors = [_vector(step, step.attributes.get(key, "0, 0, 0")) for key in ("origin", "target", "up")]
    try:
        return Transform().look_at(*vectors).matrix
    except InputError as error:
        raise step.error(f"{step}: {str(error).removeprefix('look_at: ')}") from None


def _matrix(step: Element) -> np.ndarray:
    require_attributes(step, required=("value",))
    values = numbers(step, step.attributes["value"])
    if len(values) not in (9, 16):
        raise step.error(f"{step} has {len(values)} numbers; it takes 9 or 16")
    matrix = np.eye(4)
    side = 3 if len(values) == 9 else 4
    matrix[:side, :side] = np.reshape(values, (side, side))
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise step.error(f"{step}: the last row must be 0 0 0 1, since transforms are affine")
    return matrix


def _vector(step: Element, text: str) -> np.ndarray:
    values = numbers(step, text)
    if len(values) != 3:
        raise step.error(f"{step}: {text.strip()[:40]!r} must be three numbers")
    return np.array(values)


STEPS = {
    "translate": lambda step: Transform().translate(triple(step, default=0.0)).matrix,
    "rotate": _rotate,
    "scale": lambda step: Transform().scale(triple(step, default=1.0)).matrix,
    "lookat": _lookat,
    "matrix": _matrix,
}
