"""Serialized meshes: both versions, single and double precision, several in a file; other files are refused."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

import pathjax as pj
from pathjax.errors import InputError
from pathjax.io import mesh

VERTICES = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.5)])
FACES = np.array([(0, 1, 2), (0, 2, 3)])
NORMALS = np.array([(0, 0, 1), (0, 0.6, 0.8), (0, 0, 1), (0, 0, 1)])
UV = np.array([(0, 0), (1, 0), (1, 0.75), (0, 1)])
COLORS = np.arange(12).reshape(4, 3) / 12
SINGLE, DOUBLE = 0x1000, 0x2000
# Flag bits and the data that they announce, in the order of the file.
OPTIONAL = {0x0001: NORMALS, 0x0002: UV, 0x0008: COLORS}
VERSIONS = pytest.mark.parametrize("version", [3, 4])


def stream(version, flags=SINGLE, vertices=VERTICES, faces=FACES, name="n\u00e9"):
    real = "<f8" if flags & DOUBLE else "<f4"
    numbers = [vertices, *(values for bit, values in OPTIONAL.items() if flags & bit)]
    data = struct.pack("<I", flags) + (name.encode() + b"\0" if version == 4 else b"")
    data += struct.pack("<QQ", len(vertices), len(faces)) + b"".join(np.asarray(x, real).tobytes() for x in numbers)
    return struct.pack("<HH", 0x041C, version) + zlib.compress(data + np.asarray(faces, "<u4").tobytes())


def joined(version, streams):
    places = np.cumsum([0, *map(len, streams)])[:-1].astype("<u8" if version == 4 else "<u4")
    return b"".join(streams) + places.tobytes() + struct.pack("<I", len(streams))


@VERSIONS
@pytest.mark.parametrize("flags", [SINGLE, DOUBLE, SINGLE | 1, SINGLE | 2, SINGLE | 8, SINGLE | 0x10, DOUBLE | 0xB, 0])
def test_what_the_flags_announce_is_read(load, version, flags):
    found = load("serialized", joined(version, [stream(version, flags)])).mesh
    np.testing.assert_allclose(found.vertices, VERTICES, rtol=0 if flags & DOUBLE else 1e-7)
    np.testing.assert_array_equal(found.faces, FACES)
    if flags & 1:
        np.testing.assert_allclose(found.normals, NORMALS, atol=1e-7)
    else:
        assert found.smooth
    if flags & 2:
        np.testing.assert_array_equal(found.uv, UV)
    else:
        assert found.uv is None


@VERSIONS
def test_shape_index_chooses_among_the_meshes_of_a_file(load, version):
    streams = [stream(version, vertices=VERTICES * k) for k in (1, 2, 3)]
    for k in (0, 1, 2):
        found = load("serialized", joined(version, streams), part=k, face_normals=True).mesh
        np.testing.assert_array_equal(found.vertices, VERTICES * (k + 1))
        assert found.normals is None


@VERSIONS
def test_the_first_mesh_needs_no_table(load, version):
    assert len(load("serialized", stream(version)).mesh.faces) == 2


@VERSIONS
def test_a_mesh_that_is_not_there_is_refused(write, version):
    path = write("serialized", joined(version, [stream(version)] * 2))
    with pytest.raises(InputError, match=r"mesh.serialized: holds 2 meshes, 0 to 1; there is no shape_index 2"):
        mesh.load(path, "serialized", np.eye(4), part=2)


@VERSIONS
def test_a_file_that_is_cut_off_is_refused_wherever_it_ends(refused, version):
    data = stream(version, DOUBLE | 3)
    for end in range(len(data) - 8):  # the last bytes are a mark and a checksum
        message = refused("serialized", data[:end])
        assert "ends before" in message or "no mesh at byte 0" in message


def test_other_versions_and_formats_are_told(refused):
    assert "is of version 2 of" in refused("serialized", struct.pack("<HH", 0x041C, 2) + b"abc")
    assert "no mesh at byte 0" in refused("serialized", b"solid")
    assert "no mesh at byte 0" in refused("serialized", b"")
    assert "damaged" in refused("serialized", struct.pack("<HH", 0x041C, 4) + b"no zlib stream")


def test_counts_that_no_file_holds_take_no_memory(refused):
    head = struct.pack("<HH", 0x041C, 3)
    bomb = struct.pack("<IQQ", SINGLE, 1 << 60, 1 << 60) + bytes(1 << 20)
    assert "ends before" in refused("serialized", head + zlib.compress(bomb))


@pytest.mark.parametrize("flags", [SINGLE, DOUBLE | 0xB, SINGLE | 0x10])
@VERSIONS
def test_meshes_are_those_of_mitsuba(write, version, flags):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    path = write("serialized", joined(version, [stream(version, vertices=VERTICES + 7), stream(version, flags)]))
    to_world = np.diag([2.0, 1, -1, 1])
    theirs = mi.traverse(
        mi.load_dict(
            {
                "type": "serialized",
                "filename": str(path),
                "shape_index": 1,
                "to_world": mi.ScalarTransform4f(to_world),
            }
        )
    )
    ours, _ = mesh.load(path, "serialized", to_world, part=1)

    def expected(name, width):
        return np.asarray(theirs[name]).reshape(-1, width)

    faces = expected("faces", 3)
    corners = expected("vertex_positions", 3)[faces]
    np.testing.assert_allclose(ours.vertices[ours.faces].sum(1), corners.sum(1), atol=1e-6)
    if flags & 2:
        np.testing.assert_allclose(ours.uv, expected("vertex_texcoords", 2), atol=1e-6)
    np.testing.assert_allclose(np.abs((ours.normals * expected("vertex_normals", 3)).sum(1)), 1, atol=1e-6)


def test_a_scene_file_names_the_mesh(write_scene, tmp_path):
    (tmp_path / "two.serialized").write_bytes(joined(4, [stream(4), stream(4, vertices=VERTICES * 2)]))
    shape = (
        f'<shape type="serialized"><string name="filename" value="{tmp_path}/two.serialized"/>'
        '<integer name="shape_index" value="1"/></shape><emitter type="constant"/>'
    )
    scene = pj.load_scene(write_scene(shape))
    assert np.asarray(scene.geometry.tables[0].vertices).max() == 2
