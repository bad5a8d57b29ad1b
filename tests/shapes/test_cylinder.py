"""Cylinders: hits agree with float64, points and normals lie on the surface, and light samples have their density."""

from __future__ import annotations

import math
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import description as desc
from pathjax import transport
from pathjax.bsdfs import Diffuse
from pathjax.core.types import Ray
from pathjax.emitters import Area
from pathjax.errors import InputError
from pathjax.scene import build
from pathjax.sensors import Perspective
from pathjax.sensors.film import HDRFilm
from pathjax.shapes import Cylinder, Disk, geometry
from pathjax.shapes.cylinder import CLEAR

GREY = Diffuse.instance("grey")


def rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def placed(rng, radius, length, middle):
    m = np.eye(4)
    m[:3, :3] = rotation(rng) * [radius, radius, length]
    m[:3, 3] = middle
    return Cylinder(m)


# Elliptic, and oblique.
UNEVEN = np.array([[1, 0.3, 0.1, 0], [0, 2, 0.4, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def cylinders(n, seed=0, uneven=False):
    rng = np.random.default_rng(seed)
    made = [placed(rng, rng.uniform(0.05, 0.4), rng.uniform(0.1, 1), rng.uniform(-1, 1, 3)) for _ in range(n)]
    return [Cylinder(each.to_world @ UNEVEN) for each in made] if uneven else made


def scene_of(*shapes, dtype=jnp.float32, flip=False, light=None):
    made = tuple(desc.Shape(f"s{i}", g, GREY, light, flip) for i, g in enumerate(shapes))
    view = desc.View(Perspective(np.eye(4), 45.0), HDRFilm(2, 2), 1, "")
    about = desc.Description("t", view, desc.Integrator(), made)
    return build(about, dtype)


def rays(n, seed=1, reach=1.5, scale=1.0, shift=0.0):
    rng = np.random.default_rng(seed)
    o = rng.uniform(-reach, reach, (n, 3))
    d = rng.uniform(-reach, reach, (n, 3)) - o
    o = np.float32(o * scale + shift)
    return o, np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


@jax.jit
def seen(shapes, o, d):
    def see(o, d):
        ray = Ray(o, d, jnp.asarray(jnp.inf, o.dtype), jnp.int32(-1))
        hit = geometry.closest_hit(shapes, ray)
        return hit, geometry.surface(shapes, ray, hit)

    return jax.vmap(see)(o, d)


def reference(shapes, o, d):
    """Return distances (N, P) in float64, and whether rounding of coordinates of size 1 may decide."""
    t, unsure = [], []
    for shape in shapes:
        to_local = np.linalg.inv(shape.to_world)
        f = np.float64(o) @ to_local[:3, :3].T + to_local[:3, 3]
        g = np.float64(d) @ to_local[:3, :3].T
        a, b, c = (g[:, :2] ** 2).sum(1), (f[:, :2] * g[:, :2]).sum(1), (f[:, :2] ** 2).sum(1) - 1
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        both = np.stack([-b - root, -b + root]) / a
        z = f[:, 2] + both * g[:, 2]
        inside = (b * b > a * c) & (z >= 0) & (z <= 1) & (both > 0)
        t.append(np.where(inside, both, np.inf).min(0))
        close = np.abs(b * b - a * c) < 1e-4 * b * b
        unsure.append(close | (np.minimum(np.abs(z), np.abs(z - 1)) < 1e-4).any(0) | (np.abs(both) < 1e-4).any(0))
    return np.stack(t, 1), np.stack(unsure, 1)


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize(
    "count", [1, pytest.param(5, marks=pytest.mark.slow), pytest.param(60, marks=pytest.mark.slow)]
)
def test_rays_hit_as_float64_says(count, uneven):
    shapes = cylinders(count, uneven=uneven)
    o, d = rays(20_000)
    hit, _ = seen(scene_of(*shapes).geometry, o, d)
    t, unsure = reference(shapes, o, d)
    clear = ~unsure.any(1)
    assert clear.mean() > 0.8 and (t.min(1) < np.inf).sum() > 500
    np.testing.assert_allclose(np.asarray(hit.t)[clear], t.min(1)[clear], rtol=1e-4, atol=1e-5)
    met = clear & (t.min(1) < np.inf)
    # Where two are hit at the same distance either may be reported.
    told = np.asarray(hit.primitive)[met]
    assert (t[met, told] <= t[met].min(1) * (1 + 1e-4) + 1e-5).all()


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0), (1e5, 0), (1, 300)])
def test_points_and_normals_lie_on_cylinders_of_every_size_and_place(scale, shift, uneven):
    shapes = cylinders(6, uneven=uneven)
    for shape in shapes:
        shape.to_world[:3] *= scale
        shape.to_world[:3, 3] += shift
    o, d = rays(5000, scale=scale, shift=shift)
    hit, surface = seen(scene_of(*shapes).geometry, o, d)
    met = np.flatnonzero(np.asarray(hit.primitive) >= 0)
    assert len(met) > 300
    to_world = np.array([shape.to_world for shape in shapes])[np.asarray(hit.primitive)[met]]
    to_local = np.linalg.inv(to_world)
    rounding = 1e-5 * (1 + shift / scale)  # relative to the cylinder; coordinates are as large as the shift
    p = np.float64(surface.p)[met]
    local = np.einsum("nij,nj->ni", to_local[:, :3, :3], p) + to_local[:, :3, 3]
    np.testing.assert_allclose(np.hypot(*local[:, :2].T), 1, atol=20 * rounding)
    assert local[:, 2].min() > -20 * rounding and local[:, 2].max() < 1 + 20 * rounding
    # The gradient of x^2 + y^2 in the space where the cylinder is round.
    n = np.einsum("nj,nji->ni", local[:, :2], to_local[:, :2, :3])
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    np.testing.assert_allclose((n * np.float64(surface.n)[met]).sum(1), 1, atol=100 * rounding)
    np.testing.assert_allclose(np.linalg.norm(surface.n, axis=1)[met], 1, atol=1e-5)


def test_rays_along_the_axis_pass_through():
    shapes = scene_of(Cylinder(np.eye(4))).geometry
    o = np.float32([[0, 0, -3], [0.5, 0.2, -3], [0.999, 0, 5], [0, 0, 0.5]])
    d = np.float32([[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, -1]])
    assert (np.asarray(seen(shapes, o, d)[0].t) == np.inf).all()


def test_a_ray_that_leaves_a_cylinder_meets_its_other_side_alone():
    shapes = scene_of(*cylinders(3, seed=4)).geometry
    o, d = rays(4000, seed=5)
    hit, surface = seen(shapes, o, d)
    met = np.asarray(hit.primitive) >= 0
    out = np.random.default_rng(6).normal(size=(4000, 3))
    out = np.float32(out / np.linalg.norm(out, axis=1, keepdims=True))

    def leave(p, d, primitive):
        return geometry.closest_hit(shapes, Ray(p, d, jnp.float32(jnp.inf), primitive))

    next_hit = jax.jit(jax.vmap(leave))(surface.p, out, hit.primitive)
    same = met & (np.asarray(next_hit.primitive) == np.asarray(hit.primitive))
    outwards = (np.asarray(surface.n) * out).sum(1)
    assert same.sum() > 100 and (outwards[same] < 0).all()
    row = np.asarray(hit.primitive)
    radius, _, length = np.moveaxis(np.linalg.norm(np.asarray(shapes.tables[0].to_world)[row, :, :3], axis=1), 1, 0)
    axis = np.asarray(shapes.tables[0].to_world)[row, :, 2] / length[:, None]
    across = 1 - (axis * out).sum(1) ** 2
    chord = -2 * radius * outwards / across  # to the other side of a circle, along a slanted ray
    np.testing.assert_allclose(np.asarray(next_hit.t)[same], chord[same], rtol=2e-3, atol=1e-4)


def test_disks_close_a_cylinder_without_a_gap():
    rng = np.random.default_rng(7)
    tube = placed(rng, 0.7, 1.3, [0.3, -2, 1])
    caps = []
    for end in (0, 1):
        m = tube.to_world.copy()
        m[:3, 3] += end * m[:3, 2]
        caps.append(Disk(m @ np.diag([1, 1, 0.1, 1])))
    shapes = scene_of(tube, *caps).geometry
    o = np.float32((tube.to_world @ [0.1, 0.2, 0.5, 1])[:3])
    # Rays towards the rims, to within rounding.
    angle = rng.uniform(0, 2 * np.pi, 50_000)
    near = rng.uniform(-3e-7, 3e-7, (2, 50_000))
    radius = 1 + near[0]
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), (angle > 3) + near[1], np.ones(50_000)])
    d = (tube.to_world @ rim)[:3].T - o
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    hit, _ = seen(shapes, np.broadcast_to(o, d.shape), d)
    assert (np.asarray(hit.t) < np.inf).all()


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
def test_area_and_coordinates_are_those_of_the_surface(dtype, x64):
    with x64() if dtype == np.float64 else nullcontext():
        table = scene_of(*cylinders(3), dtype=dtype).geometry.tables[0]
        axes = np.asarray(table.to_world)[:, :, :3]
        radius, _, length = np.linalg.norm(axes, axis=1).T
        np.testing.assert_allclose(table.areas(), 2 * math.pi * radius * length, rtol=1e-6)
        xy = np.random.default_rng(0).random((3, 2)).astype(dtype)

        @jax.jit
        def there_and_back(row, xy):
            p, n, _ = table.from_square(row, xy)
            return p, n, table.to_square(row, p)

        for row in range(3):
            p, n, back = there_and_back(jnp.int32(row), jnp.asarray(xy[row]))
            np.testing.assert_allclose(back, xy[row], atol=1e-5)
            assert abs(float(np.asarray(n) @ axes[row, :, 2])) < 1e-5 and p.dtype == dtype


@pytest.mark.parametrize("uneven", [False, True])
def test_light_is_drawn_with_the_density_that_is_told(uneven):
    """The mean of 1 / pdf is the solid angle of the part that faces the point."""
    shapes = cylinders(1, seed=2, uneven=uneven)
    scene = scene_of(*shapes, light=Area.instance("l", radiance=np.ones(3)))
    lamps, ref = scene.emitters[0].lamps, jnp.float32([0.5, 2.0, 0.3])
    u = jnp.asarray(np.random.default_rng(0).random((20_000, 2)), jnp.float32)

    @jax.jit
    @jax.vmap
    def draw(u):
        drawn = geometry.sample_lamp(scene.geometry, lamps, jnp.int32(0), ref, u, jnp.float32(0.5))
        ray = Ray(ref, drawn.d, jnp.float32(jnp.inf), jnp.int32(-1))
        hit = geometry.closest_hit(scene.geometry, ray)
        surface = geometry.surface(scene.geometry, ray, hit)
        return drawn, hit, geometry.lamp_density(scene.geometry, lamps, jnp.int32(0), ray, hit, surface)

    drawn, hit, density = jax.tree.map(np.asarray, draw(u))
    front = (drawn.n * drawn.d).sum(1) < -0.1  # where it is seen edge-on, rounding changes the hit
    assert front.mean() > 0.3
    np.testing.assert_allclose(hit.t[front], drawn.distance[front], rtol=1e-3)
    np.testing.assert_allclose(density[front], drawn.pdf[front], rtol=2e-2)
    # Quadrature of the solid angle over the surface, in float64.
    k = 1000
    angle, z = np.meshgrid((np.arange(k) + 0.5) / k * 2 * np.pi, (np.arange(k) + 0.5) / k)
    local = np.stack([np.cos(angle), np.sin(angle), z, np.ones_like(z)], -1).reshape(-1, 4)
    m = shapes[0].to_world
    p = (local @ m.T)[:, :3]
    # Normal times area: the cross product of the derivative around and the axis.
    n = np.cross(local[:, :1] * m[:3, 1] - local[:, 1:2] * m[:3, 0], m[:3, 2])
    to_p = p - np.float64(ref)
    squared = (to_p**2).sum(1)
    cos = (to_p * n).sum(1) / np.sqrt(squared)
    expected = np.where(cos < 0, np.abs(cos) / squared, 0).mean() * 2 * np.pi
    np.testing.assert_allclose(scene.emitters[0].lamps.area, np.linalg.norm(n, axis=1).mean() * 2 * np.pi, rtol=1e-5)
    facing = ((drawn.n * drawn.d).sum(1) < 0) & (drawn.pdf > 0)
    values = np.where(facing, 1 / np.where(facing, drawn.pdf, 1), 0).astype(float)
    # A correct sampler fails once in 15,000.
    assert abs(values.mean() - expected) < 4 * values.std() / np.sqrt(len(values))


@pytest.mark.parametrize("uneven", [False, True])
def test_the_inner_wall_is_drawn_only_where_the_outer_one_does_not_hide_it(uneven):
    shapes = cylinders(1, seed=2, uneven=uneven)
    scene = scene_of(*shapes, light=Area.instance("l", radiance=np.ones(3)), flip=True)
    lamps, m = scene.emitters[0].lamps, shapes[0].to_world
    # Beside it, beyond its end, and inside.
    refs = np.float32([[0.5, 2.0, 0.3], (m @ [0.4, 0.2, 2.5, 1])[:3], (m @ [0.4, 0.2, 0.5, 1])[:3]])
    u = jnp.asarray(np.random.default_rng(0).random((4000, 2)), jnp.float32)

    @jax.jit
    def draw(ref):
        def one(u):
            drawn = geometry.sample_lamp(scene.geometry, lamps, jnp.int32(0), ref, u, jnp.float32(0.5))
            ray = Ray(ref, drawn.d, jnp.float32(jnp.inf), jnp.int32(-1))
            return drawn, geometry.closest_hit(scene.geometry, ray).t

        return jax.vmap(one)(u)

    for ref, some_hidden in zip(refs, (True, None, False), strict=True):
        drawn, t = jax.tree.map(np.asarray, draw(ref))
        front = (drawn.n * drawn.d).sum(1) < -0.05
        hidden, clear = t < drawn.distance * (1 - 2 * CLEAR), t > drawn.distance * (1 - CLEAR / 2)
        assert (drawn.pdf[front & hidden] == 0).all() and (drawn.pdf[front & clear] > 0).all()
        assert some_hidden or (front & clear).any()
        assert some_hidden is None or (front & hidden).any() == some_hidden


@pytest.mark.slow
def test_strategies_agree_on_a_cylinder_that_shines_inwards(make_scene, estimate, agree):
    turned = '<transform name="to_world"><rotate y="1" angle="90"/><translate x="-1.5"/></transform>'
    tube = f"""<shape type="cylinder"><point name="p0" value="-0.6, 0.5, 0"/><point name="p1" value="0.5, 0.6, 0.3"/>
    <float name="radius" value="0.35"/><boolean name="flip_normals" value="true"/>
    <bsdf type="diffuse"/><emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>
    <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform></shape>
    <shape type="rectangle">{turned}</shape>"""
    scene = make_scene(tube, origin="1.5, 2, 4", target="0, 0.4, 0", depth=3)
    first = estimate(scene, spp=64, count=16, strategy="mis")
    for strategy, seed in (("light", 101), ("bsdf", 201)):
        agree(first, estimate(scene, spp=64, count=16, first_seed=seed, strategy=strategy))


@pytest.mark.slow
def test_a_closed_cylinder_that_shines_inside_has_the_radiance_of_the_geometric_series(write_scene):
    """L = Le / (1 - rho) everywhere, by patches whose areas add up to that of the surface."""
    inside = """<emitter type="area"><rgb name="radiance" value="1"/></emitter>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>"""
    top = '<transform name="to_world"><rotate x="1" angle="180"/><translate z="1"/></transform>'
    wall = '<shape type="cylinder"><boolean name="flip_normals" value="true"/>'
    body = f'{wall}{inside}<shape type="disk">{inside}<shape type="disk">{top}{inside}'
    op = transport.operator(pj.load_scene(write_scene(body)), patches=100)
    assert op.area.sum() == pytest.approx(4 * math.pi, rel=1e-5)
    np.testing.assert_allclose(op.solve().L, 2, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "inside",
    [
        {},
        {"p0": [0, 0, -1], "p1": [0.4, 0.5, 1], "radius": 0.7},
        {"p0": [0, 0, 1], "p1": [0, 0, -1], "radius": 0.5, "flip_normals": True},
        {"p1": [0, 0.2, 1], "to_world": np.diag([-1.0, 1, 1, 1])},
        {"to_world": np.diag([1.5, 1.5, 0.7, 1])},
        {"to_world": np.diag([1.5, 0.6, 0.7, 1])},
        {"p1": [0, 0.2, 1], "to_world": UNEVEN},
    ],
)
def test_cylinders_are_those_of_mitsuba(write_scene, inside):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    theirs = dict(inside)
    text = "".join(f'<point name="{k}" value="{", ".join(map(str, inside[k]))}"/>' for k in ("p0", "p1") if k in inside)
    text += f'<float name="radius" value="{inside["radius"]}"/>' if "radius" in inside else ""
    text += '<boolean name="flip_normals" value="true"/>' if "flip_normals" in inside else ""
    if "to_world" in inside:
        matrix = " ".join(map(str, inside["to_world"].ravel()))
        text += f'<transform name="to_world"><matrix value="{matrix}"/></transform>'
        theirs["to_world"] = mi.ScalarTransform4f(inside["to_world"])
    shape = mi.load_dict({"type": "cylinder", **theirs})
    scene = pj.load_scene(write_scene(f'<shape type="cylinder">{text}</shape><emitter type="constant"/>'))
    o, d = rays(300, seed=8, reach=1.5)
    hit, surface = jax.tree.map(np.asarray, seen(scene.geometry, o, d))
    met = 0
    for i in range(len(o)):
        si = shape.ray_intersect(mi.Ray3f(o[i].tolist(), d[i].tolist()))
        assert si.is_valid() == (hit.t[i] < np.inf)
        if si.is_valid():
            met += 1
            np.testing.assert_allclose(hit.t[i], si.t, rtol=2e-4)
            np.testing.assert_allclose(surface.p[i], si.p, atol=2e-4)
            np.testing.assert_allclose(surface.n[i], si.n, atol=1e-3)
            turn = (surface.uv[i] - np.asarray(si.uv) + 0.5) % 1 - 0.5
            np.testing.assert_allclose(turn, 0, atol=1e-3)
    assert met > 50


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ('<float name="radius" value="0"/>', "must be above 0"),
        ('<point name="p1" value="0, 0, 0"/>', "the two are the ends of the axis"),
        ('<transform name="to_world"><matrix value="1 1 0 0 1e-9 0 0 0 1"/></transform>', "a cylinder that is flat"),
    ],
)
def test_cylinders_that_are_none_are_refused(write_scene, inside, words):
    with pytest.raises(InputError, match=r"scene\d+.xml:\d+: ") as error:
        pj.load_scene(write_scene(f'<shape type="cylinder">{inside}</shape>'))
    assert words in str(error.value)
