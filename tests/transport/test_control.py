"""Roulette that ends paths with a solution on patches: the mean stays the same whatever the patches hold."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import transport
from pathjax.integrators import pixel
from pathjax.integrators.options import Options
from pathjax.rendering.render import pixel_means
from pathjax.scene.scene import UNBOUNDED

BALL = """<shape type="sphere"><boolean name="flip_normals" value="true"/><bsdf type="diffuse">
  <rgb name="reflectance" value="0.3, 0.6, 0.9"/></bsdf><emitter type="area"/></shape>"""


@pytest.fixture(scope="module")
def box(shipped):
    """A scene of long paths, its operator, and the light on its patches."""
    scene = shipped("cornell_box", res=16, max_depth=32)
    op = transport.operator(scene, 100)
    return scene, op, op.solve().L


@pytest.fixture(scope="module")
def plain(box, estimate):
    return estimate(box[0], spp=256, first_seed=101)


def lights(L):
    noise = np.random.default_rng(0).uniform(0, 2, L.shape)
    return {"solution": L, "nothing": 0 * L, "noise": L * jnp.asarray(noise, L.dtype)}


# ---- closed form ----------------------------------------------------------------------------------------------------


def test_exact_control_leaves_no_noise_where_a_path_ends(make_scene, estimate):
    """Inside a sphere that emits 1, L = 1 / (1 - rho) everywhere. With bsdf sampling alone every path gathers
    1 + rho + rho^2 + ..., and a control that knows the sum ends it anywhere without noise.
    """
    rho = np.array([0.3, 0.6, 0.9])
    scene = replace(make_scene(BALL, res=8, origin="0, 0, 0.5"), max_depth=np.int32(UNBOUNDED))
    op = transport.operator(scene, 50)
    image = estimate(scene, spp=16, strategy="bsdf", control=op.control(op.solve().L))
    np.testing.assert_allclose(image.mean, np.broadcast_to(1 / (1 - rho), image.mean.shape), rtol=2e-4)
    assert 1e4 * image.variance.max() < estimate(scene, spp=16, strategy="bsdf").variance.max()


# ---- against the default --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("held", ["solution", "nothing", pytest.param("noise", marks=pytest.mark.slow)])
@pytest.mark.parametrize("effort", [2.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_mean_stays_whatever_the_patches_hold(box, plain, estimate, agree, held, effort):
    scene, op, L = box
    agree(estimate(scene, spp=256, control=op.control(lights(L)[held], effort)), plain)


@pytest.mark.slow
def test_mean_stays_over_1e8_paths(box, estimate, agree):
    scene, op, L = box
    many = {"spp": 1 << 14, "count": 24}  # of 256 pixels: 1.01e8
    agree(estimate(scene, **many, control=op.control(L)), estimate(scene, **many, first_seed=1001))


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["light", "bsdf"])
def test_mean_stays_with_other_strategies_and_hidden_lights(box, estimate, agree, strategy):
    scene, op, L = box
    scene = replace(scene, hide_emitters=True)
    agree(
        estimate(scene, spp=256, strategy=strategy, control=op.control(L)),
        estimate(scene, spp=256, strategy="mis", first_seed=101),
    )


def test_solution_takes_noise_from_roulette(box, estimate):
    """Survival does not depend on the scale of the light: with almost none, paths are as long but end in darkness."""
    scene, op, L = box
    bright, dark = (estimate(scene, spp=64, control=op.control(scale * L, 0.5)).variance.mean() for scale in (1, 1e-6))
    assert bright < 0.8 * dark


@pytest.mark.slow
def test_float64_has_the_same_image(box, shipped, x64):
    scene, op, L = box
    single = np.asarray(pj.render(scene, 4, control=op.control(L)))
    with x64():
        double_scene = shipped("cornell_box", jnp.float64, res=16, max_depth=32)
        op = transport.operator(double_scene, 100)
        double = np.asarray(pj.render(double_scene, 4, control=op.control(op.solve().L)))
    assert double.dtype == np.float64
    assert np.isclose(single, double, rtol=1e-3, atol=1e-5).all(-1).mean() > 0.9


def test_one_image_with_jit_and_without(box):
    scene, op, L = box

    @jax.jit
    def image(L):
        return pj.render(scene, 4, control=op.control(L))

    np.testing.assert_allclose(image(L), pj.render(scene, 4, control=op.control(L)), rtol=1e-4, atol=1e-6)


def test_nothing_of_it_is_compiled_without(box):
    scene, op, L = box
    pixels = jnp.arange(144, dtype=jnp.int32)
    work = replace(scene, about=None), pixels, *pixel.numbers(pixels, 0, 4, 1)

    def holds_control(control):
        lowered = pixel_means.lower(*work, control, options=Options(controlled=control is not None), form="loop")
        return "/transport/control.py" in lowered.as_text(debug_info=True)

    assert not holds_control(None) and holds_control(op.control(L))


# ---- bad input ------------------------------------------------------------------------------------------------------


def test_what_is_no_control_is_refused(box):
    with pytest.raises(pj.InputError, match="control = 'radiosity'; give a transport.Control"):
        pj.render(box[0], 4, control="radiosity")


def test_control_of_other_shapes_is_refused(box, shipped):
    _, op, L = box
    with pytest.raises(pj.InputError, match="made of a scene of .* primitives"):
        pj.render(shipped("triangle_box", res=12), 4, control=op.control(L))


def test_derivatives_with_a_control_are_refused(box):
    scene, op, L = box
    with pytest.raises(pj.InputError, match="derivatives are not made with a control"):
        jax.grad(lambda r: pj.render(pj.with_parameters(scene, {"light.radiance": r}), 4, control=op.control(L)).sum())(
            jnp.ones(3)
        )
