"""Dictionaries give the same scenes as files of the same content, and errors name the key."""

import copy
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import pathjax as pj
from pathjax.description import Description
from pathjax.images import write_exr, write_png
from pathjax.io.mitsuba.loader import load_dict

T = pj.Transform()
CAMERA = {
    "type": "perspective",
    "fov": 40,
    "to_world": T.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
}
TRIANGLE = {"vertices": np.eye(3), "faces": [[0, 1, 2]]}


def scene(**objects):
    return {"type": "scene", "camera": CAMERA, "sky": {"type": "constant"}, **objects}


def with_reflectance(value):
    return scene(ball={"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": value}})


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, *(replace(each, about=None) for each in (one, other)))
    assert set(pj.parameters(one)) == set(pj.parameters(other))


def test_a_dictionary_is_the_scene_of_the_file(tmp_path):
    (tmp_path / "scene.xml").write_text("""<scene version="3.0.0">
      <integrator type="path"><integer name="max_depth" value="3"/></integrator>
      <sensor type="thinlens"><float name="fov" value="40"/><float name="aperture_radius" value="0.1"/>
        <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
        <sampler type="independent"><integer name="sample_count" value="7"/></sampler></sensor>
      <bsdf type="twosided" id="wall"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
        <transform name="to_uv"><scale value="3"/></transform></texture></bsdf></bsdf>
      <shape type="rectangle" id="back"><ref id="wall"/></shape>
      <shape type="sphere" id="ball"><point name="center" value="0, 1, 0"/><boolean name="flip_normals" value="true"/>
        <bsdf type="dielectric"><string name="int_ior" value="water"/></bsdf></shape>
      <shape type="sphere" id="lamp"><emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter></shape>
      <emitter type="constant" id="sky"/>
    </scene>""")
    made = pj.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": np.int64(3)},
            "sensor": {
                "type": "thinlens",
                "fov": 40,
                "aperture_radius": np.float64(0.1),
                "to_world": T.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]).matrix,
                "film": {"type": "hdrfilm", "width": 8, "height": 6},
                "sampler": {"type": "independent", "sample_count": 7},
            },
            "back": {"type": "rectangle", "bsdf": {"type": "ref", "id": "wall"}},
            "wall": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": T.scale(3)}},
            },
            "ball": {
                "type": "sphere",
                "center": (0, 1, 0),
                "flip_normals": np.True_,
                "bsdf": {"type": "dielectric", "int_ior": "water"},
            },
            "lamp": {
                "type": "sphere",
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": jnp.array([1.0, 2.0, 3.0])}},
            },
            "sky": {"type": "constant"},
        }
    )
    same(made, pj.load_scene(tmp_path / "scene.xml"))
    assert made.about.description.view.spp == 7


def test_keys_at_the_top_and_ids_name_parameters():
    made = pj.load_dict(
        scene(
            clay={"type": "diffuse"},
            one={"type": "sphere", "bsdf": {"type": "ref", "id": "clay"}},
            two={"type": "sphere", "bsdf": {"type": "diffuse"}},
            three={"type": "sphere", "bsdf": {"type": "diffuse", "id": "named"}},
            four={"type": "sphere", "id": "other"},
            five={"type": "sphere", "bsdf": {"type": "ref", "id": "two.bsdf"}},
            six={"type": "sphere", "bsdf": {"type": "ref", "id": "named"}},
        )
    )
    names = {f"{name}.reflectance" for name in ("clay", "two.bsdf", "named", "other")}
    assert set(pj.parameters(made)) == {*names, "sky.radiance"}


@pytest.mark.parametrize(
    ("value", "color"),
    [
        (0.25, 0.25),
        (1, 1),
        ({"type": "rgb", "value": 0.5}, 0.5),
        ({"type": "rgb", "value": [0.1, 0.2, 0.3]}, [0.1, 0.2, 0.3]),
        ({"type": "rgb", "value": jnp.array([0.5, 0.25, 1])}, [0.5, 0.25, 1]),
        ({"type": "spectrum", "value": 0.5}, 0.5),
        ({"type": "d65", "scale": 0.5}, 0.5),
        ({"type": "spectrum", "value": [(300, 0.5), (900, 0.5)]}, 0.5),
    ],
)
def test_colours(value, color):
    made = pj.load_dict(with_reflectance(value))
    made = pj.parameters(made)["ball.reflectance"]
    assert list(made) == pytest.approx(list(np.broadcast_to(color, 3)), rel=2e-3 if "spectrum" in str(value) else 1e-6)


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray, np.float32, lambda x: x.tolist()])
def test_an_array_is_a_texture(tmp_path, convert):
    image = np.random.default_rng(1).random((3, 5, 3), np.float32)
    write_exr(tmp_path / "i.exr", {name: image[..., i] for i, name in enumerate("RGB")}, {})
    from_file = pj.load_dict(with_reflectance({"type": "bitmap", "filename": str(tmp_path / "i.exr")}))
    same(pj.load_dict(with_reflectance(convert(image))), from_file)
    data = {"type": "bitmap", "data": convert(image), "filter_type": "bilinear"}
    same(pj.load_dict(with_reflectance(data)), from_file)


def test_an_environment_may_be_an_array(tmp_path):
    image = np.random.default_rng(1).random((4, 8, 3), np.float32)
    write_exr(tmp_path / "sky.exr", {name: image[..., i] for i, name in enumerate("RGB")}, {})
    file, data, bitmap = (
        pj.load_dict(scene(ball={"type": "sphere"}) | {"sky": {"type": "envmap", **given}})
        for given in ({"filename": tmp_path / "sky.exr"}, {"data": image}, {"bitmap": image})
    )
    same(data, file)
    same(bitmap, file)
    pj.save_scene(data, tmp_path / "saved.xml")
    same(pj.load_scene(tmp_path / "saved.xml"), file)


def test_bytes_of_a_texture_are_stored_values(tmp_path):
    write_png(tmp_path / "i.png", np.random.default_rng(1).random((3, 5, 3)))
    from PIL import Image

    stored = np.asarray(Image.open(tmp_path / "i.png"))
    for raw in (True, False):
        file = {"type": "bitmap", "filename": str(tmp_path / "i.png"), "raw": raw}
        data = {"type": "bitmap", "data": stored, "raw": raw}
        same(pj.load_dict(with_reflectance(data)), pj.load_dict(with_reflectance(file)))


def test_meshes_of_arrays_and_of_trimesh_are_those_of_files(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "ball.stl")
    made = [
        pj.load_dict(scene(ball=shape))
        for shape in (
            {"type": "stl", "filename": str(tmp_path / "ball.stl")},
            {"type": "mesh", "vertices": ball.vertices.astype(np.float32), "faces": jnp.asarray(ball.faces)},
            {"type": "mesh", "mesh": ball},
            ball,
        )
    ]
    areas = [np.asarray(each.geometry.tables[0].areas()) for each in made]
    for other in areas[1:]:
        np.testing.assert_allclose(other, areas[0], rtol=1e-5)


def test_normals_uv_and_transforms_of_arrays_count():
    shape = {"type": "mesh", **TRIANGLE, "normals": np.full((3, 3), 2.0), "uv": np.eye(3)[:, :2]}
    description = load_dict(scene(kite=shape | {"to_world": T.translate([1, 2, 3]).scale(2)}))
    mesh = description.shapes[0].geometry
    np.testing.assert_allclose(mesh.vertices, 2 * np.eye(3) + [1, 2, 3])
    np.testing.assert_allclose(mesh.normals, np.full((3, 3), 3**-0.5))
    np.testing.assert_array_equal(mesh.uv, np.eye(3)[:, :2])
    assert load_dict(scene(kite=shape | {"face_normals": True})).shapes[0].geometry.normals is None


def test_texture_coordinates_of_trimesh_are_turned_down():
    plane = trimesh.Trimesh(**TRIANGLE, visual=trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [0, 1]]))
    mesh = load_dict(scene(kite=plane)).shapes[0].geometry
    np.testing.assert_array_equal(mesh.uv, [[0, 1], [1, 1], [0, 0]])


def test_files_are_searched_in_the_folders_of_resources(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    found = scene(folder={"type": "resources", "path": str(tmp_path)}, box={"type": "ply", "filename": "box.ply"})
    assert len(load_dict(found).shapes) == 1


def itself():
    made = scene()
    made["again"] = made
    return made


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({}, 'scene: must be a dictionary with "type": "scene"'),
        ([], "scene: must be a dictionary"),
        (scene(ball={"type": "spere"}), 'scene.ball: no kind is named "spere"; did you mean "sphere"?'),
        (scene(ball={"type": "sphere", "radious": 1.0}), r"scene.ball.radious: .*did you mean \"radius\"?"),
        (scene(ball={"type": "sphere", "radius": -1}), r'scene.ball.radius: "radius" of .* must be above 0'),
        (scene(ball={"type": "sphere", "radius": "1"}), "scene.ball.radius: .*cannot be a string; give it as a float"),
        (scene(ball={"type": "sphere", "radius": np.nan}), "scene.ball.radius: .*not a finite number"),
        (scene(ball={"type": "sphere", "bsdf": {"type": "ref", "id": "skyy"}}), 'scene.ball.bsdf.*did you mean "sky"'),
        (scene(ball={"type": "sphere", "center": [1, 2]}), "scene.ball.center: must be one number or three, has 2"),
        (scene(ball={"type": "sphere", "center": None}), "scene.ball.center: a value of type NoneType has no place"),
        (scene(ball={"type": "sphere", "to_world": np.eye(2)}), "scene.ball.to_world: a transform is a pj.Transform"),
        (scene(ball={"type": "sphere", "to_world": {"scale": 2}}), "ball.to_world: a transform is a pj.Transform"),
        (scene(ball={"type": "sphere", "to_world": np.zeros((4, 4))}), "scene.ball.to_world: .*last row"),
        (scene(ball={"type": "sdfgrid"}), "scene.ball: .*is not supported"),
        (scene(ball={"radius": 1}), 'scene.ball: a dictionary needs a "type"'),
        (scene(ball={"type": 3}), 'scene.ball: a dictionary needs a "type"'),
        (scene(**{"a.b": {"type": "sphere"}}), "scene: a key must be a string without dots and spaces, is 'a.b'"),
        ({**scene(), 7: {"type": "sphere"}}, "scene: a key must be a string"),
        (
            scene(a={"type": "sphere", "id": "b"}, b={"type": "cube"}),
            'scene.b: the id "b" is taken already, at scene.a',
        ),
        (scene(a={"type": "sphere", "id": 7}), "scene.a: must be a string of one line, is 7"),
        (itself(), "scene.again.*inside itself"),
        (scene(fog={"type": "sphere", "inside": {"type": "homogeneous"}}), "scene.fog.inside: .*takes one <medium"),
        (scene(folder={"type": "resources", "path": "/none"}), 'scene.folder.*no folder "/none"'),
        (with_reflectance([0.1, 0.2, 0.3]), "reflectance: .*cannot be three numbers; give it as {\"type\": \"rgb\""),
        (with_reflectance({"type": "rgb", "value": "1, 0, 0"}), "must be a number, or a list .*, is '1, 0, 0'"),
        (with_reflectance({"type": "rgb"}), 'scene.ball.bsdf.reflectance: .*lacks "value"'),
        (with_reflectance({"type": "rgb", "value": [1, 2, 3]}), "scene.ball.bsdf.reflectance: .*between 0 and 1"),
        (with_reflectance({"type": "rgb", "value": 1, "x": 2}), "takes value, and no 'x'"),
        (with_reflectance({"type": "spectrum", "value": [1, 2, 3]}), "a number or pairs of wavelength and number"),
        (
            with_reflectance(np.full((2, 2, 3), -2.0)),
            "scene.ball.bsdf.reflectance: .*a texture with values below 0, inf or NaN",
        ),
        (with_reflectance(np.full((2, 2, 3), np.nan)), "scene.ball.bsdf.reflectance: .*or NaN"),
        (with_reflectance(np.zeros((2, 2, 4))), r"reflectance: .*must have the shape \(H, W\)"),
        (with_reflectance({"type": "bitmap", "data": np.zeros((2, 2)), "filename": "x"}), "excludes filename"),
        (scene(kite={"type": "mesh"}), 'scene.kite: .*needs "vertices", an array'),
        (scene(kite={"type": "mesh", "mesh": 3}), 'kite: "mesh" must be a .*Trimesh or a mitsuba.Mesh, is of type int'),
        (scene(kite={"type": "mesh", **TRIANGLE, "faces": [[0, 1, 7]]}), "scene.kite: face 0 .*has the vertex 7"),
        (scene(kite={"type": "mesh", **TRIANGLE, "faces": np.ones((1, 3))}), "scene.kite: faces must be integers"),
        (scene(kite={"type": "mesh", **TRIANGLE, "uv": np.eye(3)}), r"scene.kite: uv must have the shape \(V, 2\)"),
    ],
)
def test_mistakes_are_told_by_their_keys(wrong, says):
    with pytest.raises(pj.InputError, match=says) as error:
        load_dict(wrong)
    assert "\n" not in str(error.value)


def test_traced_values_are_refused():
    with pytest.raises(pj.InputError, match=r"scene.ball.bsdf.reflectance: is traced; .*pj\.with_parameters"):
        jax.jit(lambda x: load_dict(with_reflectance({"type": "rgb", "value": x})).spp)(jnp.ones(3))


def test_a_name_of_two_rooms_is_refused(monkeypatch):
    monkeypatch.setitem(pj.textures.KINDS, "sphere", object)
    with pytest.raises(pj.InputError, match='scene.ball: "sphere" is the name of kinds of shape and texture'):
        load_dict(scene(ball={"type": "sphere"}))


def test_a_dark_scene_is_warned_of():
    with pytest.warns(pj.InputWarning, match="scene: there is no light"):
        pj.load_dict({"type": "scene", "camera": CAMERA})


def test_mitsubas_cornell_box_loads():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    made = pj.load_dict(mi.cornell_box())
    assert set(pj.parameters(made)) == {*(f"{c}.reflectance" for c in ("white", "red", "green")), "light.radiance"}


# ---- fuzzing --------------------------------------------------------------------------------------------------------

RICH = scene(
    integrator={"type": "moment", "inner": {"type": "path", "max_depth": 4}},
    wall={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": np.full((2, 2, 3), 0.5)}},
    metal={"type": "conductor", "eta": {"type": "rgb", "value": [1, 2, 3]}, "k": {"type": "spectrum", "value": 2}},
    ball={"type": "sphere", "center": [0, 1, 2], "radius": 0.5, "bsdf": {"type": "dielectric", "int_ior": "water"}},
    pane={
        "type": "rectangle",
        "to_world": T.translate([0, 0, 1]),
        "bsdf": {"type": "ref", "id": "wall"},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    },
    kite={"type": "mesh", **TRIANGLE, "uv": np.eye(3)[:, :2], "bsdf": {"type": "ref", "id": "metal"}},
    spot={"type": "spot", "cutoff_angle": 30, "to_world": np.eye(4), "intensity": 2.0},
)
VALUES = [None, -1, 0, 1e40, np.nan, True, "", "x", "sphere", [], [1, 2, 3], [[1], [1, 2]], np.eye(4), {}, object()]
VALUES += [
    "a\nb",
    {"type": "ref", "id": "wall"},
    {"type": "sphere"},
    {"type": "rgb", "value": 1},
    np.array("a"),
    b"x",
    T,
    1j,
]


def places(value, path=()):
    """Yield the paths to the entries of a dictionary, which may contain itself."""
    for key, each in value.items() if isinstance(value, dict) and len(path) < 8 else ():
        yield (*path, key)
        yield from places(each, (*path, key))


@st.composite
def mutated(draw):
    made = copy.deepcopy(RICH)
    for _ in range(draw(st.integers(1, 3))):
        *path, key = draw(st.sampled_from(list(places(made))))
        parent = made
        for step in path:
            parent = parent[step]
        match draw(st.sampled_from(["value", "key", "remove", "move", "cycle"])):
            case "value":
                parent[key] = copy.deepcopy(draw(st.sampled_from(VALUES)))
            case "key":
                parent[draw(st.sampled_from(["type", "id", "radius", "bsdf", "x", "", "a.b", 3, None]))] = parent[key]
            case "remove":
                del parent[key]
            case "move":
                made[draw(st.sampled_from(["a", "ball", "wall"]))] = parent[key]
            case "cycle":
                parent[key] = parent
    return made


@settings(max_examples=400, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(made=mutated())
def test_mutated_dictionaries_load_or_are_refused(made):
    try:
        assert isinstance(load_dict(made), Description)
    except pj.InputError as error:
        assert re.match(r"scene[.:]", str(error)) and "\n" not in str(error)


def test_the_unchanged_dictionary_loads():
    assert len(load_dict(RICH).shapes) == 3


@pytest.fixture
def mitsubas_mesh(root):
    """(file, **other fields of the shape) -> an object of Mitsuba."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")

    def make(file="ball_smooth.ply", **more):
        kind = {"type": file.rpartition(".")[2], "filename": f"{root}/tests/scenes/meshes/{file}"}
        return mi.load_dict(kind | more)

    return make


@pytest.mark.parametrize("how", [{}, {"face_normals": True}, {"flip_normals": True}], ids=str)
@pytest.mark.parametrize("file", ["ball_smooth.ply", "tinted.ply", "saddle.obj"])
def test_a_mesh_of_mitsuba_is_that_of_the_file(mitsubas_mesh, root, file, how):
    """Including normals, texture coordinates and colours; Mitsuba stores float32."""
    it = mitsubas_mesh(file, **how)
    path = {"type": file.rpartition(".")[2], "filename": f"{root}/tests/scenes/meshes/{file}"}
    (expected,) = load_dict(scene(it=path | how)).shapes
    for made in (it, {"type": "mesh", "mesh": it, "bsdf": {"type": "conductor"}}):
        (shape,) = load_dict(scene(it=made)).shapes
        assert shape.flip_normals == expected.flip_normals
        for key in ("vertices", "normals", "uv"):
            numbers = [getattr(each.geometry, key) for each in (shape, expected)]
            assert (numbers[0] is None) == (numbers[1] is None)
            if numbers[0] is not None:
                corners = [x[each.geometry.faces] for x, each in zip(numbers, (shape, expected), strict=True)]
                np.testing.assert_allclose(*corners, atol=1e-6)
        assert ("vertex_color" in shape.geometry.attributes) == (file == "tinted.ply")


def test_the_colours_of_a_mesh_of_mitsuba_are_read_back(mitsubas_mesh):
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.2, 0.1]}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}}
    known = pj.parameters(pj.load_dict(scene(it=mitsubas_mesh(bsdf=red, emitter=lamp))))
    np.testing.assert_allclose(known["it.reflectance"], [0.7, 0.2, 0.1])
    np.testing.assert_allclose(known["it.radiance"], [3, 2, 1])
    # A bsdf given beside the mesh replaces the mesh's own, which then need not be readable.
    made = {"type": "mesh", "mesh": mitsubas_mesh(bsdf={"type": "plastic"}), "bsdf": {"type": "diffuse", "id": "own"}}
    assert "own.reflectance" in pj.parameters(pj.load_dict(scene(it=made)))
    made["bsdf"] = {"type": "ref", "id": "clay"}
    assert "clay.reflectance" in pj.parameters(pj.load_dict(scene(clay={"type": "diffuse"}, it=made)))


def test_what_a_mesh_of_mitsuba_does_not_tell_is_refused(mitsubas_mesh):
    textured = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    for bsdf, kind in ({"type": "plastic"}, "SmoothPlastic"), (textured, "SmoothDiffuse"):
        with pytest.raises(pj.InputError, match=f"scene.it: the bsdf of a mesh of Mitsuba, {kind}, cannot be read"):
            load_dict(scene(it=mitsubas_mesh(bsdf=bsdf)))
    with pytest.raises(pj.InputError, match="scene.it: the medium of a mesh of Mitsuba, Homogeneous.*, cannot be read"):
        load_dict(scene(it=mitsubas_mesh(interior={"type": "homogeneous"})))


@pytest.mark.parametrize("kind", ["diffuse", "path", "constant", "sphere", "perspective"])
def test_objects_of_mitsuba_that_are_no_meshes_are_refused_as_such(kind):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    with pytest.raises(pj.InputError, match="scene.it: a .* of Mitsuba cannot be read back; give the dictionary"):
        load_dict(scene(it=mi.load_dict({"type": kind})))


@pytest.mark.parametrize("kind", ["ScalarTransform3f", "ScalarTransform4f", "array"])
def test_to_uv_is_the_transform_of_mitsuba_of_two_dimensions_or_three(kind):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    expected = np.array([[2, 0, 0.3], [0, 3, 0.1]])
    if kind == "array":
        given = np.vstack([expected, [0, 0, 1]])
    else:
        size = int(kind[-2]) - 1
        given = getattr(mi, kind)().translate([0.3, 0.1, 0][:size]).scale([2, 3, 1][:size])
    made = load_dict(with_reflectance({"type": "checkerboard", "to_uv": given}))
    found = made.shapes[0].bsdf.values["reflectance"].values["to_uv"]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert not any("to_uv" in note for note in made.notes)


def test_points_and_colours_of_mitsuba_are_taken():
    """Mitsuba's points have an attribute `matrix` too, which is no matrix."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    bsdf = {"type": "diffuse", "reflectance": mi.ScalarColor3f(0.1, 0.2, 0.3)}
    ball = {"type": "sphere", "id": "ball", "center": mi.ScalarPoint3f(1, 2, 3), "bsdf": bsdf}
    made = pj.load_dict({"type": "scene", "camera": {"type": "perspective"}, "ball": ball, "sky": {"type": "constant"}})
    np.testing.assert_allclose(made.about.description.shapes[0].geometry.center, [1, 2, 3])
    np.testing.assert_allclose(pj.parameters(made)["ball.reflectance"], [0.1, 0.2, 0.3])
