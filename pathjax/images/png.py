"""PNG, JPEG and similar formats, for viewing: 8 or 16 bits of sRGB."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.images.decoder import Unreadable, opened, read_pixels, require_size
from pathjax.system.files import write_whole


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Convert encoded values in [0, 1] to linear light, any shape (IEC 61966-2-1)."""
    encoded = np.asarray(encoded)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Invert `srgb_to_linear`."""
    linear = np.asarray(linear)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def write_png(path: str | Path, rgb: np.ndarray) -> None:
    """Write (H, W, 3) linear RGB as 8-bit sRGB: clipped to [0, 1], rounded to nearest, NaN black."""
    from PIL import Image

    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise InputError(f"{path}: an image must have the shape (H, W, 3), has {rgb.shape}")
    encoded = linear_to_srgb(np.clip(np.nan_to_num(rgb, nan=0.0, posinf=1.0, neginf=0.0), 0, 1))
    image = Image.fromarray(np.rint(encoded * 255).astype(np.uint8))
    write_whole(Path(path), lambda file: image.save(file, format="PNG"))


def write_stored(path: str | Path, stored: np.ndarray) -> None:
    """Write (H, W, 3) uint8 values unchanged."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(stored, np.uint8))
    write_whole(Path(path), lambda file: image.save(file, format="PNG"))


def read_stored(path: str | Path) -> np.ndarray:
    """Read the stored values (H, W, 3) uint8 or uint16 of a PNG, JPEG, BMP or TGA, without the sRGB conversion.

    Grey is repeated, alpha dropped; values of fewer than 8 bits are scaled to 0 to 255, and palettes are looked up.

    Raises:
        InputError: as `read_rgb`.
    """
    with opened(path) as image:
        spec = image.spec()
        require_size(spec)
        if spec.getattribute("jpeg:ColorSpace") in ("CMYK", "YCbCrK"):
            raise Unreadable("it is CMYK, for a printer; convert it to RGB")
        channels = 3 if spec.nchannels >= 3 else 1
        stored = read_pixels(image, 0, 0, channels, spec.format)
    return stored if channels == 3 else np.repeat(stored, 3, axis=-1)


def storage(path: str | Path) -> tuple[int, np.ndarray]:
    """Return the maximum stored value (255 for 8 bits) of a PNG that `read_rgb` can read; (H, W) bool: opaque pixels.

    Raises:
        InputError: the PNG has a palette, which holds the nearest of few colours.
    """
    with open(path, "rb") as file:
        bits, color_type = file.read(26)[24:]  # the header comes first
    if color_type == 3:
        raise InputError(f"{path}: a palette holds the nearest of few colours; write the image as RGB")
    with opened(path) as image:
        spec = image.spec()
        if spec.alpha_channel < 0:
            return 2**bits - 1, np.ones((spec.height, spec.width), bool)
        alpha = read_pixels(image, 0, spec.alpha_channel, spec.alpha_channel + 1, spec.format)[..., 0]
    return 2**bits - 1, alpha == np.iinfo(alpha.dtype).max
