"""Attributes of meshes as textures: read from PLY as Mitsuba does, interpolated over triangles, absent where unused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.core.types import Ray
from pathjax.errors import InputError
from pathjax.io import mesh
from pathjax.shapes import geometry

COLORS = np.array([(0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9), (1, 0, 0.5)])
POINTS = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
FACES = [[0, 1, 2], [0, 2, 3]]


def ply(of_vertices=(), vertex_rows=None, of_faces=(), face_rows=None, faces=FACES):
    """Return a text PLY of a square, with further properties as "type name"."""
    header = ["ply", "format ascii 1.0", f"element vertex {len(POINTS)}", *(f"property float {x}" for x in "xyz")]
    header += [*(f"property {each}" for each in of_vertices), f"element face {len(faces)}"]
    header += ["property list uchar int vertex_indices", *(f"property {each}" for each in of_faces), "end_header"]
    rows = [[*point, *row] for point, row in zip(POINTS, vertex_rows or [()] * 4, strict=True)]
    rows += [[len(f), *f, *row] for f, row in zip(faces, face_rows or [()] * len(faces), strict=True)]
    return "\n".join([*header, *(" ".join(map(str, row)) for row in rows), ""])


def named(*names, kind="float"):
    return [f"{kind} {name}" for name in names]


@pytest.fixture
def attributes(tmp_path):
    def attributes(text):
        (tmp_path / "a.ply").write_text(text)
        return mesh.load(tmp_path / "a.ply", "ply", np.eye(4))

    return attributes


@pytest.mark.parametrize(
    ("properties", "name"),
    [
        (named("r", "g", "b"), "vertex_color"),
        (named("red", "green", "blue", kind="double"), "vertex_color"),
        (named("tint_r", "tint_g", "tint_b"), "vertex_tint_color"),
        (named("tint_x", "tint_y", "tint_z"), "vertex_tint"),
        (named("tint_0", "tint_1", "tint_2"), "vertex_tint"),
    ],
)
def test_names_of_attributes_are_those_of_mitsuba(attributes, properties, name, tmp_path):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    found = attributes(ply(properties, COLORS.tolist()))[0].attributes
    theirs = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "a.ply")}))
    assert list(found) == [name]
    np.testing.assert_allclose(found[name].ravel(), np.asarray(theirs[name]), atol=1e-6)


def test_properties_that_are_no_attributes_are_passed_over(attributes):
    names = named("quality", "r", "g", "u_0", "u_1", "_x")
    assert attributes(ply(names, [range(6)] * 4))[0].attributes == {}


def test_integers_are_shares_of_the_largest(attributes):
    made, notes = attributes(ply(named("red", "green", "blue", kind="uchar"), [(255, 0, 51)] * 4))
    np.testing.assert_allclose(made.attributes["vertex_color"], [[1, 0, 0.2]] * 4)
    assert any("red, green, blue of each vertex are integers" in note for note in notes)


def test_attributes_follow_their_faces_and_vertices(attributes):
    """For a quad and a triangle, beside a face without area, with vertices that are split to get their own normals."""
    faces = [[0, 1, 1], [0, 1, 2, 3], [0, 2, 1]]
    text = ply(named("r", "g", "b"), COLORS.tolist(), named("r", "g", "b"), [(9, 9, 9), (1, 2, 3), (4, 5, 6)], faces)
    made, _ = attributes(text)
    np.testing.assert_array_equal(made.attributes["face_color"], [(1, 2, 3)] * 2 + [(4, 5, 6)])
    for vertex, color in zip(made.vertices, made.attributes["vertex_color"], strict=True):
        np.testing.assert_allclose(color, COLORS[POINTS.index(tuple(vertex.astype(int)))])
    assert len(made.vertices) > 4  # normals of faces on both sides cancel, so vertices are split


def body(folder, attribute="vertex_color", more="", shape="ply"):
    return f"""<shape type="{shape}"><string name="filename" value="{folder}/a.ply"/>
<bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance" id="tint">
<string name="name" value="{attribute}"/>{more}</texture></bsdf></shape>
<shape type="sphere"><point name="center" x="0" y="0" z="-9"/></shape><emitter type="constant"/>"""


@pytest.mark.parametrize("attribute", ["vertex_color", "face_color"])
def test_a_triangle_shows_what_its_corners_carry(make_scene, tmp_path, attribute):
    rgb = named("r", "g", "b")
    (tmp_path / "a.ply").write_text(ply(rgb, COLORS.tolist(), rgb, COLORS[:2].tolist()))
    scene = make_scene(body(tmp_path, attribute, '<float name="scale" value="0.5"/>'))
    xy = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    origins = np.c_[xy, np.ones(200)].astype(np.float32)

    def seen(o):
        ray = Ray(o, jnp.array([0, 0, -1.0]), jnp.inf, jnp.int32(-1))
        surface = geometry.surface(scene.geometry, ray, geometry.closest_hit(scene.geometry, ray))
        return scene.materials.textures.look_up(jnp.zeros(2, jnp.int32), surface)

    x, y = (xy.T + 1) / 2
    lower = x > y
    if attribute == "face_color":
        expected = np.where(lower[:, None], COLORS[0], COLORS[1])
    else:
        below = np.stack([1 - x, x - y, y], -1) @ COLORS[[0, 1, 2]]
        expected = np.where(lower[:, None], below, np.stack([1 - y, x, y - x], -1) @ COLORS[[0, 2, 3]])
    np.testing.assert_allclose(jax.jit(jax.vmap(seen))(origins), expected / 2, atol=1e-5)


def test_what_no_texture_asks_for_is_not_kept(make_scene, tmp_path):
    (tmp_path / "a.ply").write_text(ply(named("r", "g", "b", "w_0"), [(*c, 1) for c in COLORS]))
    scene = make_scene(body(tmp_path))
    assert [list(table.attributes) for table in scene.geometry.tables] == [[], ["vertex_color"]] or [
        list(table.attributes) for table in scene.geometry.tables
    ] == [["vertex_color"], []]
    plain = make_scene(f'<shape type="ply"><string name="filename" value="{tmp_path}/a.ply"/></shape>')
    assert not plain.geometry.tables[0].attributes


@pytest.mark.parametrize(
    ("attribute", "rows", "words"),
    [
        ("vertex_tint", COLORS, 'no attribute "vertex_tint", which "reflectance" of its bsdf asks for; it has: '),
        ("face_color", COLORS, "it has: vertex_color"),
        ("color", COLORS, 'must begin with "vertex_" or "face_"'),
        ("vertex_color", COLORS * 2, "must lie in [0, 1]"),
        ("vertex_color", COLORS * np.nan, "must lie in [0, 1]"),
    ],
)
def test_attributes_that_do_not_fit_are_refused(write_scene, tmp_path, attribute, rows, words):
    (tmp_path / "a.ply").write_text(ply(named("r", "g", "b"), rows.tolist()))
    with pytest.raises(InputError, match=r"scene\d+.xml:\d+: ") as error:
        pj.load_scene(write_scene(body(tmp_path, attribute)))
    assert words in str(error.value)


def test_a_shape_without_attributes_is_told(write_scene):
    text = '<texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/></texture>'
    shape = f'<shape type="sphere"><bsdf type="twosided"><bsdf type="diffuse">{text}</bsdf></bsdf></shape>'
    with pytest.raises(InputError, match=r'<shape type="sphere"> has no attribute "vertex_color".*it has: none'):
        pj.load_scene(write_scene(shape))
