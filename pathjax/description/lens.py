"""Field of view of cameras and projectors, as scene files give it."""

from __future__ import annotations

import math
import re

import numpy as np

from pathjax.description.fields import Fields


def half_extent(fov: float, fov_axis: str, aspect: float) -> np.ndarray:
    """Return (2,) half of the width and height of the field of view at distance 1. aspect: width over height."""
    tan = math.tan(math.radians(fov) / 2)
    tan_x = {
        "x": tan,
        "y": tan * aspect,
        "diagonal": tan * aspect / math.hypot(aspect, 1),
        "smaller": tan * max(aspect, 1),
        "larger": tan * min(aspect, 1),
    }[fov_axis]
    return np.array([tan_x, tan_x / aspect])


def field_of_view(fields: Fields) -> tuple[float, str]:
    """Return the angle in degrees and its axis; a focal length is for 35 mm film, 36 x 24 mm, along the diagonal."""
    if fields.has("focal_length") and (fields.has("fov") or fields.has("fov_axis")):
        raise fields.error("focal_length", "excludes fov and fov_axis; give one or the other")
    if fields.has("fov_axis") and not fields.has("fov"):
        raise fields.error("fov_axis", "needs fov beside it; a focal length is of the diagonal")
    fov = fields.float("fov", None, above=0, below=180)
    axis = fields.string("fov_axis", "x", choices=("x", "y", "diagonal", "smaller", "larger"))
    text = fields.string("focal_length", "50mm").strip()
    if fov is not None:
        return fov, axis
    length = re.fullmatch(r"(\d{1,9}(\.\d{1,9})?)\s*(mm)?", text)
    if not length or float(length[1]) == 0:
        raise fields.error("focal_length", f'must be like "50mm", is "{text[:40]}"')
    return 2 * math.degrees(math.atan(math.hypot(36, 24) / (2 * float(length[1])))), "diagonal"
