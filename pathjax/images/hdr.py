"""Radiance HDR images (Ward 1991, "Real pixels"): linear values whose three channels share an exponent."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathjax.images.decoder import Unreadable, opened, read_pixels, require_size

# OpenImageIO's code for the row order `-Y height +X width`, from the top and the left.
_UPRIGHT = 1


def read_colors(path: str | Path) -> np.ndarray:
    """Read (H, W, 3) float32 linear RGB as stored: as in Mitsuba, a stated exposure is not divided out.

    Raises:
        InputError: as `read_rgb`.
    """
    with opened(path) as image:
        spec = image.spec()
        require_size(spec)
        if spec.getattribute("Orientation") != _UPRIGHT:
            raise Unreadable('its rows do not run as "-Y height +X width" says; write them so')
        if spec.getattribute("oiio:Gamma"):
            raise Unreadable("it states a gamma, so its numbers are not linear; write it without one")
        return read_pixels(image, 0, 0, 3, "float")
