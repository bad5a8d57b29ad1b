"""JAX's debug flags, which users set to find bugs of their own, report nothing in healthy scenes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import transport

SLOW = pytest.mark.slow
# Boxes and rectangles; triangles in a tree, whose leaves have empty lanes; a sphere and glass, whose derivatives are
# quick; the rest.
SCENES = ["cornell_box", "mesh", *(pytest.param(n, marks=SLOW) for n in ("glass_ball", "textures", "conductors"))]


@pytest.fixture(autouse=True)
def flags():
    """Set all flags at once: each raises an error of its own, while an array is computed or a program is traced."""
    with jax.debug_nans(True), jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def test_each_flag_finds_its_fault():
    for fault, error, words in (
        (lambda: jnp.zeros(3) / 0, FloatingPointError, "nan"),
        (lambda: jnp.ones(3, jnp.int32) + jnp.ones(3), ValueError, "dtype promotion"),
        (lambda: jnp.ones((2, 3)) + jnp.ones(3), ValueError, "rank_promotion"),
    ):
        with pytest.raises(error, match=words):
            fault()


@pytest.mark.parametrize("name", SCENES)
def test_scenes_load_and_render(shipped, name):
    scene = shipped(name, res=16)  # shares its kernel with other tests
    scene = pj.with_parameters(scene, pj.parameters(scene))
    assert np.isfinite(pj.render(scene, 2)).all()
    assert np.isfinite(pj.render_aovs(scene, ["depth"])["depth"]).any()
    assert pj.closest_hit(scene, np.zeros((1, 3)), np.ones((1, 3))).t.shape == (1,)


def test_images_with_errors_and_terms_of_the_series(shipped):
    """One sample per pixel has no standard error; it is reported as nan without tripping a flag."""
    scene = shipped("cornell_box", res=64)  # the scene of the manual, which shares its kernels
    assert pj.render_until(scene, spp=5).reason
    assert np.isnan(pj.render_until(scene, spp=1).standard_error).all()
    assert np.isfinite(pj.render_bounces(scene, depth=8, spp=8).standard_error).all()


def test_derivatives(shipped):
    scene = shipped("glass_ball", res=64)  # the scene of the manual, which shares its kernels
    ior, grey = "glass.int_ior", "pattern.color0"

    def loss(name, value):
        return jnp.sum(pj.render(pj.with_parameters(scene, {name: value}), 2))

    gradient = jax.jit(jax.grad(partial(loss, ior)))(1.5)  # inside jit, the differentiation rule is called later
    _, J = pj.jacobian(scene, [ior], 2)
    np.testing.assert_allclose(gradient, J[ior].sum(), atol=1e-5 * np.abs(J[ior]).sum())
    assert jax.grad(partial(loss, grey))(0.5) > 0


@pytest.mark.slow
def test_fits_and_checks_of_gradients(shipped):
    scene = shipped("cornell_box", res=8)
    name = "white.reflectance"
    target = pj.render(scene, 64, seed=5)
    fit = pj.fit(pj.with_parameters(scene, {name: 0.5}), target, [name])
    np.testing.assert_allclose(fit.values[name], pj.parameters(scene)[name], atol=0.1)
    assert pj.check_gradient(scene, name, spp=8)


def test_light_on_patches(shipped):
    scene = shipped("cornell_box", res=64)  # the scene of the manual
    op = transport.operator(scene, patches=200)
    assert np.isfinite(op.solve().L).all() and np.isfinite(op.terms(5)).all()
    radius = np.asarray(op.spectral_radius())  # per channel
    assert (radius > 0).all() and (radius < 1).all()
    assert np.isfinite(transport.image(scene, op.radiosity(op.Le), 1)).all()
