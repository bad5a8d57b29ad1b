"""Instances show the shapes of their group, each in its own place, and share the materials."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.core.types import Ray
from pathjax.errors import InputError
from pathjax.shapes import geometry

GROUP = """<shape type="shapegroup" id="tree">
<shape type="obj" id="leaf"><string name="filename" value="FOLDER/leaf.obj"/><bsdf type="diffuse" id="green"/></shape>
<shape type="sphere" id="fruit"><float name="radius" value="0.3"/>
  <transform name="to_world"><translate x="1" y="0.5" z="0.25"/></transform></shape>
<shape type="cylinder"><float name="radius" value="0.1"/><point name="p1" value="0.2, 0.3, 1"/></shape>
<shape type="cube"><transform name="to_world"><scale value="0.2"/><translate x="-0.7"/></transform></shape>
</shape>"""
PLACES = [
    '<translate x="0.5" y="-0.3"/>',
    '<rotate z="1" angle="40"/><scale value="0.6"/><translate z="-1.5"/>',
    '<scale x="-0.8" y="0.8" z="0.8"/><rotate x="1" angle="70"/><translate y="1.2"/>',
    '<scale x="0.5" y="1.2" z="-0.8"/><rotate x="1" angle="30"/><translate x="-1" y="-1"/>',
    '<matrix value="1 0.6 0 0.2 0.5 0.3 0 0.1 0.9"/><translate x="1" z="1.2"/>',
]
OBJ = "v -1 -1 0\nv 1 -1 0.2\nv 1 1 0\nv -1 0.5 0.1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"


def instances(places=PLACES):
    return "".join(
        f'<shape type="instance"><ref id="tree"/><transform name="to_world">{place}</transform></shape>'
        for place in places
    )


@pytest.fixture
def write(write_scene, tmp_path):
    def write(body):
        (tmp_path / "leaf.obj").write_text(OBJ)
        return write_scene(body.replace("FOLDER", str(tmp_path)) + '<emitter type="constant"/>')

    return write


@jax.jit
def seen(shapes, o, d):
    def see(o, d):
        ray = Ray(o, d, jnp.float32(jnp.inf), jnp.int32(-1))
        hit = geometry.closest_hit(shapes, ray)
        return hit, geometry.surface(shapes, ray, hit)

    return jax.vmap(see)(o, d)


def rays(n=300):
    rng = np.random.default_rng(0)
    o = rng.normal(size=(n, 3))
    o = 6 * o / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-1, 1, (n, 3)) - o
    return np.float32(o), np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


@pytest.mark.slow
def test_what_rays_meet_is_as_in_mitsuba(write):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    file = write(GROUP + instances())
    theirs = mi.load_file(str(file))
    o, d = rays()
    hit, surface = jax.tree.map(np.asarray, seen(pj.load_scene(file).geometry, o, d))
    met = 0
    for i in range(len(o)):
        si = theirs.ray_intersect(mi.Ray3f(o[i].tolist(), d[i].tolist()))
        assert si.is_valid() == (hit.t[i] < np.inf)
        if si.is_valid():
            met += 1
            np.testing.assert_allclose(hit.t[i], si.t, rtol=1e-3)
            np.testing.assert_allclose(surface.n[i], si.n, atol=2e-3)
            np.testing.assert_allclose(surface.shading_n[i], si.sh_frame.n, atol=2e-3)
            turn = (surface.uv[i] - np.asarray(si.uv) + 0.5) % 1 - 0.5
            np.testing.assert_allclose(turn, 0, atol=5e-3)
    assert met > 100


def test_instances_share_the_material_of_their_group_and_are_told_to_be_copies(write):
    scene = pj.load_scene(write(GROUP + instances()))
    names = [shape.name for shape in scene.about.description.shapes]
    assert len(names) == 20 and len(set(names)) == 20 and sum(name.endswith(".leaf") for name in names) == 5
    assert [name for name in pj.parameters(scene) if name.startswith("green")] == ["green.reflectance"]
    assert any("triangles of instances are copies: 10 of them" in note for note in scene.about.description.notes)


def test_a_group_is_not_seen_by_itself_and_may_follow_its_instances(write):
    alone = pj.load_scene(write(GROUP))
    assert alone.about.description.shapes == ()
    before, after = (pj.load_scene(write(text)) for text in (GROUP + instances(), instances() + GROUP))
    for a, b in zip(before.geometry.tables, after.geometry.tables, strict=True):
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            np.testing.assert_array_equal(x, y)


def test_a_group_may_stand_inside_its_instance(write):
    inside = GROUP.replace(' id="tree"', "")
    scene = pj.load_scene(write(f'<shape type="instance" id="oak">{inside}</shape>'))
    assert [shape.name for shape in scene.about.description.shapes][:2] == ["oak.leaf", "oak.fruit"]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<shape type="instance"/>', 'needs a <ref> to a <shape type="shapegroup">'),
        ('<shape type="sphere" id="tree"/><shape type="instance"><ref id="tree"/></shape>', "needs a <ref> to a"),
        (GROUP + instances(['<matrix value="1 1 0 0 1e-9 0 0 0 1"/>']), 'makes "fruit" flat'),
        (GROUP.replace("<scale v", '<scale value="1e9"/><scale v') + instances(['<scale value="1e31"/>']), "too large"),
        ('<shape type="shapegroup"><shape type="instance"/></shape>', "groups hold shapes alone"),
        ('<shape type="shapegroup"><shape type="shapegroup"/></shape>', "groups hold shapes alone"),
        ('<shape type="shapegroup"><shape type="cube"><emitter type="area"/></shape></shape>', "emits light"),
        ('<shape type="shapegroup"><bsdf type="diffuse"/></shape>', "has no place inside"),
        (GROUP + '<shape type="instance"><ref id="tree"/><bsdf type="diffuse"/></shape>', "has no place inside"),
        (GROUP + '<shape type="instance"><ref id="tree"/><ref id="tree"/></shape>', "at most 1 <shape>"),
    ],
)
def test_instances_that_make_no_sense_are_refused(write, body, words):
    with pytest.raises(InputError, match=r"scene\d+.xml:\d+: ") as error:
        pj.load_scene(write(body))
    assert words in str(error.value)
