"""Images to fit to, and how they were rounded and clipped when stored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jax import Array

from pathjax.errors import InputError
from pathjax.images import exr, file_format, linear_to_srgb, png, read_rgb, srgb_to_linear

# These EXR compressions change pixel values, alike in neighbouring pixels.
_LOSSY = ("B44", "B44A", "DWAA", "DWAB")


@dataclass(frozen=True)
class Target:
    """An image to fit to, and how it was rounded and clipped: `read_target` finds that out; for arrays, state it here.

    Args:
        image: (H, W, 3) linear RGB.
        step: distance between stored values, (H, W, 3) or one for all, in the units of the image; 0: not rounded.
        ceiling: values at or above it are clipped: the truth may be any higher value.
        measured: (H, W, 3) or (H, W, 1) bool; False: left out, whatever the value, nan included.
    """

    image: Array | np.ndarray
    step: np.ndarray | float = 0.0
    ceiling: float = np.inf
    measured: np.ndarray | bool = True

    @property
    def usable(self) -> np.ndarray:
        """(H, W, 3) bool: neither clipped nor left out."""
        return self.measured & (self.image < self.ceiling)

    def misfit(self, image: np.ndarray, slack: np.ndarray | float = 0.0) -> np.ndarray:
        """Return (H, W, 3) how far an image is beyond `slack` from all that look like this target; 0: not measured."""
        difference = image - self.image
        high = np.where(self.usable, self.step / 2, np.inf)
        beyond = difference - np.clip(difference, -self.step / 2 - slack, high + slack)
        return np.where(self.measured, beyond, 0)


def read_target(path: str | Path) -> Target:
    """Read an OpenEXR or PNG file as a target.

    PNG is taken to be sRGB. Its rounding is noise of known size. Full scale counts as clipped, since brighter values
    look the same; pixels that are not opaque are not measured. A stored 0 is a measurement: radiance is not negative,
    so it lies within half a step. OpenEXR is linear; halves are rounded too, and end at 65504.

    Raises:
        InputError: no such file, another format, a damaged file, or one whose compression changes its pixels.
    """
    found = file_format(path)
    if found not in ("OpenEXR", "PNG"):
        raise InputError(f"{path}: {found} changes the pixels that it is given; use OpenEXR or PNG for targets")
    image = read_rgb(path).astype(np.float64)
    if found == "OpenEXR":
        compression, half = exr.storage(path)
        if compression in _LOSSY:
            raise InputError(f"{path}: {compression} compression changes pixels; write the file with ZIP, or none")
        if not half:
            return Target(image)
        largest = np.finfo(np.float16).max
        below = np.minimum(np.abs(image), np.nextafter(largest, np.float16(0)))
        step = np.spacing(below.astype(np.float16)).astype(np.float64)
        return Target(image, np.nan_to_num(step), float(largest))
    levels, opaque = png.storage(path)
    code = np.rint(linear_to_srgb(image) * levels)
    low, high = (srgb_to_linear(np.clip((code + off) / levels, 0, None)) for off in (-0.5, 0.5))
    # A stored 0 too has the noise of a whole step, since its half step lies all on one side.
    step = np.where(code > 0, high - low, 2 * high)
    return Target(image, step, float(srgb_to_linear(1 - 0.5 / levels)), opaque[..., None])
