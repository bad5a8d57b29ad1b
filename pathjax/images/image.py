"""Images on disk: OpenEXR for what is measured, PNG for what is looked at, both read back as linear RGB."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.system.files import encodable, write_whole

MAX_PIXELS = 10**9
_FIRST_BYTES = {"OpenEXR": b"\x76\x2f\x31\x01", "PNG": b"\x89PNG\r\n\x1a\n", "JPEG": b"\xff\xd8\xff"}

# CIE x, y of red, green, blue and white. The white of Rec. 709 is D65 as Mitsuba rounds it, (0.950456, 1, 1.088754).
_REC709 = (0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3127313, 0.3290329)
_XYZ = (1, 0), (0, 1), (0, 0), (1 / 3, 1 / 3)
# Chromaticities are published to three or four digits.
_SAME_CHROMATICITY = 5e-4
# Mitsuba's matrices between RGB and XYZ have six digits: one is the inverse of the other within this.
_MATRIX_ROUNDING = 2e-6


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
        header: attributes of the file; an int must fit 32 bits; what UTF-8 cannot hold of a text is escaped.
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
    header = {name: encodable(value) if isinstance(value, str) else value for name, value in header.items()}
    fixed = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    encoded = io.BytesIO()  # OpenEXR itself writes on when the disk has no room for the last bytes
    with OpenEXR.File({**header, **fixed}, pixels) as file:
        file.write(encoded)
    write_whole(Path(path), lambda file: file.write(encoded.getbuffer()))


def write_png(path: str | Path, rgb: np.ndarray) -> None:
    """Write (H, W, 3) linear RGB as 8-bit sRGB: clipped to [0, 1], rounded to nearest, NaN black."""
    from PIL import Image

    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise InputError(f"{path}: an image must have the shape (H, W, 3), has {rgb.shape}")
    encoded = linear_to_srgb(np.clip(np.nan_to_num(rgb, nan=0.0, posinf=1.0, neginf=0.0), 0, 1))
    image = Image.fromarray(np.rint(encoded * 255).astype(np.uint8))
    write_whole(Path(path), lambda file: image.save(file, format="PNG"))


def file_format(path: str | Path) -> str:
    """Return "OpenEXR", "PNG" or "JPEG", by the file's first bytes, whatever its name says.

    Raises:
        InputError: no such file, no right to read it, or another format.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: {'not a file' if Path(path).exists() else 'no such file'}")
    try:
        with open(path, "rb") as file:
            start = file.read(8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    for name, first in _FIRST_BYTES.items():
        if start.startswith(first):
            return name
    reason = "begins like another format" if start else "is empty"
    raise InputError(f"{path}: not supported, as it {reason}; use OpenEXR, PNG or JPEG")


def read_rgb(path: str | Path, raw: bool = False) -> np.ndarray:
    """(H, W, 3) float32 linear RGB with the primaries of Rec. 709, the top row first, from OpenEXR, PNG or JPEG.

    Grey is repeated and alpha left out, as in Mitsuba: colours of OpenEXR are multiplied by alpha already, as light
    that reached the camera is; those of PNG are taken as they stand. PNG and JPEG are sRGB, also with 16 bits; their
    gamma, ICC profile and EXIF orientation are not applied, and of an animation its still image is read.

    From OpenEXR come R, G, B, or X, Y, Z, or Y; or R, G, B of a layer if there is one alone. X, Y, Z are converted, and
    so are primaries that the file states; white is not adapted. The image is the display window, 0 outside the data
    window.

    Args:
        raw: PNG and JPEG hold plain numbers (stored / maximum), not sRGB. OpenEXR is linear in any case.
    Raises:
        InputError: no such file, another format, a damaged file, or one that does not tell which colours are meant.
    """
    if file_format(path) == "OpenEXR":
        return _read_exr_rgb(path)
    stored = read_stored(path)
    maximum = np.iinfo(stored.dtype).max
    levels = np.arange(maximum + 1) / maximum
    return (levels if raw else srgb_to_linear(levels)).astype(np.float32)[stored]


def read_stored(path: str | Path) -> np.ndarray:
    """(H, W, 3) uint8 or uint16 of a PNG or JPEG as they are stored, before the curve of sRGB.

    Grey is repeated, alpha left out; fewer than 8 bits are spread over 0 to 255, and palettes are looked up.

    Raises:
        InputError: as `read_rgb`.
    """
    with _opened(path) as image:
        spec = image.spec()
        _require_size(spec)
        if spec.getattribute("jpeg:ColorSpace") in ("CMYK", "YCbCrK"):
            raise _Unreadable("it is CMYK, for a printer; convert it to RGB")
        channels = 3 if spec.nchannels >= 3 else 1
        stored = _read(image, 0, 0, channels, spec.format)
    return np.repeat(stored, 3 // channels, axis=-1)


def png_storage(path: str | Path) -> tuple[int, np.ndarray]:
    """Levels above black of a PNG that `read_rgb` has read (255 for 8 bits), and (H, W) bool: which pixels are opaque.

    Raises:
        InputError: a palette, which holds the nearest of few colours.
    """
    with open(path, "rb") as file:
        bits, color_type = file.read(26)[24:]  # of the header, which comes first
    if color_type == 3:
        raise InputError(f"{path}: a palette holds the nearest of few colours; write the image as RGB")
    with _opened(path) as image:
        spec = image.spec()
        if spec.alpha_channel < 0:
            return 2**bits - 1, np.ones((spec.height, spec.width), bool)
        alpha = _read(image, 0, spec.alpha_channel, spec.alpha_channel + 1, spec.format)[..., 0]
    return 2**bits - 1, alpha == np.iinfo(alpha.dtype).max


# ---- OpenEXR ------------------------------------------------------------------------------------------------------


def exr_storage(path: str | Path) -> tuple[str, bool]:
    """Compression of an EXR that `read_rgb` has read, by OpenEXR's name, and whether it holds 16-bit floats."""
    with _opened(path) as image:
        parts = _parts(image)
        part, _, indices = _find_colors(parts)
        compression, *_ = (parts[part].getattribute("compression") or "none").split(":")  # a level may follow
        return compression.upper(), "half" in {_number(parts[part], i) for i in indices}


def read_exr(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str | int | float]]:
    """All channels as (H, W) float32 by name, and those attributes of the header that are text or numbers.

    The channels cover the display window and are 0 outside the data window. In a file of several parts the part's name
    stands before the channel's, and the header is that of the first part.

    Raises:
        InputError: no such file, or not an OpenEXR file that can be read.
    """
    if (found := file_format(path)) != "OpenEXR":
        raise InputError(f"{path}: is {found}, not OpenEXR")
    channels = {}
    with _opened(path) as image:
        parts = _parts(image)
        for part, spec in enumerate(parts):
            pixels = _read_channels(image, part, spec, range(spec.nchannels))
            for i, name in enumerate(spec.channelnames):
                channels[_full_name(parts, part, name)] = pixels[..., i]
        header = {entry.name: entry.value for entry in parts[0].extra_attribs}
    return channels, {name: value for name, value in header.items() if type(value) in (str, int, float)}


def _read_exr_rgb(path: str | Path) -> np.ndarray:
    with _opened(path) as image:
        parts = _parts(image)
        part, kind, indices = _find_colors(parts)
        primaries = _XYZ if kind == "XYZ" else _primaries(parts[part])
        matrix = None
        if kind != "Y" and not np.allclose(primaries, _REC709, rtol=0, atol=_SAME_CHROMATICITY):
            matrix = _to_rec709(primaries)
        pixels = _read_channels(image, part, parts[part], indices)
        numbers = {_number(parts[part], i) for i in indices}
    if matrix is None:
        return np.repeat(pixels, 3 // len(indices), axis=-1)
    # Red, green or blue that is no more than the rounding of the stored numbers leaves of it is not there.
    rounding = np.finfo(np.float16).eps if "half" in numbers else _MATRIX_ROUNDING
    with np.errstate(invalid="ignore"):  # infinities of different signs
        rgb = pixels @ matrix.T
        rgb[np.abs(rgb) < rounding * (np.abs(pixels) @ np.abs(matrix).T)] = 0
    return rgb.astype(np.float32)


def _find_colors(parts) -> tuple[int, str, list[int]]:
    """The part that holds the image, "RGB", "XYZ" or "Y", and the places of these channels in it."""
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
            raise _Unreadable("it holds luminance and chroma, Y, RY and BY; write it with channels R, G, B")
        if kind:
            found[part, layer] = kind
    candidates = [place for place in found if not place[1]] or list(found)
    if not candidates:
        names = sorted(_full_name(parts, part, name) for part, spec in enumerate(parts) for name in spec.channelnames)
        raise _Unreadable(f"it has no channels R, G, B or X, Y, Z and no channel Y; it has: {', '.join(names)}")
    if len(candidates) > 1:
        names = ", ".join(_full_name(parts, part, layer) for part, layer in candidates)
        raise _Unreadable(f"it holds several images: {names}; write the one that is meant with channels R, G, B")
    part, layer = candidates[0]
    kind = found[part, layer]
    return part, kind, [layers[part, layer][name] for name in kind]


def _full_name(parts, part: int, name: str) -> str:
    if len(parts) == 1:
        return name
    return f"{parts[part].getattribute('name')}.{name}".rstrip(".")


def _primaries(spec) -> Sequence[Sequence[float]]:
    """The file's chromaticities; those of Rec. 709 if it states none."""
    stated = spec.getattribute("chromaticities")
    space = spec.getattribute("colorInteropID") or "unknown"
    linear = space == "lin_rec709_scene" or space.startswith("lin_") and stated is not None
    if not linear and space not in ("unknown", "data"):
        raise _Unreadable(f'its colours are "{space}"; convert them to "lin_rec709_scene"')
    return _REC709 if stated is None else np.reshape(stated, (4, 2))


def _to_rec709(primaries) -> np.ndarray:
    """(3, 3) from linear RGB of these primaries to Rec. 709: the same light, so white is not adapted (as Mitsuba)."""
    try:
        with np.errstate(all="ignore"):
            matrix = np.linalg.solve(_to_xyz(_REC709), _to_xyz(primaries))
    except np.linalg.LinAlgError:
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        raise _Unreadable(f"its chromaticities {np.ravel(primaries).tolist()} are no primaries; mend its header")
    return matrix


def _to_xyz(primaries) -> np.ndarray:
    """(3, 3) from linear RGB to CIE XYZ (SMPTE RP 177)."""
    x, y = np.transpose(primaries)
    xyz = np.stack([x, y, 1 - x - y])
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3] / y[3])


def _parts(image) -> list:
    """The headers of all parts."""
    parts = [image.spec(part, 0) for part in range(image.spec().getattribute("oiio:subimages") or 1)]
    for spec in parts:
        _require_size(spec)
    return parts


def _read_channels(image, part: int, spec, indices: Sequence[int]) -> np.ndarray:
    """(H, W, len(indices)) float32 over the display window, from the largest level of a pyramid."""
    if spec.deep:
        raise _Unreadable("it holds deep data, many samples in a pixel; flatten it")
    first, end = min(indices), max(indices) + 1
    # One read for each kind of number: read as another, an integer would be divided by the largest one.
    kinds = {_number(spec, i) for i in indices}
    stored = {kind: _read(image, part, first, end, kind) for kind in kinds}
    pixels = np.stack([stored[_number(spec, i)][..., i - first].astype(np.float32) for i in indices], axis=-1)
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    if (x, y, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return pixels
    shown = np.zeros((spec.full_height, spec.full_width, len(indices)), np.float32)
    left, top = max(x, 0), max(y, 0)
    inside = pixels[top - y : max(spec.full_height - y, 0), left - x : max(spec.full_width - x, 0)]
    shown[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return shown


def _number(spec, channel: int) -> str:
    """ "half", "float" or "uint"."""
    return str(spec.channelformat(channel))


# ---- any format ---------------------------------------------------------------------------------------------------


class _Unreadable(Exception):
    """Why, and what to do about it."""


@contextmanager
def _opened(path: str | Path) -> Iterator:
    """The file as OpenImageIO has it; whatever goes wrong with it is an InputError that names it."""
    import OpenImageIO

    found = file_format(path)
    how = OpenImageIO.ImageSpec()
    how.attribute("oiio:UnassociatedAlpha", 1)  # else colours of PNG would be multiplied by it
    with open(path, "rb") as file:
        try:
            name = str(path)
            if name.encode("utf-8", "ignore").decode() != name:  # OpenImageIO takes no other bytes
                name = f"/dev/fd/{file.fileno()}"
            image = OpenImageIO.ImageInput.open(name, how)
            reason = OpenImageIO.geterror()
            if image is None:
                remedy = "write all channels at full size" if "ubsampled" in reason else "it is damaged, write it anew"
                raise _Unreadable(f"{reason}; {remedy}")
            yield image
        except Exception as error:  # also UnicodeDecodeError and others, as the file's bytes have it
            raise InputError(f"{path}: cannot be read as {found}: {' '.join(str(error).split())}") from None


def _read(image, part: int, first: int, end: int, number) -> np.ndarray:
    """(h, w, end - first) of one part as `number`."""
    pixels = image.read_image(part, 0, first, end, number)
    reason = image.geterror()
    if pixels is None or reason:  # a JPEG that is cut off gives both
        raise _Unreadable(f"{reason}; it is damaged, write it anew")
    return pixels


def _require_size(spec) -> None:
    if max(spec.width * spec.height, spec.full_width * spec.full_height) > MAX_PIXELS:
        raise _Unreadable(f"it has more than {MAX_PIXELS:.0e} pixels; scale it down")
