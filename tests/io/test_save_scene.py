"""A scene that is saved and loaded again is the same scene, here and in Mitsuba."""

import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import pathjax as pj
from pathjax import bsdfs
from pathjax.bsdfs import Diffuse
from pathjax.kinds import Color, Number
from pathjax.scene import build

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*ROOT.glob("scenes/*.xml"), *ROOT.glob("tests/scenes/*.xml")])
SEEDS, SPP = 16, 64


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, *(replace(each, about=None) for each in (one, other)))
    assert list(pj.parameters(one)) == list(pj.parameters(other))


def moved(scene):
    """Return the scene with every parameter changed."""
    about = scene.about.parameters
    inside = {name: np.clip(value * 0.75 + 0.1, *about[name].bounds) for name, value in pj.parameters(scene).items()}
    # Texels are written as float32.
    inside = {name: np.float32(value) if about[name].is_texture else value for name, value in inside.items()}
    return pj.with_parameters(scene, inside)


@pytest.fixture
def again(tmp_path):
    """(scene) -> the scene saved and loaded."""

    def again(scene, name="saved.xml", **how):
        pj.save_scene(scene, tmp_path / name)
        return pj.load_scene(tmp_path / name, **how)

    return again


def dictionary():
    """Return a scene with arrays, which Mitsuba's files cannot hold."""
    random = np.random.default_rng(1)
    wall = {"type": "rectangle", "to_world": pj.Transform().translate([0, 0, -1]).scale(2)}
    ball = trimesh.creation.icosphere(2, 0.6)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "camera": {
            "type": "perspective",
            "fov": 40,
            "to_world": pj.Transform().look_at([0.5, 0.5, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "bytes": wall
        | {"bsdf": {"type": "diffuse", "reflectance": random.integers(0, 256, (5, 4, 3)).astype(np.uint8)}},
        "floor": {
            "type": "mesh",
            "vertices": np.array([[-2, -0.7, -2], [2, -0.7, -2], [2, -0.7, 2], [-2, -0.7, 2]]),
            "faces": [[0, 2, 1], [0, 3, 2]],
            "uv": np.array([[0, 0], [1, 0], [1, 1], [0, 1]]),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {
                    "type": "checkerboard",
                    "color1": {"type": "bitmap", "data": random.random((3, 4, 1)), "raw": True},
                },
            },
        },
        "ball": {
            "type": "mesh",
            "mesh": ball,
            "normals": ball.vertex_normals,
            "to_world": pj.Transform().rotate([1, 2, 3], 50).scale([1, 0.8, 1]),
            "bsdf": {"type": "twosided", "bsdf": {"type": "conductor", "eta": 1.5, "k": 3.0}},
        },
        "lamp": {
            "type": "sphere",
            "center": [0, 2, 2],
            "radius": 0.4,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8, 9, 10]}},
        },
        "sky": {"type": "envmap", "data": random.random((3, 4, 3)), "scale": 0.3},
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_come_back_as_they_were(path, again):
    scene = pj.load_scene(path)
    same(scene, again(scene))
    same(moved(scene), again(moved(scene), "moved.xml"))


def test_arrays_come_back_from_files_beside(again, tmp_path):
    scene = pj.load_dict(dictionary())
    same(scene, again(scene))
    files = {"bytes_reflectance.png", "floor_color1.exr", "sky.exr", "floor.ply", "ball.ply"}
    assert {file.name for file in tmp_path.iterdir()} == {"saved.xml", *(f"saved_{name}" for name in files)}
    same(scene, again(again(scene), "second.xml"))


def test_float64_comes_back(again, x64):
    """Normals may differ in the last bit, since they are normalised again."""
    with x64():
        scene = moved(pj.load_dict(dictionary(), dtype=jnp.float64))
        trees = [replace(each, about=None) for each in (scene, again(scene, dtype=jnp.float64))]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15), *trees)


def test_a_shape_without_bsdf_gets_the_one_that_was_set(again, make_scene):
    scene = make_scene('<shape type="sphere" id="ball"/><shape type="cube"/><emitter type="constant"/>')
    scene = pj.with_parameters(scene, {"ball.reflectance": [0.1, 0.2, 0.3], "bsdf0.reflectance": 0.9})
    same(scene, again(scene))


def test_a_kind_of_a_user_comes_back(again, monkeypatch, make_scene):
    monkeypatch.setattr(bsdfs, "KINDS", dict(bsdfs.KINDS))

    @bsdfs.register("dusty")
    class Dusty(Diffuse):
        dust = Number(0.5, bounds=(0, 1), textured=True)
        tint = Color(None)

        @classmethod
        def read(cls, loader, fields, name):
            """Accept a name that stands for a colour."""
            made = super().read(loader, fields, name)
            if fields.string("cloth", "none") == "wool":
                if made.values["tint"] is not None:
                    raise fields.error("tint", "excludes cloth")
                return cls.instance(name, **{**made.values, "tint": np.array([0.9, 0.8, 0.7])})
            return made

    cloth = '<string name="cloth" value="wool"/><float name="dust" value="0.25"/>'
    scene = make_scene(
        f'<shape type="sphere"><bsdf type="dusty" id="a">{cloth}</bsdf></shape><emitter type="constant"/>'
    )
    same(scene, again(scene))
    assert 'value="wool"' in Path(again(scene).about.description.file).read_text()
    for values in ({"a.dust": 0.5}, {"a.tint": [0.5, 0.25, 0.75]}):
        changed = pj.with_parameters(scene, values)
        same(changed, again(changed))
    assert "wool" not in Path(again(changed).about.description.file).read_text()


def test_references_aliases_includes_and_names_come_back(again, tmp_path):
    (tmp_path / "part.xml").write_text('<scene version="3.0.0"><bsdf type="diffuse" id="clay"/></scene>')
    (tmp_path / "scene.xml").write_text("""<scene version="2.0.0"><default name="grey" value="0.25"/>
      <include filename="part.xml"/><alias id="clay" as="mud"/><sensor type="perspective"/>
      <emitter type="area" id="shine"/>
      <shape type="sphere" id="one"><ref id="mud"/><ref id="shine"/></shape>
      <shape type="cube"><bsdf type="diffuse"><float name="reflectance" value="$grey"/></bsdf></shape></scene>""")
    scene = pj.load_scene(tmp_path / "scene.xml", grey=0.75)
    same(scene, again(scene))
    (tmp_path / "old.xml").write_text("""<scene version="0.6.0"><sensor type="perspective"/><emitter type="constant"/>
      <shape type="sphere"><bsdf type="dielectric"><float name="intIOR" value="1.25"/></bsdf></shape></scene>""")
    scene = pj.load_scene(tmp_path / "old.xml")
    same(scene, again(scene))
    assert '<scene version="3.0.0">' in (tmp_path / "saved.xml").read_text()


def test_the_sensor_that_is_used_comes_first(again, tmp_path):
    both = dictionary() | {"other": dictionary()["camera"] | {"fov": 70}}
    scene = pj.load_dict(both, sensor="other")
    same(scene, again(scene))


def test_a_scene_whose_names_have_signs_of_xml_comes_back(again, make_scene):
    scene = make_scene('<shape type="sphere" id="a &lt;&quot;&amp;b"/><emitter type="constant"/>')
    same(moved(scene), again(moved(scene)))


def test_other_folders_find_the_same_files(shipped, tmp_path, monkeypatch):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "sep", "/")
    scene = shipped("textures")
    pj.save_scene(scene, Path("deep") / "er" / "saved.xml")
    monkeypatch.chdir(tmp_path / "deep")
    same(scene, pj.load_scene("er/saved.xml"))


def test_attributes_of_meshes_come_back(again):
    random = np.random.default_rng(1)
    kite = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]]}
    for name, count in (("vertex_color", 3), ("face_color", 1)):
        texture = {"type": "mesh_attribute", "name": name}
        shape = kite | {name: random.random((count, 3)), "bsdf": {"type": "diffuse", "reflectance": texture}}
        scene = pj.load_dict(dictionary() | {"kite": shape})
        same(scene, again(scene, f"{name}.xml"))


def test_a_mesh_of_which_nothing_is_left_is_left_out(again):
    flat = {"type": "mesh", "vertices": np.ones((3, 3)), "faces": [[0, 1, 2]]}
    scene = pj.load_dict(dictionary() | {"flat": flat})
    same(scene, again(scene))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: "saved.png", "scenes are written as .xml"),
        (lambda folder: "scene.xml", "is read by the same command"),
        (lambda folder: "none/saved.xml", "there is no folder"),
        (lambda folder: (folder / "saved_ball.ply").mkdir() or "saved.xml", "saved_ball.ply: is a folder"),
        (lambda folder: "box.xml", None),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is(spoil, says, tmp_path):
    trimesh.creation.box().export(tmp_path / "box_ball.ply")
    trimesh.creation.box().export(tmp_path / "ball.stl")
    shapes = "".join(
        f'<shape type="{name[-3:]}" id="ball{i}"><string name="filename" value="{name}"/></shape>'
        for i, name in enumerate(("box_ball.ply",))
    )
    shapes += '<shape type="stl" id="ball"><string name="filename" value="ball.stl"/></shape>'
    text = f'<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/>{shapes}</scene>'
    (tmp_path / "scene.xml").write_text(text)
    scene = pj.load_scene(tmp_path / "scene.xml")
    name = spoil(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(pj.InputError, match=says or "box_ball.ply: is read by the same command"):
        pj.save_scene(scene, tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "scene.xml").read_text() == text


def test_what_no_file_can_say_is_refused(make_scene, tmp_path):
    scene = pj.load_dict(dictionary() | {"a$b": {"type": "sphere"}})
    with pytest.raises(pj.InputError, match=r"scene.a\$b: .*'a\$b' cannot be written"):
        pj.save_scene(scene, tmp_path / "saved.xml")
    scene = make_scene('<shape type="sphere" id="ball"/><emitter type="constant"/>')
    built = build(replace(scene.about.description, document=None))
    with pytest.raises(pj.InputError, match="was built from records"):
        pj.save_scene(built, tmp_path / "saved.xml")
    with pytest.raises(pj.InputError, match="max_depth was replaced after it was loaded"):
        pj.save_scene(replace(scene, max_depth=jnp.int32(3)), tmp_path / "saved.xml")
    with pytest.raises(pj.InputError, match="traced; save it outside"):
        jax.jit(lambda x: pj.save_scene(pj.with_parameters(scene, {"ball.reflectance": x}), tmp_path / "x.xml"))(0.5)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_mitsuba_loads_what_is_saved(path, tmp_path):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    scene = moved(pj.load_scene(path))
    pj.save_scene(scene, tmp_path / "saved.xml")
    known = mi.traverse(mi.load_file(str(tmp_path / "saved.xml")))
    for name, value in pj.parameters(scene).items():
        if name.endswith(".reflectance") and f"{name}.value" in known:
            np.testing.assert_allclose(np.resize(known[f"{name}.value"], 3), np.ravel(value), rtol=1e-6)


@pytest.mark.slow
def test_mitsuba_renders_what_is_saved(mitsuba, estimate, agree, tmp_path):
    scene = moved(pj.load_dict(dictionary()))
    pj.save_scene(scene, tmp_path / "saved.xml")
    theirs = mitsuba(tmp_path / "saved.xml", SPP, SEEDS)
    agree(estimate(scene, spp=SPP, count=SEEDS), theirs, rounding=1e-3)
