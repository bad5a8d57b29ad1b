"""Surfaces have a tangent, along which u grows, where a bsdf needs it; otherwise none is compiled."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs
from pathjax import description as desc
from pathjax.bsdfs import BSDF, Diffuse
from pathjax.core.types import BSDFSample, Ray
from pathjax.core.warp import square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.scene import build
from pathjax.sensors import Perspective
from pathjax.sensors.film import HDRFilm
from pathjax.shapes import Cube, Cylinder, Disk, Mesh, Rectangle, Sphere, geometry
from pathjax.shapes.ellipsoid import Ellipsoid


class Brushed(BSDF):
    """White where it is seen along the tangent rather than across it, else black."""

    smooth = anisotropic = True

    @staticmethod
    def evaluate(p, wi, wo):
        white = jnp.abs(wi[0]) > jnp.abs(wi[1])
        cos = jnp.where(white, jnp.maximum(wo[2], 0) / math.pi, 0)
        return jnp.stack([cos, cos, cos]), square_to_cosine_hemisphere_pdf(wo)

    @staticmethod
    def sample(p, wi, u):
        wo = square_to_cosine_hemisphere(u)
        one = jnp.ones_like(wo[2])
        white = (jnp.abs(wi[0]) > jnp.abs(wi[1])).astype(one.dtype)
        return BSDFSample(wo, white * jnp.stack([one] * 3), square_to_cosine_hemisphere_pdf(wo), jnp.bool_(False), one)


def geometry_of(shape, bsdf=Brushed):
    shapes = (desc.Shape("s", shape, bsdf.instance("b"), None, False),)
    view = desc.View(Perspective(np.eye(4), 45.0), HDRFilm(2, 2), 1, "independent")
    return build(desc.Description("test", view, desc.Integrator(), shapes)).geometry


SHEARED = np.array([[0.9, 0.5, 0.1, 0.1], [-0.2, 0.8, 0.3, 0.2], [0.3, -0.1, 0.7, 0.3], [0, 0, 0, 1]])
BALL = np.eye(4)
BALL[:3, :3] = np.linalg.qr(SHEARED[:3, :3])[0]
# The axis of a cylinder from y = -0.5 to 0.5.
UPRIGHT = np.array([[0, 1, 0, 0], [0, 0, 1, -0.5], [1, 0, 0, 0], [0, 0, 0, 1]])
TRIANGLE = np.array([[-1.0, -1, 0.2], [1.2, -0.8, 0], [0.1, 1.1, 0.4]])
UV = np.array([[0.1, 0.2], [0.3, 0.9], [0.8, 0.4]])
SHAPES = {
    "rectangle": Rectangle(SHEARED),
    "disk": Disk(SHEARED),
    "cube": Cube(SHEARED),
    "sphere": Sphere(np.zeros(3), 1.0, BALL),
    "ellipsoid": Ellipsoid(SHEARED),
    "cylinder": Cylinder(SHEARED @ UPRIGHT),
    "triangle": Mesh(TRIANGLE, np.array([[0, 1, 2]]), None, UV),
    "triangle without uv": Mesh(TRIANGLE, np.array([[0, 1, 2]]), None, None),
    "triangle of mirrored uv": Mesh(TRIANGLE, np.array([[0, 1, 2]]), None, UV[:, ::-1]),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_along_the_tangent_u_grows_and_v_stays(kind):
    shapes = geometry_of(SHAPES[kind])
    rng = np.random.default_rng(1)
    d = jnp.asarray(rng.normal(size=(200, 3)) * [0.1, 0.1, 1], jnp.float32)
    d = d / jnp.linalg.norm(d, axis=1, keepdims=True)
    target = jnp.asarray(rng.uniform(-0.3, 0.3, (200, 3)), jnp.float32)

    def see(o, d):
        ray = Ray(o, d, jnp.float32(np.inf), jnp.int32(-1))
        hit = geometry.closest_hit(shapes, ray)
        surface = geometry.surface(shapes, ray, hit)
        _, duv = jax.jvp(lambda o: geometry.surface(shapes, ray._replace(o=o), hit).uv, (o,), (surface.tangent,))
        return hit.primitive, surface, duv

    primitive, surface, duv = jax.jit(jax.vmap(see))(target - 5 * d, d)
    assert (primitive >= 0).mean() > 0.5
    found = np.asarray(primitive) >= 0
    tangent, n, duv = (np.asarray(x)[found] for x in (surface.tangent, surface.shading_n, duv))
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.sum(tangent * n, 1), 0, atol=1e-5)
    assert (duv[:, 0] > 0).all() and (np.abs(duv[:, 1]) < 1e-3 * duv[:, 0]).all()


def test_where_u_grows_nowhere_any_tangent_will_do():
    shapes = geometry_of(Mesh(TRIANGLE, np.array([[0, 1, 2]]), None, np.zeros((3, 2))))
    ray = Ray(jnp.array([0.0, 0, 5]), jnp.array([0.0, 0, -1]), jnp.float32(np.inf), jnp.int32(-1))
    surface = jax.jit(lambda ray: geometry.surface(shapes, ray, geometry.closest_hit(shapes, ray)))(ray)
    np.testing.assert_allclose(np.linalg.norm(surface.tangent), 1, rtol=1e-6)
    np.testing.assert_allclose(np.dot(surface.tangent, surface.n), 0, atol=1e-6)


def test_no_tangent_is_told_where_no_bsdf_asks():
    shapes = geometry_of(Rectangle(SHEARED), Diffuse)
    ray = Ray(jnp.array([0.0, 0, 5]), jnp.array([0.0, 0, -1]), jnp.float32(np.inf), jnp.int32(-1))
    assert geometry.surface(shapes, ray, geometry.closest_hit(shapes, ray)).tangent is None


@pytest.mark.parametrize("origin, seen", [("2, 0, 1", 1), ("0, 2, 1", 0)])
def test_an_anisotropic_bsdf_is_rendered_in_its_frame(make_scene, monkeypatch, origin, seen):
    monkeypatch.setattr(bsdfs, "KINDS", {**bsdfs.KINDS, "brushed": Brushed})
    plate = '<shape type="rectangle"><bsdf type="brushed"/></shape><emitter type="constant"/>'
    image = pj.render(make_scene(plate, origin=origin, up="0, 0, 1", fov=1, depth=2, res=4), 4)
    np.testing.assert_allclose(image, seen, rtol=1e-6)
