"""Files appear whole or not at all; errors that can be known before the work are reported before it."""

import os

import numpy as np
import pytest

from pathjax.errors import InputError
from pathjax.images import read_exr, write_exr, write_png
from pathjax.system.files import check_writable, encodable, write_text

PIXELS = {name: np.full((4, 4), 0.5, np.float32) for name in "RGB"}
# A byte that UTF-8 never contains, as Python represents it in file names.
BYTE = "\udcff"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("size", [4, 64])
@pytest.mark.parametrize("kind", ["exr", "png"])
def test_a_full_disk_is_noticed_however_small_the_image(tmp_path, kind, size):
    path = tmp_path / f"a.{kind}"
    path.write_bytes(b"old")
    (tmp_path / f".{path.name}.{os.getpid()}.part").symlink_to("/dev/full")
    rgb = np.random.default_rng(0).random((size, size, 3), np.float32)
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        write_exr(path, {c: rgb[..., i] for i, c in enumerate("RGB")}, {}) if kind == "exr" else write_png(path, rgb)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_names_and_headers_that_are_not_utf8(tmp_path):
    path = tmp_path / f"a{BYTE}.exr"
    write_exr(path, PIXELS, {"scene": f"größe{BYTE}.xml"})
    assert os.listdir(os.fsencode(tmp_path)) == [b"a\xff.exr"]
    channels, header = read_exr(path)
    np.testing.assert_array_equal(channels["G"], PIXELS["G"])
    assert header["scene"] == r"größe\udcff.xml"
    write_text(tmp_path / f"b{BYTE}.md", f"# {BYTE}")
    assert (tmp_path / f"b{BYTE}.md").read_text(encoding="utf-8") == r"# \udcff"


def test_text_that_an_encoding_lacks_is_escaped():
    assert encodable("größe") == "größe"
    assert encodable("größe", "ascii") == r"gr\xf6\xdfe"


@pytest.mark.parametrize(
    "name, says",
    [
        ("none/a.exr", "there is no folder"),
        ("folder", "is a folder"),
        ("folder/file/a.exr", "there is no folder"),
        ("a" * 255, "File name too long"),
        ("a\0b", "cannot be written"),
        ("read.exr", "is read by the same command"),
        ("./folder/../read.exr", "is read by the same command"),
    ],
)
def test_what_cannot_be_written_is_refused_before_the_work(tmp_path, name, says):
    (tmp_path / "folder").mkdir()
    for file in ("folder/file", "read.exr", "there.exr"):
        (tmp_path / file).write_bytes(b"old")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=says):
        check_writable(f"{tmp_path}/{name}", [tmp_path / "none.xml", tmp_path / "read.exr"])
    check_writable(tmp_path / "there.exr", [tmp_path / "read.exr"])
    check_writable(tmp_path / "new.exr")
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "there.exr").read_bytes() == b"old"


def test_read_only_files_are_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "a.md"
    path.write_text("old")
    path.chmod(0o444)
    if os.access(path, os.W_OK):  # root may
        monkeypatch.setattr(os, "access", lambda *_: False)
    for write in (check_writable, lambda path: write_text(path, "new")):
        with pytest.raises(InputError, match="is read-only"):
            write(path)
    assert path.read_text() == "old"
