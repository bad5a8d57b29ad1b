"""Images of any format as linear RGB."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathjax.images import exr, hdr, png
from pathjax.images.decoder import file_format


def read_rgb(path: str | Path, raw: bool = False) -> np.ndarray:
    """(H, W, 3) float32 linear RGB with the primaries of Rec. 709, the top row first, from OpenEXR, Radiance
    HDR, PNG, JPEG, BMP or TGA.

    Grey is repeated and alpha left out, as in Mitsuba: colours of OpenEXR are multiplied by alpha already, as light
    that reached the camera is; those of others are taken as they stand. All but OpenEXR and HDR are sRGB, also with 16
    bits; their gamma, ICC profile and EXIF orientation are not applied, and of an animation its still image is read.

    From OpenEXR come R, G, B, or X, Y, Z, or Y; or R, G, B of a layer if there is one alone. X, Y, Z are converted, and
    so are primaries that the file states; white is not adapted. The image is the display window, 0 outside the data
    window.

    Args:
        raw: plain numbers (stored / maximum) are meant, not sRGB. OpenEXR and HDR are linear in any case.
    Raises:
        InputError: no such file, another format, a damaged file, or one that does not tell which colours are meant.
    """
    readers = {"OpenEXR": exr.read_colors, "Radiance HDR": hdr.read_colors}
    if reader := readers.get(file_format(path)):
        return reader(path)
    return decoded(png.read_stored(path), raw)


def decoded(stored: np.ndarray, raw: bool) -> np.ndarray:
    """float32 in [0, 1] of uint8 or uint16 that PNG, JPEG and their like store: linear light, or raw, the numbers."""
    maximum = np.iinfo(stored.dtype).max
    levels = np.arange(maximum + 1) / maximum
    return (levels if raw else png.srgb_to_linear(levels)).astype(np.float32)[stored]
