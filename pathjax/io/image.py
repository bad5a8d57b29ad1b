"""Images on disk: OpenEXR for what is measured, PNG for what is looked at, both read back as linear RGB."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.io.files import write_whole

MAX_PIXELS = 10**9


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1: encoded values in [0, 1] to linear light, any shape."""
    encoded = np.asarray(encoded)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """The inverse of `srgb_to_linear`."""
    linear = np.asarray(linear)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray], header: Mapping[str, str | int | float]) -> None:
    """Write channels as 32-bit floats with ZIP compression; the file appears whole or not at all.

    Args:
        channels: name to (H, W); a viewer shows those named R, G, B.
        header: attributes of the file; an int must fit 32 bits.
    Raises:
        InputError: no such folder, no right to write, or shapes that differ.
    """
    import OpenEXR

    # OpenEXR writes the memory behind a strided view as if it were contiguous: another image, without an error.
    pixels = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in channels.items()}
    shapes = {values.shape for values in pixels.values()}
    if len(shapes) != 1 or any(len(shape) != 2 or 0 in shape for shape in shapes):
        raise InputError(f"{path}: channels must share one shape (H, W), have {sorted(shapes)}")
    for name, value in header.items():
        if isinstance(value, int) and not -(2**31) <= value < 2**31:
            raise InputError(f'{path}: the header\'s "{name}" is {value}; an integer there must fit 32 bits')
    fixed = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write(beside: str) -> None:
        with OpenEXR.File({**header, **fixed}, pixels) as file:
            file.write(beside)

    write_whole(Path(path), write)


def read_exr(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str | int | float]]:
    """All channels as (H, W) float32 by name, and those attributes of the header that are text or numbers.

    Raises:
        InputError: no such file, or not an OpenEXR file that can be read.
    """
    import OpenEXR

    _require_file(path)
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = (np.asarray(corner, dtype=np.int64) for corner in file.header()["dataWindow"])
            if np.prod(high - low + 1, dtype=float) > MAX_PIXELS:
                raise InputError(f"{path}: more than {MAX_PIXELS:.0e} pixels")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header = {name: value for name, value in file.header().items() if type(value) in (str, int, float)}
            channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except InputError:
        raise
    except Exception as error:  # OpenEXR raises RuntimeError, TypeError and others, as the file's bytes have it
        raise InputError(f"{path}: cannot be read as OpenEXR: {error}") from None
    return channels, header


def write_png(path: str | Path, rgb: np.ndarray) -> None:
    """Write (H, W, 3) linear RGB as 8-bit sRGB: clipped to [0, 1], rounded to nearest, NaN black."""
    from PIL import Image

    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise InputError(f"{path}: an image must have the shape (H, W, 3), has {rgb.shape}")
    encoded = linear_to_srgb(np.clip(np.nan_to_num(rgb, nan=0.0, posinf=1.0, neginf=0.0), 0, 1))
    image = Image.fromarray(np.rint(encoded * 255).astype(np.uint8))
    write_whole(Path(path), lambda beside: image.save(beside, format="PNG"))


def read_rgb(path: str | Path, raw: bool = False) -> np.ndarray:
    """(H, W, 3) float32 linear RGB, the top row first, from OpenEXR, PNG or JPEG; grey is repeated, alpha left out.

    Args:
        raw: PNG and JPEG hold plain numbers (stored / maximum), not sRGB. OpenEXR is linear in any case.
    Raises:
        InputError: no such file, another format, or a damaged one.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".exr":
        return _read_exr_rgb(path)
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise InputError(f'{path}: "{suffix}" images are not supported; use .exr, .png or .jpg')
    stored = _read_pixels(path)
    return (stored if raw else srgb_to_linear(stored)).astype(np.float32)


def _read_exr_rgb(path: str | Path) -> np.ndarray:
    channels, _ = read_exr(path)
    names = "RGB" if {"R", "G", "B"} <= channels.keys() else "YYY"
    if names[0] not in channels:
        raise InputError(f"{path}: has no channels R, G, B and no channel Y; it has: {', '.join(sorted(channels))}")
    if len({channels[name].shape for name in names}) != 1:
        raise InputError(f"{path}: subsampled channels are not supported")
    return np.stack([channels[name] for name in names], axis=-1)


def _read_pixels(path: str | Path) -> np.ndarray:
    """(H, W, 3) float64 in [0, 1], as stored."""
    from PIL import Image

    _require_file(path)
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(f"{path}: more than {MAX_PIXELS:.0e} pixels")
            if image.mode == "I;16":
                return np.repeat(np.asarray(image, np.float64)[..., None], 3, axis=-1) / 65535
            if image.format == "PNG" and _png_bits(path) == 16:  # Pillow would cut it down to 8 bits
                raise InputError(f"{path}: 16-bit colour PNG is not supported; use .exr")
            return np.asarray(image.convert("RGB"), np.float64) / 255
    except InputError:
        raise
    except Exception as error:  # Pillow raises OSError, SyntaxError, ValueError and others, as the file's bytes have it
        raise InputError(f"{path}: cannot be read as an image: {error}") from None


def _png_bits(path: str | Path) -> int:
    with open(path, "rb") as file:
        return file.read(25)[24]


def _require_file(path: str | Path) -> None:
    if not Path(path).is_file():
        raise InputError(f"{path}: {'not a file' if Path(path).exists() else 'no such file'}")
