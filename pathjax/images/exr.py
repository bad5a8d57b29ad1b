"""OpenEXR, for measurement: linear values in named channels, in one part or several."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.images.decoder import Unreadable, file_format, opened, read_pixels, require_size
from pathjax.system.files import encodable, write_whole

# CIE x, y of red, green, blue and white. The white of Rec. 709 is D65 as Mitsuba rounds it, (0.950456, 1, 1.088754).
_REC709 = (0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3127313, 0.3290329)
_XYZ = (1, 0), (0, 1), (0, 0), (1 / 3, 1 / 3)
# Chromaticities are published to three or four digits.
_SAME_CHROMATICITY = 5e-4
# Mitsuba's matrices between RGB and XYZ have six digits: one is the inverse of the other within this.
_MATRIX_ROUNDING = 2e-6


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray], header: Mapping[str, str | int | float]) -> None:
    """Write channels as 32-bit floats with ZIP compression; the file appears whole or not at all.

    Args:
        channels: name to (H, W); viewers show those named R, G, B.
        header: attributes of the file; an int must fit 32 bits; characters that UTF-8 cannot encode are escaped.
    Raises:
        InputError: the folder does not exist or is not writable, shapes differ, or an int does not fit.
    """
    import OpenEXR

    # OpenEXR writes the memory behind a strided view as if it were contiguous: a wrong image, without an error.
    pixels = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in channels.items()}
    shapes = {values.shape for values in pixels.values()}
    if len(shapes) != 1 or any(len(shape) != 2 or 0 in shape for shape in shapes):
        raise InputError(f"{path}: channels must share one shape (H, W), have {sorted(shapes)}")
    for name, value in header.items():
        if isinstance(value, int) and not -(2**31) <= value < 2**31:
            raise InputError(f'{path}: the header\'s "{name}" is {value}; an integer there must fit 32 bits')
    header = {name: encodable(value) if isinstance(value, str) else value for name, value in header.items()}
    fixed = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    encoded = io.BytesIO()  # OpenEXR itself reports no error if the disk has no room for the last bytes
    with OpenEXR.File({**header, **fixed}, pixels) as file:
        file.write(encoded)
    write_whole(Path(path), lambda file: file.write(encoded.getbuffer()))


def storage(path: str | Path) -> tuple[str, bool]:
    """Return OpenEXR's name of the compression of a file that `read_rgb` can read, and whether it has 16-bit floats."""
    with opened(path) as image:
        parts = _parts(image)
        part, _, indices = _find_colors(parts)
        compression, *_ = (parts[part].getattribute("compression") or "none").split(":")  # a level may follow
        return compression.upper(), "half" in {_number(parts[part], i) for i in indices}


def read_exr(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str | int | float]]:
    """Return all channels as (H, W) float32 by name, and the attributes of the header that are text or numbers.

    The channels cover the display window and are 0 outside the data window. In a file of several parts, channel names
    are prefixed by the part's name, and the header is that of the first part.

    Raises:
        InputError: the file does not exist, or is not a readable OpenEXR file.
    """
    if (found := file_format(path)) != "OpenEXR":
        raise InputError(f"{path}: is {found}, not OpenEXR")
    channels = {}
    with opened(path) as image:
        parts = _parts(image)
        for part, spec in enumerate(parts):
            pixels = _read_channels(image, part, spec, range(spec.nchannels))
            for i, name in enumerate(spec.channelnames):
                channels[_full_name(parts, part, name)] = pixels[..., i]
        header = {entry.name: entry.value for entry in parts[0].extra_attribs}
    return channels, {name: value for name, value in header.items() if type(value) in (str, int, float)}


def read_colors(path: str | Path) -> np.ndarray:
    with opened(path) as image:
        parts = _parts(image)
        part, kind, indices = _find_colors(parts)
        primaries = _XYZ if kind == "XYZ" else _primaries(parts[part])
        matrix = None
        if kind != "Y" and not np.allclose(primaries, _REC709, rtol=0, atol=_SAME_CHROMATICITY):
            matrix = _to_rec709(primaries)
        pixels = _read_channels(image, part, parts[part], indices)
        numbers = {_number(parts[part], i) for i in indices}
    if matrix is None:
        return pixels if len(indices) == 3 else np.repeat(pixels, 3, axis=-1)
    # Set red, green or blue to 0 if it is within the rounding error of the stored values.
    rounding = np.finfo(np.float16).eps if "half" in numbers else _MATRIX_ROUNDING
    with np.errstate(invalid="ignore"):  # infinities of opposite signs
        rgb = pixels @ matrix.T
        rgb[np.abs(rgb) < rounding * (np.abs(pixels) @ np.abs(matrix).T)] = 0
    return rgb.astype(np.float32)


def _find_colors(parts) -> tuple[int, str, list[int]]:
    """Return the part that holds the image, "RGB", "XYZ" or "Y", and the indices of these channels in the part."""
    layers: dict[tuple[int, str], dict[str, int]] = {}
    for part, spec in enumerate(parts):
        for i, name in enumerate(spec.channelnames):
            layer, _, last = name.rpartition(".")
            layers.setdefault((part, layer), {}).setdefault(last.upper(), i)
    found = {}
    for (part, layer), places in layers.items():
        kinds = ["RGB"]
        if not layer and len(parts) == 1:  # elsewhere X, Y, Z are a normal or a position
            kinds += ["XYZ"] if "X" in places else ["Y"]
        kind = next((kind for kind in kinds if places.keys() >= set(kind)), None)
        if kind == "Y" and places.keys() & {"RY", "BY"}:
            raise Unreadable("it holds luminance and chroma, Y, RY and BY; write it with channels R, G, B")
        if kind:
            found[part, layer] = kind
    candidates = [place for place in found if not place[1]] or list(found)
    if not candidates:
        names = sorted(_full_name(parts, part, name) for part, spec in enumerate(parts) for name in spec.channelnames)
        raise Unreadable(f"it has no channels R, G, B or X, Y, Z and no channel Y; it has: {', '.join(names)}")
    if len(candidates) > 1:
        images = ", ".join(_full_name(parts, part, layer) for part, layer in candidates)
        raise Unreadable(f"it holds several images: {images}; write the one that is meant with channels R, G, B")
    part, layer = candidates[0]
    kind = found[part, layer]
    return part, kind, [layers[part, layer][name] for name in kind]


def _full_name(parts, part: int, name: str) -> str:
    if len(parts) == 1:
        return name
    return f"{parts[part].getattribute('name')}.{name}".rstrip(".")


def _primaries(spec) -> np.ndarray:
    """Return the file's chromaticities (4, 2); those of Rec. 709 if it states none."""
    stated = spec.getattribute("chromaticities")
    space = spec.getattribute("colorInteropID") or "unknown"
    linear = space == "lin_rec709_scene" or space.startswith("lin_") and stated is not None
    if not linear and space not in ("unknown", "data"):
        raise Unreadable(f'its colours are "{space}"; convert them to "lin_rec709_scene"')
    return np.reshape(_REC709 if stated is None else stated, (4, 2))


def _to_rec709(primaries) -> np.ndarray:
    """Return the matrix (3, 3) from linear RGB of these primaries to Rec. 709; as in Mitsuba, white is not adapted."""
    try:
        with np.errstate(all="ignore"):
            matrix = np.linalg.solve(_to_xyz(_REC709), _to_xyz(primaries))
    except np.linalg.LinAlgError:
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        raise Unreadable(f"its chromaticities {np.ravel(primaries).tolist()} are no primaries; mend its header")
    return matrix


def _to_xyz(primaries) -> np.ndarray:
    """Return the matrix (3, 3) from linear RGB to CIE XYZ (SMPTE RP 177)."""
    x, y = np.transpose(primaries)
    xyz = np.stack([x, y, 1 - x - y])
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3] / y[3])


def _parts(image) -> list:
    """Return the headers of all parts."""
    parts = [image.spec(part, 0) for part in range(image.spec().getattribute("oiio:subimages") or 1)]
    for spec in parts:
        require_size(spec)
    return parts


def _read_channels(image, part: int, spec, indices: Sequence[int]) -> np.ndarray:
    """Read (H, W, len(indices)) float32 over the display window, from the largest level of a pyramid."""
    if spec.deep:
        raise Unreadable("it holds deep data, many samples in a pixel; flatten it")
    first, end = min(indices), max(indices) + 1
    # One read per stored type: converted to another type, an integer would be divided by its maximum.
    kinds = {_number(spec, i) for i in indices}
    stored = {kind: read_pixels(image, part, first, end, kind) for kind in kinds}
    pixels = np.empty((spec.height, spec.width, len(indices)), np.float32)
    for k, i in enumerate(indices):
        pixels[..., k] = stored[_number(spec, i)][..., i - first]
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    if (x, y, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return pixels
    shown = np.zeros((spec.full_height, spec.full_width, len(indices)), np.float32)
    left, top = max(x, 0), max(y, 0)
    inside = pixels[top - y : max(spec.full_height - y, 0), left - x : max(spec.full_width - x, 0)]
    shown[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return shown


def _number(spec, channel: int) -> str:
    """Return the stored type of a channel: "half", "float" or "uint"."""
    return str(spec.channelformat(channel))
