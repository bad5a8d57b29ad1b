"""Images: what is written is read back, files appear whole or not at all, broken ones are refused."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from pathjax.errors import InputError
from pathjax.io.image import linear_to_srgb, read_exr, read_rgb, srgb_to_linear, write_exr, write_png


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


def png(width, height, bits, color, rows):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.exr", b"", "cannot be read as OpenEXR"),
        ("a.exr", b"\x76\x2f\x31\x01\x02\0\0\0garbage", "cannot be read as OpenEXR"),
        ("a.png", b"", "cannot be read as an image"),
        ("a.png", b"\x89PNG\r\n\x1a\n\0\0", "cannot be read as an image"),
        ("a.png", png(1, 1, 16, 2, b"\0" * 7), "16-bit colour PNG"),
        ("a.png", png(100_000, 100_000, 8, 2, b""), "cannot be read as an image|pixels"),
        ("a.png", png(4, 4, 8, 2, b"\0" * 10), "cannot be read as an image"),
        ("a.jpg", b"\xff\xd8\xff", "cannot be read as an image"),
        ("a.tif", b"", '".tif" images are not supported'),
        ("a", b"", "are not supported"),
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
        with pytest.raises(InputError, match="not a file|not supported"):
            read(tmp_path)
