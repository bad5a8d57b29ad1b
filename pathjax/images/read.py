"""Reading images of any format as linear RGB."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathjax.images import exr, hdr, png
from pathjax.images.decoder import file_format


def read_rgb(path: str | Path, raw: bool = False) -> np.ndarray:
    """Read OpenEXR, Radiance HDR, PNG, JPEG, BMP or TGA as (H, W, 3) float32 linear RGB with the primaries of Rec. 709.

    The top row comes first. As in Mitsuba, grey is repeated and alpha dropped: colours of OpenEXR are already
    multiplied by alpha, like light that reached the camera; colours of other formats are used unchanged. All but
    OpenEXR and HDR are sRGB, also with 16 bits; their gamma, ICC profile and EXIF orientation are not applied. The
    still image of an animation is read.

    OpenEXR must have channels R, G, B, or X, Y, Z, or Y, or R, G, B in exactly one layer. X, Y, Z and stated primaries
    are converted without white adaptation. The image is the display window, 0 outside the data window.

    Args:
        raw: return plain values (stored / maximum) instead of decoding sRGB. OpenEXR and HDR are always linear.
    Raises:
        InputError: the file does not exist, has another format, is damaged, or has ambiguous colours.
    """
    readers = {"OpenEXR": exr.read_colors, "Radiance HDR": hdr.read_colors}
    if reader := readers.get(file_format(path)):
        return reader(path)
    return decoded(png.read_stored(path), raw)


def decoded(stored: np.ndarray, raw: bool) -> np.ndarray:
    """Convert uint8 or uint16 of PNG, JPEG and the like to float32 in [0, 1]: linear light, or plain values if raw."""
    maximum = np.iinfo(stored.dtype).max
    levels = np.arange(maximum + 1) / maximum
    return (levels if raw else png.srgb_to_linear(levels)).astype(np.float32)[stored]
