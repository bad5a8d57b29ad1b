"""glTF: triangles lie where nodes and accessors put them; unsupported features that would change them are refused."""

import base64
import json
import struct

import numpy as np
import pytest

# The unit square in the xy plane, its corners in the order of a strip: the first triangle is 0, 1, 2.
POSITIONS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], float)
NORMALS = np.array([(0, 0.6, 0.8)] * 4)
UV = np.array([(0.25, 0.125), (0.75, 0.125), (0.25, 0.5), (0.75, 0.5)])
FACES = [0, 1, 2, 1, 3, 2]
CODES = {"i1": 5120, "u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}


class Gltf:
    """Builder of a file with one square under one node."""

    def __init__(self, node=(), mode=None):
        self.data = b""
        primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3}
        self.header = {
            "asset": {"version": "2.0"},
            "bufferViews": [],
            "accessors": [],
            "meshes": [{"primitives": [primitive if mode is None else {**primitive, "mode": mode}]}],
            "nodes": [{"mesh": 0, **dict(node)}],
            "scenes": [{"nodes": [0]}],
        }
        self.primitive = self.header["meshes"][0]["primitives"][0]
        for values in (POSITIONS, NORMALS, UV):
            self.accessor(values, "<f4")
        self.accessor(np.array(FACES), "<u2")

    def view(self, values, dtype, stride=None, before=0):
        """Append a bufferView, each row padded with rubbish to `stride` bytes, and return its index."""
        rows = np.asarray(values, dtype).reshape(len(values), -1)
        rows = rows.view("u1").reshape(len(values), -1)
        if stride:
            rows = np.concatenate([rows, np.full((len(rows), stride - rows.shape[1]), 0x7F, "u1")], axis=1)
        content = b"\x7f" * before + rows.tobytes()
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.header["bufferViews"].append({**view, "byteStride": stride} if stride else view)
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values, dtype, number=None, stride=None, before=0, **more):
        """Append an accessor, or replace one."""
        kind = "SCALAR" if np.ndim(values) == 1 else f"VEC{np.shape(values)[1]}"
        made = {"bufferView": self.view(values, dtype, stride, before), "byteOffset": before, "type": kind}
        made |= {"componentType": CODES[dtype], "count": len(values), **more}
        accessors = self.header["accessors"]
        if number is None:
            accessors.append(made)
        else:
            accessors[number] = made

    def sparse(self, places, values, dtype, index="<u2"):
        indices = {"bufferView": self.view(places, index), "componentType": CODES[index]}
        return {"count": len(places), "indices": indices, "values": {"bufferView": self.view(values, dtype)}}

    def glb(self):
        text = json.dumps({**self.header, "buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.data), b"BIN\0")
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(self.data)) + chunks + self.data

    def gltf(self, uri):
        return json.dumps({**self.header, "buffers": [{"byteLength": len(self.data), "uri": uri}]})

    def embedded(self):
        return self.gltf("data:application/octet-stream;base64," + base64.b64encode(self.data).decode())


def assert_square(loaded, size=1.0, tolerance=1e-6):
    """Assert that the whole square is there, facing up, each corner with its normal and uv."""
    assert loaded.area == pytest.approx(size, rel=tolerance)
    assert loaded.area_vectors.sum(axis=0) == pytest.approx([0, 0, size], abs=tolerance)
    place = np.round(loaded.mesh.vertices[:, :2]).astype(int) @ [1, 2]
    np.testing.assert_allclose(loaded.mesh.uv, UV[place], atol=tolerance)
    np.testing.assert_allclose(loaded.mesh.normals, NORMALS[place], atol=tolerance)


def test_sparse_accessors_replace_values(load):
    """The same square, with one corner, two uvs and one index stored apart from the others."""
    file = Gltf()
    wrong = POSITIONS.copy()
    wrong[3] = 9, 9, 9
    file.accessor(wrong, "<f4", 0, sparse=file.sparse([3], POSITIONS[3:], "<f4"))
    file.accessor(UV[[0, 0, 0, 3]], "<f4", 2, sparse=file.sparse([1, 2], UV[1:3], "<f4", "<u4"))
    file.accessor(np.array([0, 1, 2, 0, 3, 2]), "<u2", 3, sparse=file.sparse([3], [1], "<u2", "u1"))
    for kind, content in (("glb", file.glb()), ("gltf", file.embedded())):
        assert_square(load(kind, content))


def test_sparse_accessors_without_a_view_replace_zeros(load):
    file = Gltf()
    sparse = file.sparse([1, 2, 3], POSITIONS[1:], "<f4")
    file.header["accessors"][0] = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse}
    assert_square(load("glb", file.glb()))


@pytest.mark.parametrize("name", ["my mesh.bin", "a%20b.bin", "caf\xe9 #1?.bin", "50% off.bin"])
def test_buffers_beside_the_file_may_have_any_name(load, tmp_path, name):
    file = Gltf()
    (tmp_path / name).write_bytes(file.data)
    quoted = "".join(c if c.isascii() and c.isalnum() else "".join(f"%{b:02X}" for b in c.encode()) for c in name)
    assert_square(load("gltf", file.gltf(quoted)))
    assert_square(load("gltf", file.gltf(name)))  # as written by programs that do not quote names


@pytest.mark.parametrize("start", ["data:application/gltf-buffer;base64,", "data:;base64,", "DATA:a/b;c=d;base64,"])
def test_embedded_buffers(load, start):
    file = Gltf()
    assert_square(load("gltf", file.gltf(start + base64.b64encode(file.data).decode())))
    assert_square(load("gltf", file.gltf("data:," + "".join(f"%{byte:02x}" for byte in file.data))))


def test_strided_and_shifted_views(load):
    file = Gltf()
    file.accessor(POSITIONS, "<f4", 0, stride=20, before=8)
    file.accessor(NORMALS, "<f4", 1, stride=16, before=4)
    file.accessor(UV, "<f4", 2, stride=252)
    file.accessor(np.array(FACES), "u1", 3, before=3)
    assert_square(load("glb", file.glb()))


@pytest.mark.parametrize("dtype", ["i1", "u1", "<i2", "<u2"])
def test_normalised_integers(load, dtype):
    """With KHR_mesh_quantization; the most negative integer is -1 too."""
    most = np.iinfo(dtype).max
    file = Gltf()
    file.header["extensionsRequired"] = ["KHR_mesh_quantization"]
    file.accessor(POSITIONS * most, dtype, 0, stride=8, normalized=True)
    file.accessor(np.round(UV * most), dtype, 2, stride=4, normalized=True)
    if dtype[-2] == "i":
        file.accessor(np.array([(0, 0, np.iinfo(dtype).min)] * 4), dtype, 1, stride=8, normalized=True)
        np.testing.assert_array_equal(load("glb", file.glb()).mesh.normals, [[0, 0, -1]] * 4)
        file.accessor(np.round(NORMALS * most), dtype, 1, stride=8, normalized=True)
    assert_square(load("glb", file.glb()), tolerance=2 / most)


def test_integer_positions_are_scaled_by_their_node(load):
    file = Gltf({"scale": [0.001] * 3})
    file.accessor(POSITIONS * 1000, "<u2", 0, stride=8)
    assert_square(load("glb", file.glb()))


@pytest.mark.parametrize("dtype", ["u1", "<u2", "<u4"])
def test_indices_of_every_type(load, dtype):
    file = Gltf()
    file.accessor(np.array(FACES), dtype, 3)
    assert_square(load("glb", file.glb()))


def test_strips_fans_and_primitives_without_indices(load):
    strip = Gltf(mode=5)
    del strip.primitive["indices"]
    turning = Gltf(mode=5)
    turning.accessor(np.array([0, 1, 2, 2, 2, 1, 1, 3, 2]), "<u2", 3)
    fan = Gltf(mode=6)
    fan.accessor(np.array([3, 2, 0, 1]), "<u2", 3)
    plain = Gltf()
    del plain.primitive["indices"]
    for number, values in enumerate((POSITIONS, NORMALS, UV)):
        plain.accessor(values[FACES], "<f4", number)
    for file in (strip, fan, plain, turning):
        loaded = load("glb", file.glb())
        assert_square(loaded)
        assert len(loaded.mesh.faces) == 2 and not any("degenerate" in note for note in loaded.notes)


def test_points_and_lines_are_no_triangles(load, refused):
    file = Gltf()
    file.header["meshes"][0]["primitives"] += [{**file.primitive, "mode": mode} for mode in range(4)]
    assert_square(load("glb", file.glb()))
    file.header["meshes"][0]["primitives"].pop(0)
    assert "empty" in refused("glb", file.glb())


TURN = {"rotation": [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]}  # x to y


@pytest.mark.parametrize("node", [
    {**TURN, "translation": [5, 6, 7], "scale": [2, 3, 4]},
    {"matrix": [0, 2, 0, 0, -3, 0, 0, 0, 0, 0, 4, 0, 5, 6, 7, 1]},
])  # fmt: skip
def test_nodes_scale_then_turn_then_move(load, node):
    file = Gltf()
    file.header["nodes"] = [{"children": [1], "translation": [0, 0, 1]}, {"mesh": 0, **node}]
    loaded = load("glb", file.glb())
    np.testing.assert_allclose(loaded.mesh.vertices, POSITIONS[:, [1, 0, 2]] * [-3, 2, 4] + [5, 6, 8], atol=1e-12)
    expected = np.array([-0.6 / 3, 0, 0.8 / 4])
    np.testing.assert_allclose(loaded.mesh.normals, [expected / np.linalg.norm(expected)] * 4, atol=1e-7)
    assert loaded.area_vectors.sum(axis=0) == pytest.approx([0, 0, 6])


def test_mirroring_nodes_keep_the_outside_outside(load):
    """Also where two mirrors cancel each other, and where the square has no normals."""
    for scales in ([[-1, 1, 1]], [[-1, 1, 1], [1, -1, 1]], [[-1, -1, 1]]):
        file = Gltf()
        file.header["nodes"] = [{"children": [k + 1], "scale": scale} for k, scale in enumerate(scales)] + [{"mesh": 0}]
        for bare in (False, True):
            if bare:
                del file.primitive["attributes"]["NORMAL"]
            loaded = load("glb", file.glb())
            assert loaded.area_vectors.sum(axis=0) == pytest.approx([0, 0, 1])
            assert bare or (loaded.mesh.normals[:, 2] > 0).all()


def test_flattened_nodes(load):
    """A node scaled to nothing hides its content; a flattened one has no inverse, but still has normals."""
    file = Gltf({"scale": [1, 1, 0]})
    loaded = load("glb", file.glb())
    np.testing.assert_allclose(loaded.mesh.normals, [[0, 0, 1]] * 4, atol=1e-7)
    file.header["nodes"] = [{"mesh": 0, "scale": [0, 0, 0]}, {"mesh": 0}]
    file.header["scenes"] = [{"nodes": [0, 1]}]
    loaded = load("glb", file.glb())
    assert loaded.area == pytest.approx(1) and loaded.mesh.dropped == 2


def test_one_mesh_at_several_nodes(load):
    file = Gltf()
    file.header["nodes"] = [{"mesh": 0, "translation": [2 * k, 0, 0]} for k in range(3)]
    file.header["scenes"] = [{"nodes": [2, 0, 1]}]
    loaded = load("glb", file.glb())
    assert loaded.area == pytest.approx(3) and set(loaded.mesh.vertices[:, 0]) == set(range(6))


def test_the_default_scene_is_read_and_others_are_noted(load):
    file = Gltf()
    file.header["nodes"] = [{"mesh": 0, "scale": [k, k, k]} for k in (1, 2, 3)]
    file.header["scenes"] = [{"nodes": [0]}, {"nodes": [1]}]
    for scene, area in ((None, 1), (0, 1), (1, 4)):
        file.header |= {} if scene is None else {"scene": scene}
        loaded = load("glb", file.glb())
        assert loaded.area == pytest.approx(area)
        assert any(f"scene {scene or 0} of its 2" in note for note in loaded.notes)
    del file.header["scenes"]
    assert load("glb", file.glb()).area == pytest.approx(1 + 4 + 9)


def test_parts_without_normals_are_flat_and_without_uv_have_zeros_with_a_note(load):
    """A roof of two triangles that share an edge, beside a square with normals and uv."""
    file = Gltf()
    file.accessor(np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 1)], float), "<f4")
    file.header["meshes"][0]["primitives"].append({"attributes": {"POSITION": 4}, "indices": 3})
    loaded = load("glb", file.glb())
    normals = loaded.mesh.normals[loaded.mesh.faces[2:]]
    expected = np.array([(0, 0, 1), (-1, -1, 1)]) / np.sqrt([[1], [3]])
    np.testing.assert_allclose(normals, np.repeat(expected[:, None], 3, axis=1), atol=1e-12)
    assert (loaded.mesh.uv[loaded.mesh.faces[2:]] == 0).all()
    assert any("4 vertices without texture coordinates" in note for note in loaded.notes)
    assert any("materials" in note for note in loaded.notes)
    del file.primitive["attributes"]["NORMAL"]
    assert load("glb", file.glb()).mesh.normals is None


def test_indices_do_not_reach_into_other_parts(refused):
    file = Gltf()
    file.accessor(np.array([0, 1, 4]), "<u2")
    file.header["meshes"][0]["primitives"].insert(0, {"attributes": {"POSITION": 0}, "indices": 4})
    assert "the index 4 does not exist; there are 4 positions" in refused("glb", file.glb())


def test_bytes_behind_the_length_that_a_glb_states_are_not_its_own(load):
    assert_square(load("glb", Gltf().glb() + b"\xff" * 20))


def changed(**entries):
    """Return the square's file with a change to its header, or to the primitive of its mesh."""
    file = Gltf()
    for name, value in entries.items():
        (file.primitive if name in ("indices", "mode", "targets", "attributes") else file.header)[name] = value
    return file.glb()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (changed(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression is not supported"),
        (changed(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression is not supported"),
        (changed(nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]), "EXT_mesh_gpu_instancing"),
        (changed(nodes=[{"mesh": 0, "extensions": {"KHR_node_visibility": {}}}]), "KHR_node_visibility"),
        (changed(skins=[{}]), "skins is not supported"),
        (changed(targets=[{}]), "morph targets is not supported"),
        (changed(asset={"version": "1.0"}), "version 1.0 is not supported"),
        (changed(mode=7), "mode 7"),
        (changed(mode=4, indices=2), "indices are not integers"),
        (changed(indices=9), "accessors 9 does not exist; there are 4"),
        (changed(indices=-1), "accessors -1 does not exist; there are 4"),
        (changed(attributes={"POSITION": 0, "NORMAL": 2}), "NORMAL has the shape (4, 2) beside 4 positions"),
        (changed(nodes=[{"mesh": 0, "children": [0]}]), "node 0 has two parents"),
        (changed(nodes=[{"mesh": 0, "children": [1, 1]}, {}]), "node 1 has two parents"),
        (changed()[:-8], "the file ends within a chunk"),
        (changed().replace(b"glTF\2", b"glTF\1"), "version 1 is not supported"),
        (changed().replace(b'"count": 4', b'"count": 5'), "is shorter than its accessor"),
        (changed().replace(b'"byteOffset": 0', b'"byteOffset":-4'), "is shorter than its accessor"),
        (Gltf().gltf("https://example.org/square.bin"), "the address https://example.org/square.bin is not supported"),
        (Gltf().gltf("nowhere%20else.bin"), "nowhere else.bin, which it names, is not beside it"),
        (Gltf().gltf("data:;base64,AAAA"), "buffer 0 is shorter"),
    ],
)
def test_what_would_change_the_triangles_and_is_not_read_is_refused(refused, content, words):
    kind = "glb" if isinstance(content, bytes) else "gltf"
    assert words in refused(kind, content)


def test_integers_that_are_no_fractions_are_no_uv(refused):
    file = Gltf()
    file.accessor(np.ones((4, 2)), "<u2", 2)
    assert "integer TEXCOORD_0 is not supported" in refused("glb", file.glb())
