"""Ellipsoids: hits agree with float64, and points, normals and derivatives are those of the surface."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import description as desc
from pathjax import transport
from pathjax.bsdfs import Diffuse
from pathjax.core.types import Ray
from pathjax.description.transform import Transform
from pathjax.scene import build
from pathjax.sensors import Perspective
from pathjax.sensors.film import HDRFilm
from pathjax.shapes import geometry
from pathjax.shapes.ellipsoid import Ellipsoid

GREY = Diffuse.instance("grey")


def ellipsoids(n, seed=0, scale=1.0, shift=0.0):
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        m = np.eye(4)
        turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        m[:3, :3] = turned * rng.uniform(0.15, 0.5, 3) @ (np.eye(3) + rng.uniform(-0.4, 0.4, (3, 3)))
        m[:3, 3] = rng.uniform(-1, 1, 3)
        m[:3] *= scale
        m[:3, 3] += shift
        made.append(Ellipsoid(m))
    return made


def scene_of(shapes, flip=False, dtype=jnp.float32):
    made = tuple(desc.Shape(f"s{i}", shape, GREY, None, flip) for i, shape in enumerate(shapes))
    view = desc.View(Perspective(np.eye(4), 45.0), HDRFilm(2, 2), 1, "")
    return build(desc.Description("t", view, desc.Integrator(), made), dtype)


def rays(n, seed=1, scale=1.0, shift=0.0):
    rng = np.random.default_rng(seed)
    o = rng.uniform(-1.5, 1.5, (n, 3))
    d = rng.uniform(-1.5, 1.5, (n, 3)) - o
    return np.float32(o * scale + shift), np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


@jax.jit
def seen(shapes, o, d, exclude):
    def see(o, d, exclude):
        ray = Ray(o, d, jnp.asarray(jnp.inf, o.dtype), exclude)
        hit = geometry.closest_hit(shapes, ray)
        return hit, geometry.surface(shapes, ray, hit)

    return jax.vmap(see)(o, d, exclude)


def reference(shapes, o, d):
    """Return distances (N, P) in float64, and whether rounding of coordinates of size 1 may decide."""
    t, unsure = [], []
    for shape in shapes:
        to_local = np.linalg.inv(shape.to_world)
        f, g = np.float64(o) @ to_local[:3, :3].T + to_local[:3, 3], np.float64(d) @ to_local[:3, :3].T
        a, b, c = (g * g).sum(1), (f * g).sum(1), (f * f).sum(1) - 1
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        both = np.stack([-b - root, -b + root]) / a
        t.append(np.where((b * b > a * c) & (both > 0), both, np.inf).min(0))
        unsure.append((np.abs(b * b - a * c) < 1e-4 * b * b) | (np.abs(both) < 1e-4).any(0))
    return np.stack(t, 1), np.stack(unsure, 1)


@pytest.mark.parametrize("count", [3, 60])
def test_rays_hit_as_float64_says(count):
    shapes = ellipsoids(count)
    o, d = rays(20_000)
    hit, _ = seen(scene_of(shapes).geometry, o, d, np.full(len(o), -1, np.int32))
    t, unsure = reference(shapes, o, d)
    clear = ~unsure.any(1)
    assert clear.mean() > 0.8 and (t.min(1) < np.inf).sum() > 500
    np.testing.assert_allclose(np.asarray(hit.t)[clear], t.min(1)[clear], rtol=1e-4, atol=1e-5)
    met = clear & (t.min(1) < np.inf)
    told = np.asarray(hit.primitive)[met]
    assert (t[met, told] <= t[met].min(1) * (1 + 1e-4) + 1e-5).all()


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0), (1e5, 0), (1, 300)])
def test_points_and_normals_lie_on_ellipsoids_of_every_size_and_place(scale, shift):
    shapes = ellipsoids(6, scale=scale, shift=shift)
    o, d = rays(5000, scale=scale, shift=shift)
    hit, surface = seen(scene_of(shapes, flip=True).geometry, o, d, np.full(len(o), -1, np.int32))
    met = np.flatnonzero(np.asarray(hit.primitive) >= 0)
    assert len(met) > 300
    to_local = np.linalg.inv([shape.to_world for shape in shapes])[np.asarray(hit.primitive)[met]]
    rounding = 1e-5 * (1 + shift / scale)
    local = np.einsum("nij,nj->ni", to_local[:, :3, :3], np.float64(surface.p)[met]) + to_local[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1, atol=20 * rounding)
    n = np.einsum("nj,nji->ni", local, to_local[:, :3, :3])  # the gradient of |local|^2
    n = -n / np.linalg.norm(n, axis=1, keepdims=True)  # they are flipped
    np.testing.assert_allclose((n * np.float64(surface.n)[met]).sum(1), 1, atol=100 * rounding)


def test_a_ray_that_leaves_an_ellipsoid_meets_its_other_side_alone():
    shapes = scene_of(ellipsoids(3, seed=4)).geometry
    o, d = rays(4000, seed=5)
    hit, surface = seen(shapes, o, d, np.full(len(o), -1, np.int32))
    met = np.asarray(hit.primitive) >= 0
    out = np.random.default_rng(6).normal(size=(4000, 3))
    out = np.float32(out / np.linalg.norm(out, axis=1, keepdims=True))
    next_hit, _ = seen(shapes, surface.p, out, hit.primitive)
    same = met & (np.asarray(next_hit.primitive) == np.asarray(hit.primitive))
    assert same.sum() > 300 and ((np.asarray(surface.n) * out).sum(1)[same] < 0).all()


def test_derivatives_are_those_of_the_surface(x64):
    """Central differences in float64 of the point, the normal and uv in the ray's origin."""
    with x64():
        shapes = scene_of(ellipsoids(2, seed=3), dtype=jnp.float64).geometry
        o, d = (np.float64(x) for x in rays(300, seed=2))

        def at(o, d, t, primitive):
            hit = geometry.Hit(t, primitive, primitive)
            surface = geometry.surface(shapes, Ray(o, d, jnp.inf, jnp.int32(-1)), hit)
            return jnp.concatenate([surface.p, surface.n, surface.uv])

        hit, surface = seen(shapes, o, d, np.full(len(o), -1, np.int32))
        # Where the surface is seen edge-on, second derivatives are unbounded.
        clear = (np.asarray(hit.primitive) >= 0) & (np.abs((np.asarray(surface.n) * d).sum(1)) > 0.2)
        args = (x[clear] for x in (o, d, np.asarray(hit.t), np.asarray(hit.primitive)))
        o, d, t, primitive = args
        ends_at, forward, reverse = (jax.jit(jax.vmap(f)) for f in (at, jax.jacfwd(at), jax.jacrev(at)))
        forward, reverse = (np.asarray(f(o, d, t, primitive)) for f in (forward, reverse))
        h = 1e-6
        for axis in range(3):
            step = h * np.eye(3)[axis]
            ends = [np.asarray(ends_at(o + sign * step, d, t, primitive)) for sign in (1, -1)]
            difference = (ends[0] - ends[1] + np.array([0] * 6 + [0.5, 0])) / (2 * h)
            difference[:, 6] = (difference[:, 6] * 2 * h) % 1 / (2 * h) - 0.5 / (2 * h)
            np.testing.assert_allclose(forward[:, :, axis], difference, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-8)


def test_two_in_one_place_are_left_together():
    """Also where one is rotated in its local space, which does not change its surface."""
    (one,) = ellipsoids(1)
    turned = Ellipsoid(one.to_world @ Transform().rotate([0.6, 0, 0.8], 40).matrix)
    assert scene_of([one, *ellipsoids(1, seed=9)]).geometry.tables[0].margins is None
    assert (np.asarray(scene_of([one, turned]).geometry.tables[0].margins) > 0).all()


def test_a_furnace_holds_an_ellipsoid_and_patches_do_not():
    """White and lit from all sides, it equals the sky up to rounding: no light is lost, and no surface is met twice."""
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    shown = {"type": "instance", "to_world": Transform().rotate([0, 0, 1], 30).scale([1, 0.4, 0.7])}
    scene = pj.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "to_world": Transform().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0])}
            | {"film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "group": {"type": "shapegroup", "ball": ball},
            "shown": {**shown, "of": {"type": "ref", "id": "group"}},
            "sky": {"type": "constant"},
        }
    )
    np.testing.assert_allclose(pj.render(scene, spp=16), 1, rtol=1e-5)
    with pytest.raises(pj.InputError, match="round and scaled unevenly"):
        transport.operator(scene, patches=10)
