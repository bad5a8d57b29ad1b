"""Image files are read back as written, appear whole or not at all, and are refused if broken."""

import os
import struct
import zlib

import Imath
import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from PIL import Image

from pathjax.errors import InputError
from pathjax.images import (
    compare,
    file_format,
    linear_to_srgb,
    read_exr,
    read_rgb,
    srgb_to_linear,
    write_exr,
    write_png,
)
from pathjax.images.png import read_stored


@pytest.fixture
def rgb():
    return np.random.default_rng(0).random((5, 7, 3), np.float32)


def planes(rgb):
    return {name: rgb[..., k] for k, name in enumerate("RGB")}


def test_srgb_is_its_own_inverse_and_meets_known_values():
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(x)), x, atol=1e-12)
    np.testing.assert_allclose(linear_to_srgb([0, 0.0031308, 0.2140411, 1]), [0, 0.04045, 0.5, 1], atol=1e-5)


def test_exr_returns_every_bit_and_the_header(tmp_path, rgb):
    rgb[0, 0] = [np.nan, np.inf, 1e-40]
    header = {"pathjax:spp": 64, "note": "größe", "seconds": 1.5}
    write_exr(tmp_path / "a.exr", {**planes(rgb), "variance.R": rgb[::-1, ::-1, 0].astype(np.float64)}, header)
    channels, read = read_exr(tmp_path / "a.exr")
    assert sorted(channels) == ["B", "G", "R", "variance.R"]
    np.testing.assert_array_equal(np.stack([channels[k] for k in "RGB"], -1), rgb)  # strided views, too
    np.testing.assert_array_equal(channels["variance.R"], rgb[::-1, ::-1, 0])
    assert all(values.dtype == np.float32 for values in channels.values())
    assert {key: read[key] for key in header} == header


def test_exr_is_seen_by_mitsuba_as_it_was_meant(tmp_path, rgb):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    write_exr(tmp_path / "a.exr", planes(rgb), {})
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(tmp_path / "a.exr"))), rgb)


def test_a_failed_write_leaves_the_old_file_and_nothing_beside(tmp_path, rgb, monkeypatch):
    write_exr(tmp_path / "a.exr", planes(rgb), {})
    before = (tmp_path / "a.exr").read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(InputError, match="disk full"):
        write_exr(tmp_path / "a.exr", planes(rgb * 2), {})
    assert (tmp_path / "a.exr").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_an_image_for_which_there_is_no_room_is_not_lost_silently(tmp_path, rgb, name):
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, hard))
    try:
        with pytest.raises(InputError, match="cannot be written: "):
            write_exr(tmp_path / name, planes(rgb), {}) if name == "a.exr" else write_png(tmp_path / name, rgb)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("channels", "header", "words"),
    [
        ({}, {}, "one shape"),
        ({"R": np.zeros((2, 2)), "G": np.zeros((2, 3))}, {}, "one shape"),
        ({"R": np.zeros(4)}, {}, "one shape"),
        ({"R": np.zeros((0, 4))}, {}, "one shape"),
        ({"R": np.zeros((2, 2))}, {"seed": 2**31}, "32 bits"),
    ],
)
def test_what_an_exr_cannot_hold_is_refused(tmp_path, channels, header, words):
    with pytest.raises(InputError, match=words):
        write_exr(tmp_path / "a.exr", channels, header)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_missing_folder_is_refused(tmp_path, rgb, name):
    path = tmp_path / "none" / name
    with pytest.raises(InputError, match="there is no folder"):
        write_exr(path, planes(rgb), {}) if name == "a.exr" else write_png(path, rgb)


def test_png_is_srgb_rounded_clipped_and_free_of_nan(tmp_path):
    values = [[0.2158605, 0.5, 1], [np.nan, np.inf, -np.inf], [-1, 7, 0.0]]
    write_png(tmp_path / "a.png", np.array([values], np.float32))
    stored = np.asarray(Image.open(tmp_path / "a.png"))
    np.testing.assert_array_equal(stored, [[[128, 188, 255], [0, 255, 0], [0, 255, 0]]])
    with pytest.raises(InputError, match="shape"):
        write_png(tmp_path / "b.png", np.zeros((4, 4)))


def test_read_rgb_returns_what_write_png_and_write_exr_wrote(tmp_path, rgb):
    write_png(tmp_path / "a.png", rgb)
    write_exr(tmp_path / "a.EXR", planes(rgb), {})
    np.testing.assert_allclose(read_rgb(tmp_path / "a.png"), rgb, atol=0.006)
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.EXR"), rgb)
    assert read_rgb(tmp_path / "a.png").dtype == np.float32


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "P", "1", "I;16"])
def test_png_of_any_mode_becomes_rgb(tmp_path, mode):
    grey = np.array([[0, 255], [255, 0]], np.uint8)
    image = Image.fromarray(grey.astype(np.uint16) * 257) if mode == "I;16" else Image.fromarray(grey).convert(mode)
    image.save(tmp_path / "a.png")
    np.testing.assert_allclose(read_rgb(tmp_path / "a.png"), np.repeat(grey[..., None] / 255, 3, -1), atol=1e-6)


def test_raw_keeps_the_stored_numbers_and_jpeg_is_read(tmp_path):
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(tmp_path / "a.jpg", quality=100)
    np.testing.assert_allclose(read_rgb(tmp_path / "a.jpg", raw=True), 128 / 255, atol=1e-6)
    np.testing.assert_allclose(read_rgb(tmp_path / "a.jpg"), 0.2158605, atol=1e-6)


def test_a_single_luminance_channel_is_grey(tmp_path, rgb):
    write_exr(tmp_path / "a.exr", {"Y": rgb[..., 0]}, {})
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), np.repeat(rgb[..., :1], 3, -1))
    write_exr(tmp_path / "b.exr", {"depth": rgb[..., 0]}, {})
    with pytest.raises(InputError, match="no channels R, G, B .* it has: depth"):
        read_rgb(tmp_path / "b.exr")


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, bits, color, rows, interlaced=False, chunks=b""):
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, interlaced)
    parts = chunk(b"IHDR", header), chunks, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def hdr(line="# a remark", size="-Y 1 +X 2", form="rgbe", rows=bytes((200, 100, 50, 129, 0, 0, 0, 0))):
    """Return a file with uncompressed rows, which narrow images still have."""
    return f"#?RADIANCE\n{line}\nFORMAT=32-bit_rle_{form}\n\n{size}\n".encode() + rows


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.exr", b"", "not supported, as it is empty; use OpenEXR, Radiance HDR, PNG, JPEG, BMP or TGA"),
        ("a.exr", b"\x76\x2f\x31\x01\x02\0\0\0garbage", "cannot be read as OpenEXR"),
        ("a.png", b"", "not supported, as it is empty"),
        ("a.png", b"\x89PNG\r\n\x1a\n\0\0", "cannot be read as PNG: .*damaged"),
        ("a.png", png(100_000, 100_000, 8, 2, b""), "cannot be read as PNG|pixels"),
        ("a.png", png(4, 4, 8, 2, b"\0" * 10), "cannot be read as PNG: .*damaged"),
        ("a.jpg", b"\xff\xd8\xff", "cannot be read as JPEG: .*damaged"),
        ("a.hdr", b"#?RADIANCE\n", "cannot be read as Radiance HDR: .*damaged"),
        ("a.hdr", hdr(rows=b"\1\2\3"), "cannot be read as Radiance HDR: .*damaged"),
        ("a.hdr", hdr(size="+Y 1 +X 2"), 'cannot be read as Radiance HDR: its rows do not run as "-Y height'),
        ("a.hdr", hdr("GAMMA=2.2"), "cannot be read as Radiance HDR: it states a gamma"),
        ("a.hdr", hdr(form="xyze"), "cannot be read as Radiance HDR"),
        ("a.hdr", hdr(size="-Y 100000 +X 100000"), "cannot be read as Radiance HDR: .*may not exceed"),
        ("a.tif", b"II*\0", "not supported, as it begins like another format; use"),
        ("a", b"", "not supported"),
    ],
)
def test_broken_images_are_refused(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=words) as caught:
        read_rgb(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


def test_missing_images_are_refused(tmp_path):
    for read in (read_rgb, read_exr):
        with pytest.raises(InputError, match="no such file"):
            read(tmp_path / "none.exr")
        with pytest.raises(InputError, match="not a file"):
            read(tmp_path)


# ---- BMP and TGA ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["bmp", "tga"])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@pytest.mark.parametrize("raw", [False, True])
def test_bmp_and_tga_hold_srgb_like_png(tmp_path, suffix, mode, raw):
    channels = {"RGB": 3, "RGBA": 4, "L": 1}[mode]
    stored = np.random.default_rng(1).integers(0, 256, (4, 5, channels), np.uint8)
    Image.fromarray(stored if channels > 1 else stored[..., 0], mode).save(tmp_path / f"a.{suffix}")
    expected = np.broadcast_to(stored[..., :3] / 255, (4, 5, 3))
    expected = expected if raw else srgb_to_linear(expected)
    np.testing.assert_allclose(read_rgb(tmp_path / f"a.{suffix}", raw=raw), expected, atol=1e-6)


def test_packed_tga_is_unpacked(tmp_path):
    stored = np.repeat(np.arange(12, dtype=np.uint8).reshape(4, 1, 3), 5, axis=1)
    Image.fromarray(stored).save(tmp_path / "a.tga", compression="tga_rle")
    np.testing.assert_array_equal(read_stored(tmp_path / "a.tga"), stored)


# ---- Radiance HDR --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", ["EXPOSURE=8", "# a remark", "SOFTWARE=pathjax"])
def test_hdr_is_mantissas_times_a_shared_power_of_two(tmp_path, line):
    (tmp_path / "a.hdr").write_bytes(hdr(line))
    expected = np.array([[[200, 100, 50], [0, 0, 0]]]) * 2.0 ** (129 - 128 - 8)
    for raw in (False, True):
        np.testing.assert_array_equal(read_rgb(tmp_path / "a.hdr", raw=raw), expected)


def test_hdr_of_mitsuba_is_read_as_mitsuba_reads_it(tmp_path):
    """Its rows are wide enough to be compressed."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    rng = np.random.default_rng(0)
    pixels = rng.random((5, 40, 3)) * 10.0 ** rng.uniform(-4, 4, (5, 40, 1))
    pixels[:, 7:30] = pixels[:, 7:8]
    mi.Bitmap(pixels.astype(np.float32)).write(str(tmp_path / "a.hdr"))
    found = read_rgb(tmp_path / "a.hdr")
    np.testing.assert_array_equal(found, np.array(mi.Bitmap(str(tmp_path / "a.hdr"))))
    assert (abs(found - pixels) <= pixels.max(-1, keepdims=True) * 2**-7).all()


# ---- kinds of OpenEXR ---------------------------------------------------------------------------------------------

TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
REC2020 = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)


def exr(path, channels, header=None):
    with OpenEXR.File(dict(header or {}), {name: np.ascontiguousarray(x) for name, x in channels.items()}) as file:
        file.write(str(path))
    return path


def exr_parts(path, parts):
    parts = [OpenEXR.Part({"name": name}, {k: np.ascontiguousarray(x) for k, x in c.items()}) for name, c in parts]
    with OpenEXR.File(parts) as file:
        file.write(str(path))
    return path


def window(x, y, width, height):
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def named(rgb, names):
    return {name: rgb[..., k] for k, name in enumerate(names)}


@pytest.mark.parametrize(
    "names",
    [
        ["R", "G", "B"],
        ["r", "g", "b"],
        ["Beauty.R", "Beauty.G", "Beauty.B"],
        ["View Layer.Combined.R", "View Layer.Combined.G", "View Layer.Combined.B"],
    ],
)
@pytest.mark.parametrize(
    "others",
    [
        [],
        ["A"],
        ["depth.Z", "normal.X", "normal.Y", "normal.Z"],
        ["View Layer.Combined.A", "View Layer.Depth.Z", "View Layer.Vector.X", "View Layer.Vector.Y"],
    ],
)
def test_the_one_image_among_the_channels_is_read_as_it_is(tmp_path, rgb, names, others):
    exr(tmp_path / "a.exr", named(rgb, names) | {name: np.full(rgb.shape[:2], 0.5, np.float32) for name in others})
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), rgb)  # not divided by an alpha of 0.5


def test_colors_without_a_layer_come_before_those_of_layers(tmp_path, rgb):
    layers = named(rgb / 2, ["img.R", "img.G", "img.B"]) | named(rgb / 3, ["albedo.R", "albedo.G", "albedo.B"])
    depth = {"Z": rgb[..., 0]}
    exr(tmp_path / "a.exr", planes(rgb) | layers | depth | {"Y": rgb[..., 1]})
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), rgb)
    exr(tmp_path / "y.exr", {"Y": rgb[..., 1]} | layers | depth)
    np.testing.assert_array_equal(read_rgb(tmp_path / "y.exr"), np.repeat(rgb[..., 1:2], 3, -1))
    exr(tmp_path / "b.exr", layers)
    with pytest.raises(InputError, match=r"b\.exr.* several images: albedo, img; write the one that is meant"):
        read_rgb(tmp_path / "b.exr")


def test_parts_of_a_file_are_layers_by_their_names(tmp_path, rgb):
    normal = named(rgb, "XYZ")
    exr_parts(tmp_path / "a.exr", [("depth", {"Z": rgb[..., 0]}), ("normal", normal), ("beauty", planes(rgb))])
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), rgb)
    assert sorted(read_exr(tmp_path / "a.exr")[0])[:4] == ["beauty.B", "beauty.G", "beauty.R", "depth.Z"]
    exr_parts(tmp_path / "b.exr", [("left", planes(rgb)), ("right", planes(rgb))])
    with pytest.raises(InputError, match="several images: left, right; write"):
        read_rgb(tmp_path / "b.exr")
    exr_parts(tmp_path / "c.exr", [("depth", {"Z": rgb[..., 0]}), ("normal", normal)])
    with pytest.raises(InputError, match="it has: depth.Z, normal.X, normal.Y, normal.Z"):
        read_rgb(tmp_path / "c.exr")


@pytest.mark.parametrize("names", ["XYZ", "RGB"])
def test_xyz_becomes_rgb_by_the_matrix_of_mitsuba(tmp_path, rgb, names):
    rgb[0, 0], rgb[0, 1], rgb[0, 2] = [1, 0, 0], [0, 0, 7], 0
    xyz = (rgb @ TO_XYZ.T).astype(np.float32)
    header = {"chromaticities": (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)} if names == "RGB" else {}
    exr(tmp_path / "a.exr", named(xyz, names) | {"A": rgb[..., 0]}, header)
    read = read_rgb(tmp_path / "a.exr")
    np.testing.assert_allclose(read, rgb, atol=7 * 3e-6)  # the matrix has entries up to 3, given to six digits
    assert read.min() >= 0  # a fit refuses negative light, and there was none
    exr(tmp_path / "half.exr", named(xyz.astype(np.float16), names), header)
    read = read_rgb(tmp_path / "half.exr")
    np.testing.assert_allclose(read, rgb, atol=7 * 5 * 2**-11)
    assert read.min() >= 0


def test_chromaticities_become_those_of_rec_709(tmp_path, rgb):
    # ITU-R BT.2087-0, four digits: the inverse of its matrix from Rec. 709 to Rec. 2020.
    matrix = np.linalg.inv([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
    exr(tmp_path / "a.exr", planes(rgb), {"chromaticities": REC2020})
    np.testing.assert_allclose(read_rgb(tmp_path / "a.exr"), rgb @ matrix.T, atol=5e-4)
    for white in ((0.3127, 0.329), (0.31271, 0.32902), (0.312713, 0.329016)):
        exr(tmp_path / "b.exr", planes(rgb), {"chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, *white)})
        np.testing.assert_array_equal(read_rgb(tmp_path / "b.exr"), rgb)
    exr(tmp_path / "y.exr", {"Y": rgb[..., 0]}, {"chromaticities": REC2020})
    np.testing.assert_array_equal(read_rgb(tmp_path / "y.exr"), np.repeat(rgb[..., :1], 3, -1))


@pytest.mark.parametrize("stated", [(0.0,) * 8, (0.3, 0.3) * 4, (*REC2020[:6], 0.3, 0.0), (np.nan,) * 8])
def test_chromaticities_without_meaning_are_refused(tmp_path, rgb, stated):
    exr(tmp_path / "a.exr", planes(rgb), {"chromaticities": stated})
    with pytest.raises(InputError, match="are no primaries; mend its header"):
        read_rgb(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("space", "primaries", "read"),
    [
        ("lin_rec709_scene", None, True),
        ("unknown", None, True),
        ("lin_ap0_scene", ACES, True),
        ("lin_ap0_scene", None, False),
        ("srgb_rec709_display", REC2020, False),
    ],
)
def test_a_color_space_that_the_header_names_only_is_refused(tmp_path, rgb, space, primaries, read):
    header = {"colorInteropID": space} | ({"chromaticities": primaries} if primaries else {})
    exr(tmp_path / "a.exr", planes(rgb), header)
    if read:
        read_rgb(tmp_path / "a.exr")
        return
    with pytest.raises(InputError, match=f'its colours are "{space}"; convert them'):
        read_rgb(tmp_path / "a.exr")


def test_half_float_and_integer_channels_hold_plain_numbers(tmp_path, rgb):
    numbers = {"R": rgb[..., 0].astype(np.float16), "G": rgb[..., 1], "B": np.arange(35, dtype=np.uint32).reshape(5, 7)}
    exr(tmp_path / "a.exr", numbers)
    channels, _ = read_exr(tmp_path / "a.exr")
    for name, values in numbers.items():
        np.testing.assert_array_equal(channels[name], values.astype(np.float32))
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), np.stack([channels[k] for k in "RGB"], -1))
    exr(tmp_path / "b.exr", {name: numbers["B"] for name in "RGB"})
    np.testing.assert_array_equal(read_rgb(tmp_path / "b.exr")[..., 2], numbers["B"])


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"])
def test_every_compression_is_read(tmp_path, compression):
    y, x = np.mgrid[0:40, 0:70]
    smooth = np.stack([1 + np.sin(x / 9), 1 + np.cos(y / 7), 1 + np.sin((x + y) / 11)], -1).astype(np.float16)
    exr(tmp_path / "a.exr", planes(smooth), {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")})
    # B44 keeps six bits of a difference in a block of 4 x 4, the errors of DWA are invisible; the others are lossless.
    lossy = compression.startswith(("B44", "DWA"))
    np.testing.assert_allclose(read_rgb(tmp_path / "a.exr"), smooth.astype(np.float32), atol=0.05 if lossy else 0)


def test_tiles_pyramids_and_the_order_of_lines_leave_the_image_as_it_is(tmp_path, rgb):
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 4, 2
    exr(tmp_path / "tiles.exr", planes(rgb), {"type": OpenEXR.tiledimage, "tiles": tiles})
    exr(tmp_path / "lines.exr", planes(rgb), {"lineOrder": OpenEXR.DECREASING_Y, "pixelAspectRatio": 2.0})
    image = OpenImageIO.ImageBuf(rgb)
    assert OpenImageIO.ImageBufAlgo.make_texture(OpenImageIO.MakeTxTexture, image, str(tmp_path / "pyramid.exr"))
    for name in ("tiles.exr", "lines.exr", "pyramid.exr"):
        np.testing.assert_array_equal(read_rgb(tmp_path / name), rgb)


@pytest.mark.parametrize("x", [-20, -3, 0, 2, 5, 20])
@pytest.mark.parametrize("y", [-5, -2, 0, 3, 5])
def test_the_display_window_is_read_and_is_0_outside_the_data_window(tmp_path, rgb, x, y):
    display = window(-1, 2, 8, 4)
    exr(tmp_path / "a.exr", planes(rgb), {"dataWindow": window(x, y, 7, 5), "displayWindow": display})
    expected = np.zeros((4, 8, 3), np.float32)
    for i in range(4):
        for j in range(8):
            if 0 <= i + 2 - y < 5 and 0 <= j - 1 - x < 7:
                expected[i, j] = rgb[i + 2 - y, j - 1 - x]
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), expected)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0]["G"], expected[..., 1])


def test_a_value_that_is_not_finite_spoils_its_own_pixel_alone(tmp_path, rgb):
    lost = np.zeros(rgb.shape[:2], bool)
    rgb[1, 2], rgb[3, 4], rgb[4, 0] = [np.nan, 1, 1], [np.inf, -np.inf, 1], [1, 1, -np.inf]
    lost[1, 2] = lost[3, 4] = lost[4, 0] = True
    for name, header in (("RGB", {}), ("XYZ", {}), ("RGB", {"chromaticities": ACES})):
        exr(tmp_path / "a.exr", named(rgb, name), header)
        np.testing.assert_array_equal(np.isfinite(read_rgb(tmp_path / "a.exr")).all(-1), ~lost)


DEEP = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}


def samples(height, width):
    pixels = np.empty((height, width), object)
    for i, j in np.ndindex(height, width):
        pixels[i, j] = np.ones(i + j + 1, np.float32)
    return pixels


def deep(path, _):
    exr(path, {name: samples(2, 3) for name in "RGB"}, DEEP)


def test_an_image_beside_deep_data_is_read(tmp_path, rgb):
    image = OpenEXR.Part({"name": "beauty"}, {k: np.ascontiguousarray(x) for k, x in planes(rgb).items()})
    with OpenEXR.File([image, OpenEXR.Part({"name": "deep", **DEEP}, {"Z": samples(5, 7)})]) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), rgb)
    with pytest.raises(InputError, match="holds deep data"):
        read_exr(tmp_path / "a.exr")


def luminance_and_chroma(path, step):
    full = np.ones((4, 6), np.float32)
    channels = {"Y": (1, full), "RY": (step, full[::step, ::step]), "BY": (step, full[::step, ::step])}
    header = OpenEXR.Header(6, 4)
    number = Imath.PixelType(Imath.PixelType.FLOAT)
    header["channels"] = {name: Imath.Channel(number, step, step) for name, (step, _) in channels.items()}
    file = OpenEXR.OutputFile(str(path), header)
    file.writePixels({name: x.tobytes() for name, (_, x) in channels.items()})
    file.close()


@pytest.mark.parametrize(
    ("write", "argument", "words"),
    [
        (deep, None, "holds deep data.*; flatten it"),
        (luminance_and_chroma, 1, "luminance and chroma.*; write it with channels R, G, B"),
        (luminance_and_chroma, 2, 'ubsampled channels.*"BY".*; write all channels at full size'),
    ],
)
def test_what_is_no_plain_image_is_refused_by_name(tmp_path, capfd, write, argument, words):
    write(tmp_path / "a.exr", argument)
    with pytest.raises(InputError, match=rf"a\.exr.*{words}"):
        read_rgb(tmp_path / "a.exr")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.jpg"])
def test_a_file_that_is_cut_off_or_damaged_is_refused(tmp_path, capfd, name, share):
    pixels = np.random.default_rng(1).random((64, 64, 3), np.float32)
    if name == "a.exr":
        write_exr(tmp_path / name, planes(pixels), {})
    else:
        Image.fromarray((pixels * 255).astype(np.uint8)).save(tmp_path / name)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(share * (len(data) - 12))])  # IEND holds nothing
    with pytest.raises(InputError, match=f"{name}: cannot be read as .*write it anew"):
        read_rgb(tmp_path / name)
    if name == "a.png":  # the others have no checksum
        middle = len(data) // 2
        (tmp_path / name).write_bytes(data[:middle] + bytes(8) + data[middle + 8 :])
        with pytest.raises(InputError, match="a.png: cannot be read as PNG.*write it anew"):
            read_rgb(tmp_path / name)
    assert capfd.readouterr().out == ""  # where --json prints


@pytest.mark.parametrize("suffix", [".exr", ".png", ".jpg", ".tif", ".hdr", ""])
def test_a_format_is_told_by_content_not_by_name(tmp_path, rgb, suffix):
    write_exr(tmp_path / "a.exr", planes(rgb), {})
    write_png(tmp_path / "a.png", rgb)
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(tmp_path / "a.jpg", quality=100)
    for name, kind in (("a.exr", "OpenEXR"), ("a.png", "PNG"), ("a.jpg", "JPEG")):
        copy = tmp_path / f"copy{suffix}"
        copy.write_bytes((tmp_path / name).read_bytes())
        assert file_format(copy) == kind
        np.testing.assert_array_equal(read_rgb(copy), read_rgb(tmp_path / name))
    write_png(tmp_path / "b.exr", rgb)
    with pytest.raises(InputError, match="is PNG, not OpenEXR"):
        read_exr(tmp_path / "b.exr")


@pytest.mark.parametrize("name", ["b%04d.exr", "b?x=1.exr", "größe.exr", os.fsdecode(b"b\xff.exr")])
def test_names_of_any_bytes_are_written_and_read(tmp_path, rgb, name):
    write_exr(tmp_path / name, planes(rgb), {})
    np.testing.assert_array_equal(read_rgb(tmp_path / name), rgb)


# ---- beside Mitsuba -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    return mi


def mitsuba_render(mi, path, integrator=None, **film):
    sphere = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.1]}}}
    light = {"type": "point", "position": [3, 3, 5], "intensity": {"type": "rgb", "value": [0, 40, 80]}}
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 12, "height": 8, **film}
    sampler = {"type": "independent", "sample_count": 4}
    sensor = {"type": "perspective", "to_world": view, "film": film, "sampler": sampler}
    integrator = integrator or {"type": "path"}
    scene = mi.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": sensor, "sphere": sphere, "light": light}
    )
    mi.render(scene, seed=1)
    scene.sensors()[0].film().bitmap().write(str(path))
    return path


@pytest.mark.parametrize("component", ["float32", "float16"])
@pytest.mark.parametrize("pixels", ["rgba", "xyz", "xyza"])
def test_one_render_of_mitsuba_is_one_image_in_all_its_pixel_formats(tmp_path, mitsuba, pixels, component):
    rgb = mitsuba_render(mitsuba, tmp_path / "rgb.exr", pixel_format="rgb")
    other = mitsuba_render(mitsuba, tmp_path / "a.exr", pixel_format=pixels, component_format=component)
    comparison = compare(str(other), str(rgb))
    # Half precision rounds to 2^-11, which the matrix amplifies at most 5 times.
    assert comparison.rel_mse < ((5 * 2.0**-11) ** 2 if component == "float16" else 1e-11)
    assert comparison.image.max() > 0.1 and comparison.image.min() >= 0
    assert comparison.hdr


def test_renders_of_mitsuba_with_other_channels_are_read(tmp_path, mitsuba):
    rgb = read_rgb(mitsuba_render(mitsuba, tmp_path / "rgb.exr", pixel_format="rgb"))
    path = {"type": "path"}
    aov = {"type": "aov", "aovs": "dd:depth,nn:sh_normal", "img": path, "again": path}
    several = mitsuba_render(mitsuba, tmp_path / "aov.exr", aov)
    assert {"dd.T", "nn.X", "img.R", "again.R"} <= read_exr(several)[0].keys()
    assert read_rgb(several).shape == rgb.shape
    moment = mitsuba_render(mitsuba, tmp_path / "moment.exr", {"type": "moment", "img": path}, pixel_format="rgb")
    np.testing.assert_allclose(read_rgb(moment), rgb, atol=1e-6)  # beside m2_img.X, ..., which are no colours
    grey = read_rgb(mitsuba_render(mitsuba, tmp_path / "y.exr", pixel_format="luminance_alpha"))
    np.testing.assert_allclose(grey, np.repeat(rgb @ TO_XYZ[1][:, None], 3, -1), atol=1e-5)


def test_primaries_alpha_and_curves_are_those_of_mitsubas_textures(tmp_path, mitsuba, rgb):
    """Constant images of each kind agree with Mitsuba's bitmap texture."""
    color = np.broadcast_to(np.float32([0.2, 0.3, 0.1]), (4, 4, 3))
    half = {"A": np.full((4, 4), 0.5, np.float32)}
    files = [
        exr(tmp_path / "rgba.exr", planes(color) | half),
        exr(tmp_path / "xyz.exr", named(color, "XYZ")),
        exr(tmp_path / "aces.exr", planes(color), {"chromaticities": ACES}),
        exr(tmp_path / "rec2020.exr", planes(color), {"chromaticities": REC2020}),
        exr(tmp_path / "y.exr", {"Y": color[..., 0]} | half),
    ]
    rgba = np.broadcast_to(np.uint8([10, 100, 200, 128]), (4, 4, 4))
    for mode in ("RGBA", "LA", "RGB", "L", "P", "1"):
        files.append(tmp_path / f"{mode}.png")
        Image.fromarray(rgba).convert(mode).save(files[-1])
    files.append(tmp_path / "linear.png")
    files[-1].write_bytes(
        png(1, 1, 16, 2, b"\0" + struct.pack(">3H", 1, 30000, 60001), chunks=chunk(b"gAMA", struct.pack(">I", 100000)))
    )
    at = mitsuba.SurfaceInteraction3f()
    at.uv = [0.5, 0.5]
    for file in files:
        how = {"type": "bitmap", "filename": str(file), "filter_type": "nearest", "format": "variant"}  # else fp16
        texture = mitsuba.load_dict(how)
        ours = read_rgb(file)
        theirs = np.array(texture.eval(at))
        np.testing.assert_allclose(ours[ours.shape[0] // 2, ours.shape[1] // 2], theirs, atol=3e-5, err_msg=file.name)
    turned = Image.Exif()
    turned[0x0112] = 6  # Orientation: turn by 90 degrees
    Image.fromarray(rgba[:2, :, :3]).save(tmp_path / "turned.jpg", exif=turned)
    assert read_rgb(tmp_path / "turned.jpg").shape[1::-1] == tuple(mitsuba.Bitmap(str(tmp_path / "turned.jpg")).size())


# ---- kinds of PNG and JPEG ----------------------------------------------------------------------------------------

CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
ADAM7 = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]


def packed(pixels, bits):
    """Return rows of (h, w, channels) as PNG stores them, unfiltered."""
    rows = b""
    for row in pixels.reshape(len(pixels), -1):
        samples = "".join(f"{sample:0{bits}b}" for sample in row)
        samples += "0" * (-len(samples) % 8)
        rows += b"\0" + int(samples, 2).to_bytes(len(samples) // 8, "big")
    return rows


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize(
    ("color", "bits"),
    [(0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16), (3, 1), (3, 2), (3, 4), (3, 8)]
    + [(4, 8), (4, 16), (6, 8), (6, 16)],
)
def test_png_of_every_kind_gives_the_stored_integers(tmp_path, capfd, color, bits, interlaced):
    rng = np.random.default_rng(bits)
    pixels = rng.integers(0, 2**bits, (11, 13, CHANNELS[color]))
    parts = [pixels[i::di, j::dj] for i, j, di, dj in ADAM7] if interlaced else [pixels]
    chunks, expected = b"", pixels[..., :3] if color in (2, 6) else np.repeat(pixels[..., :1], 3, -1)
    if color == 3:
        palette = rng.integers(0, 256, (2**bits, 3), np.uint8)
        chunks = chunk(b"PLTE", palette.tobytes()) + chunk(b"tRNS", bytes(range(2**bits)))
        expected = palette[pixels[..., 0]]
    elif bits < 8:
        expected = expected * (255 // (2**bits - 1))
    rows = b"".join(packed(part, bits) for part in parts)
    (tmp_path / "a.png").write_bytes(png(13, 11, bits, color, rows, interlaced, chunks))
    stored = read_stored(tmp_path / "a.png")
    assert stored.dtype == (np.uint16 if bits == 16 else np.uint8)
    np.testing.assert_array_equal(stored, expected)
    linear = srgb_to_linear(expected / np.iinfo(stored.dtype).max)
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), linear.astype(np.float32))
    raw = (expected / np.iinfo(stored.dtype).max).astype(np.float32)
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png", raw=True), raw)
    assert capfd.readouterr() == ("", "")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "chunks",
    [
        chunk(b"gAMA", struct.pack(">I", 100000)),
        chunk(b"gAMA", struct.pack(">I", 0)) * 2,
        chunk(b"sRGB", b"\0") + chunk(b"gAMA", struct.pack(">I", 100000)),
        chunk(b"cHRM", struct.pack(">8I", *[1] * 8)),
        chunk(b"iCCP", b"x\0\0" + zlib.compress(b"no profile" * 20)),
        chunk(b"tRNS", b"\0\x80\0\x80\0\x80"),
        chunk(b"pHYs", b"\0"),
        chunk(b"eXIf", b"MM\0*no exif"),
        chunk(b"tEXt", b"a\0b")[:-1] + b"\0",
    ],
    ids=["gAMA", "gAMA 0 twice", "sRGB and gAMA", "cHRM", "iCCP", "tRNS", "pHYs", "eXIf", "tEXt"],
)
def test_what_a_png_says_beside_its_pixels_changes_nothing_and_warns_of_nothing(tmp_path, capfd, chunks):
    rows = (b"\0" + bytes([0, 128, 0, 128, 0, 128, 255, 255, 0, 1, 2, 3])) * 2
    (tmp_path / "a.png").write_bytes(png(2, 2, 16, 2, rows, chunks=chunks))
    np.testing.assert_array_equal(read_stored(tmp_path / "a.png")[0], [[128, 128, 128], [65535, 1, 515]])
    assert capfd.readouterr() == ("", "")


def test_of_an_animation_the_still_image_is_read(tmp_path, capfd):
    first = Image.fromarray(np.full((4, 4, 3), 50, np.uint8))
    first.save(tmp_path / "a.png", save_all=True, append_images=[first.point(lambda x: 2 * x)])
    assert (read_stored(tmp_path / "a.png") == 50).all()
    assert capfd.readouterr() == ("", "")


def test_jpeg_for_printers_is_refused_by_name_and_grey_is_read(tmp_path, capfd):
    picture = Image.fromarray(np.full((8, 8, 3), 128, np.uint8))
    picture.convert("CMYK").save(tmp_path / "a.jpg")
    with pytest.raises(InputError, match=r"a\.jpg.* it is CMYK.*; convert it to RGB"):
        read_rgb(tmp_path / "a.jpg")
    picture.convert("L").save(tmp_path / "b.jpg", quality=100)
    assert (read_stored(tmp_path / "b.jpg") == 128).all()
    assert capfd.readouterr() == ("", "")
