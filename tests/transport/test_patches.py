"""Cutting scenes into patches: cells of equal area, found again from their points; refused shapes are named."""

import contextlib
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import transport
from pathjax.compile import native_map
from pathjax.core.math import at, dot
from pathjax.core.types import Hit, Ray
from pathjax.shapes import geometry
from pathjax.transport import patches as patches_module

OCTAHEDRON = '<string name="filename" value="meshes/octahedron.obj"/><boolean name="face_normals" value="true"/>'
TURN = '<rotate x="0.6" y="0.8" angle="40"/></transform>'
TURNED = f'<transform name="to_world"><scale x="2" y="0.5" z="1"/>{TURN}'
SHAPES = {
    "rectangle": TURNED,
    "disk": TURNED,
    "obj": OCTAHEDRON + TURNED,
    "sphere": f'<float name="radius" value="2"/><transform name="to_world">{TURN}',
}
GREY = '<bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.5"/></bsdf>'
LAMP = '<emitter type="area"><rgb name="radiance" value="1"/></emitter>'


def shape(kind, inside):
    return f'<shape type="{kind}" id="it">{inside}</shape>'


@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)])
def test_points_of_a_patch_lie_in_it(make_scene, x64, dtype):
    """All kinds of shape, both sides; 64 points each."""
    both = f'<bsdf type="twosided">{GREY}</bsdf>'
    body = "".join(shape(kind, inside + both).replace("it", kind) for kind, inside in SHAPES.items())
    with x64() if dtype == jnp.float64 else contextlib.nullcontext():
        scene = make_scene(body.replace('id="grey"', ""), dtype)
        cells = patches_module.cut_scene(scene, 150)

        def found(x, cells, shapes):
            patch, u = x
            primitive, p, n, _ = patches_module.point(cells, shapes, patch, u)
            back = at(cells.back, patch)
            # The normal of the patch's side, as seen by a ray that comes from there.
            t = jnp.full_like(u[0], 0.01)
            ray, hit = Ray(p + t * n, -n, 2 * t, jnp.int32(-1)), Hit(t, primitive, jnp.int32(-1))
            seen_from_back = dot(geometry.surface(shapes, ray, hit).n, ray.d) > 0
            return patches_module.patch_at(cells, shapes, primitive, p, back), seen_from_back == back

        patch = np.arange(cells.count, dtype=np.int32).repeat(64)
        u = jnp.asarray(np.random.default_rng(1).uniform(0.001, 0.999, (len(patch), 2)), dtype)
        again, same_side = jax.jit(native_map, static_argnums=0)(found, (patch, u), cells, scene.geometry)
        assert cells.area.dtype == dtype
        np.testing.assert_array_equal(again, patch)
        assert np.asarray(same_side).all()
    assert cells.count == 2 * len(cells.primitive)


@pytest.mark.parametrize("kind, area", [("rectangle", 4.0), ("disk", np.pi), ("sphere", 4 * np.pi), ("cube", 24.0)])
def test_areas_add_up_and_are_about_equal(make_scene, kind, area):
    cells = patches_module.cut_scene(make_scene(shape(kind, GREY)), 200)
    assert float(cells.area.sum()) == pytest.approx(area, rel=1e-5)
    assert 150 < cells.count < 260
    np.testing.assert_allclose(cells.area, area / cells.count, rtol=1e-5)


def test_black_sides_are_no_patches(make_scene):
    front = patches_module.cut_scene(make_scene(shape("rectangle", GREY)), 9)
    both = patches_module.cut_scene(make_scene(shape("rectangle", f'<bsdf type="twosided">{GREY}</bsdf>')), 9)
    assert (front.count, both.count) == (9, 18)
    assert not front.back.any()


# ---- bad input ------------------------------------------------------------------------------------------------------

GLASS = '<bsdf type="dielectric"/>'
MIRROR = '<bsdf type="conductor"/>'
CHECKERS = '<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf>'
SMOOTH = '<string name="filename" value="meshes/ball_smooth.ply"/>'
SKY = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'


@pytest.mark.parametrize(
    "body, words",
    [
        (shape("rectangle", GLASS), ["'it'", "dielectric", "diffuse"]),
        (shape("rectangle", MIRROR), ["'it'", "conductor", "diffuse"]),
        (shape("rectangle", CHECKERS), ["'it'", "texture"]),
        (shape("ply", SMOOTH + GREY), ["'it'", "smooth normals", "faceted=True"]),
        (shape("rectangle", GREY) + SKY, ["constant emitter"]),
        ("", ["without shapes"]),
    ],
)
def test_what_is_not_diffuse_is_named(make_scene, body, words):
    with pytest.raises(pj.InputError) as refusal:
        transport.operator(make_scene(body))
    assert all(word in str(refusal.value) for word in words)


def test_smooth_meshes_may_be_taken_as_faceted(make_scene):
    scene = make_scene(shape("ply", SMOOTH + GREY))
    assert transport.operator(scene, patches=1, rays=1, faceted=True).patches.count == len(scene.geometry.shape)


def test_patches_of_area_0_are_named(make_scene):
    scene = make_scene(shape("rectangle", GREY))
    (table,) = scene.geometry.tables
    flat = replace(table, frames=table.frames.at[:, 1].set(0))
    scene = replace(scene, geometry=replace(scene.geometry, tables=(flat,)))
    with pytest.raises(pj.InputError, match="'it' has a part of area 0"):
        transport.operator(scene)


@pytest.mark.parametrize("how", [{"patches": 0}, {"rays": 0}, {"seed": -1}, {"method": "guess"}])
def test_arguments_out_of_range_are_refused(make_scene, how):
    with pytest.raises(pj.InputError, match=next(iter(how))):
        transport.operator(make_scene(shape("rectangle", GREY)), **how)
