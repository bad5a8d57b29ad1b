"""Meshes: positions, normals and uv agree with Mitsuba's loader; files that give no triangles are refused."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pathjax.errors import InputError
from pathjax.io.mesh import READERS, load
from pathjax.shapes import KINDS, Mesh

DATA = Path(__file__).parents[3] / ".." / "shared" / "data"
IDENTITY = np.eye(4)
TURN = np.array([[0, -1, 0, 1], [3, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1.0]])  # scale x 3, rotate z 90, translate
MIRROR = np.diag([-2.0, 1, 1, 1])

OBJ = {
    "split indices": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\nvt 1 0\nvt 0.25 1\nvn 0 0.6 0.8\nvn 0 0 2\n"
    "f 1/1/1 2/2/1 3/3/1\nf 2/1/2 4/3/2 3/2/1\n",
    "no normals": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nf 1 2 3\nf 2 4 3\n",
    "uv seam": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\nf 2/1 4/3 3/2\n",
    "polygons": "v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\nv -1 0.5 0\nf 1 2 3 4\nf 5 4 3 2 1\n",
    "groups": "mtllib lost.mtl\no one\ng a\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    "o two\ng b\ns 1\nusemtl blue\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf 4 5 6\nf 1 5 3 # comment\n",
}

PLY_HEADER = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACES = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
PLY_NORMALS = "property float nx\nproperty float ny\nproperty float nz\n"
PLY = {
    "no normals": PLY_HEADER.format(4) + PLY_FACES.format(2) + "0 0 0\n1 0 0\n0 1 0\n1 1 1\n3 0 1 2\n3 1 3 2\n",
    "normals and uv": PLY_HEADER.format(3) + PLY_NORMALS + "property float u\nproperty float v\n" + PLY_FACES.format(1)
    + "0 0 0 0 0.6 0.8 0.1 0.2\n1 0 0 0 0.6 0.8 0.8 0.2\n0 1 0 0 0.6 0.8 0.1 0.9\n3 0 1 2\n",
}  # fmt: skip
CASES = [(kind, text) for kind, texts in (("obj", OBJ), ("ply", PLY)) for text in texts.values()]


def mitsuba_mesh(path, kind, to_world, inside=""):
    """Return per corner: (F, 3, 3) positions, (F, 3, 3) normals or None, (F, 3, 2) uv or None."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    matrix = f'<matrix value="{" ".join(map(str, to_world.ravel()))}"/>'
    inside += f'<string name="filename" value="{path}"/><transform name="to_world">{matrix}</transform>'
    scene = mi.load_string(f'<scene version="3.0.0"><shape type="{kind}">{inside}</shape></scene>')
    params = mi.traverse(scene.shapes()[0])
    faces = np.array(params["faces"]).reshape(-1, 3)

    def corners(name, width):
        return np.array(params[name]).reshape(-1, width)[faces] if name in params and len(params[name]) else None

    return corners("vertex_positions", 3), corners("vertex_normals", 3), corners("vertex_texcoords", 2)


def solid(corners):
    """Return (F,) bool: False for slivers, whose areas depend on the last bit of their coordinates."""
    a, b, c = np.moveaxis(corners.astype(float), 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-7


def assert_agrees(path, kind, to_world, face_normals):
    ours, _ = load(path, kind, to_world, face_normals)
    inside = '<boolean name="face_normals" value="true"/>' if face_normals else ""
    positions, normals, uv = mitsuba_mesh(path, kind, to_world, inside)
    theirs = solid(positions)
    positions, normals, uv = (None if values is None else values[theirs] for values in (positions, normals, uv))
    faces = ours.faces[solid(ours.vertices[ours.faces])]
    if not np.allclose(ours.vertices[faces], positions, atol=1e-5):
        faces = faces[:, ::-1]  # under a mirror, ours reverses the winding to agree with the file's normals
        assert np.linalg.det(to_world[:3, :3]) < 0
    np.testing.assert_allclose(ours.vertices[faces], positions, atol=1e-5)
    assert (ours.normals is None) == (normals is None)
    if normals is not None:
        assert np.sum(ours.normals[faces] * normals, axis=-1).min() > 1 - 1e-5
    assert (ours.uv is None) == (uv is None)
    if uv is not None:
        np.testing.assert_allclose(ours.uv[faces], uv, atol=1e-6)


@pytest.mark.parametrize("face_normals", [False, True])
@pytest.mark.parametrize("to_world", [IDENTITY, TURN, MIRROR], ids=["identity", "turn", "mirror"])
@pytest.mark.parametrize(("kind", "text"), CASES, ids=[*OBJ, *(f"ply {name}" for name in PLY)])
def test_small_meshes_agree_with_mitsuba(write, kind, text, to_world, face_normals):
    assert_agrees(write(kind, text), kind, to_world, face_normals)


def real(name):
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    return path


@pytest.mark.parametrize("name", ["bunny.ply", "teapot.obj"])
def test_real_meshes_agree_with_mitsuba(name):
    assert_agrees(real(name), name[-3:], TURN, face_normals=False)


def test_real_polygons_agree_with_mitsuba_but_for_those_that_fans_do_not_fit():
    """Five of the car's 1172 polygons have corners on straight edges or dents."""
    ours, _ = load(real("car.obj"), "obj", TURN)
    positions, normals, _ = mitsuba_mesh(DATA / "car.obj", "obj", TURN)
    here, there = (
        np.rint(corners.reshape(-1, 9) * 1e4).astype(int) for corners in (ours.vertices[ours.faces], positions)
    )
    place = {tuple(triangle): k for k, triangle in enumerate(there)}
    pairs = [(k, place[tuple(triangle)]) for k, triangle in enumerate(here) if tuple(triangle) in place]
    assert len(pairs) > 0.99 * len(ours.faces)
    mine, theirs = np.transpose(pairs)
    assert np.sum(ours.normals[ours.faces[mine]] * normals[theirs], axis=-1).min() > 1 - 1e-5


@pytest.mark.parametrize(("kind", "text"), [("obj", OBJ["uv seam"]), ("ply", PLY["normals and uv"])])
def test_v_is_flipped_by_default_for_obj_alone(write, kind, text):
    path = write(kind, text)
    as_is, flipped, default = (load(path, kind, IDENTITY, flip_tex_coords=flip)[0].uv for flip in (False, True, None))
    np.testing.assert_allclose(flipped, as_is * [1, -1] + [0, 1])
    np.testing.assert_array_equal(default, flipped if kind == "obj" else as_is)


def test_winding_agrees_with_the_normals_of_the_file_also_under_a_mirror(write):
    for to_world in (IDENTITY, MIRROR):
        mesh, _ = load(write("obj", OBJ["split indices"]), "obj", to_world)
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        assert (np.sum(np.cross(b - a, c - a)[:, None] * mesh.normals[mesh.faces], axis=-1) > 0).all()


def test_negative_indices_count_back_from_their_own_line(write):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 2 0 0\nv 3 0 0\nv 2 1 0\nf -3 -2 -1\n"
    mesh, _ = load(write("obj", text), "obj", IDENTITY)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces][:, 0], [[0, 0, 0], [2, 0, 0]])


def test_obj_lines_may_be_continued_and_end_in_cr_lf(write):
    mesh, _ = load(write("obj", "v 0 0 0\r\nv 1 0 \\\r\n0\r\nv 0 1 0\r\nf 1 2 \\\r\n3\r\n"), "obj", IDENTITY)
    assert len(mesh.faces) == 1


def test_a_mesh_without_any_area_loads_as_nothing_with_a_note(write):
    for kind, text in (
        ("obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\n"),
        ("stl", b"\0" * 80 + b"\2\0\0\0" + b"\0" * 100),
    ):
        mesh, notes = load(write(kind, text), kind, IDENTITY)
        assert len(mesh.faces) == 0 and mesh.dropped == 2
        assert any("2 degenerate" in note for note in notes)


def test_degenerate_triangles_are_dropped_counted_and_noted(write):
    mesh, notes = load(write("obj", OBJ["no normals"] + "f 1 1 2\nv 2 0 0\nf 1 2 5\n"), "obj", IDENTITY)
    assert len(mesh.faces) == 2 and mesh.dropped == 2
    assert any("2 degenerate" in note for note in notes)


def test_vertices_without_normal_get_a_smooth_one_and_a_note(write):
    text = OBJ["no normals"].replace("f 1 2 3", "vn 0 0 1\nvn 0 0 0\nf 1//1 2//1 3//2")
    mesh, notes = load(write("obj", text), "obj", IDENTITY)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1)
    assert any("without a normal" in note for note in notes)


@pytest.mark.parametrize("back", ["f 4/4 3/3 2/2 1/1", "f 3/3 2/2 1/1 4/4"])
def test_sheets_with_a_face_for_each_side_have_the_normals_of_their_faces(write, back):
    """Around each corner of the square the normals cancel, or nearly so; around the tent's top they do not."""
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n" + back
    text += "\nv 5 0 0\nv 6 0 0\nv 5 1 0\nv 5 0 1\nf 5/1 6/1 8/1\nf 7/1 5/1 8/1\nf 6/1 7/1 8/1\n"
    mesh, notes = load(write("obj", text), "obj", IDENTITY, flip_tex_coords=False)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    own = np.cross(b - a, c - a)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.normals[mesh.faces[:4]], np.repeat(own[:4, None], 3, axis=1), atol=1e-12)
    np.testing.assert_array_equal(mesh.uv[mesh.faces[:4]], mesh.vertices[mesh.faces[:4]][..., :2])
    assert len(np.unique(mesh.normals[mesh.faces[4:, 2]], axis=0)) == 1  # the top of the tent is smooth
    assert any("4 vertices are flat" in note for note in notes)


@pytest.mark.parametrize("size", ["1e-200", "1e200", "1e-30", "1e30"])
def test_normals_of_any_length_are_made_unit(write, size):
    """Normals whose squared length is out of range count as missing."""
    text = OBJ["no normals"].replace("f 1 2 3", f"vn 0 0 {size}\nf 1//1 2//1 3//1")
    mesh, _ = load(write("obj", text), "obj", IDENTITY)
    np.testing.assert_allclose(mesh.normals[mesh.faces[0]], [[0, 0, 1]] * 3, atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        ("obj", "", "empty"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "empty"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", ":4: v 9 does not exist; there are 3"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/1\n", ":4: vt 1 does not exist; there are 0"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", ":4: "),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", ":4: "),
        ("obj", "v 0 0 0\nf 1 1\n", ":2: a face of 2 vertices"),
        ("obj", "v 0 0 zero\n", ":1: "),
        ("obj", "v 0 0\n", ":1: v has too few numbers"),
        ("obj", "curv 0 1 2\n", ':1: "curv" is not supported'),
        ("obj", "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 1 (counting from 0) is not finite"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1e39 0\nf 1 2 3\n", "vertex 2 (counting from 0) is not finite"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn nan 0 0\nf 1//1 2//1 3//1\n", "normal 0 is not finite"),
        ("ply", PLY_HEADER.format(3) + PLY_FACES.format(1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "there are 3"),
        ("ply", PLY_HEADER.format(3) + PLY_FACES.format(1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n", "there are 3"),
        ("ply", PLY_HEADER.format(3) + PLY_FACES.format(1) + "0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n", "vertex 1"),
        ("ply", PLY_HEADER.format(3) + "end_header\n0 0 0\n1 0 0\n0 1 0\n", "empty"),
        ("ply", PLY_HEADER.format(3) + PLY_FACES.format(2) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "after 1 of 2 face"),
        ("ply", "not a ply", "cannot be read as PLY"),
        ("stl", b"solid nothing\nendsolid", "empty"),
        ("stl", b"\0" * 84, "empty"),
        ("glb", b"glTF", "cannot be read as GLB"),
        ("gltf", "{}", "empty"),
        ("gltf", "[]", "cannot be read as GLTF"),
        ("gltf", '{"extensionsRequired": ["KHR_draco_mesh_compression"]}', "KHR_draco_mesh_compression is not"),
        ("gltf", '{"skins": [{}]}', "skins is not supported"),
        ("gltf", '{"accessors": [{"componentType": 5126, "count": 100000000000, "type": "VEC3"}]}', "without data"),
    ],
)
def test_what_is_no_mesh_is_refused(refused, kind, text, words):
    assert words in refused(kind, text)


def test_ply_polygons_become_fans(write):
    text = PLY_HEADER.format(5) + PLY_FACES.format(1) + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n-1 0.5 0\n5 0 1 2 3 4\n"
    np.testing.assert_array_equal(load(write("ply", text), "ply", IDENTITY)[0].faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])


def test_stl_is_flat_in_both_encodings(write):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    binary = b"\0" * 80 + struct.pack("<I", 1) + np.zeros(3, "<f4").tobytes() + corners.tobytes() + b"\0\0"
    lines = "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners)
    text = f"solid a\nfacet normal 0 0 1\nouter loop\n{lines}endloop\nendfacet\nendsolid a\n"
    for content in (binary, text):
        mesh, _ = load(write("stl", content), "stl", TURN)
        np.testing.assert_allclose(mesh.vertices[mesh.faces[0]], [[1, 0, 2], [1, 3, 2], [0, 0, 2]])
        assert mesh.normals is None and mesh.uv is None


def test_missing_mesh_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none\.obj"):
        load(tmp_path / "none.obj", "obj", IDENTITY)


def test_every_format_that_can_be_read_is_a_shape_of_scene_files():
    assert [*READERS, "mesh"] == [name for name, kind in KINDS.items() if issubclass(kind, Mesh)]
