"""`check_gradient`: right derivatives pass, wrong ones do not."""

from dataclasses import replace

import numpy as np
import pytest

import pathjax as pj
from pathjax.rendering import check

ROOM = """
<bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.6, 0.5, 0.2"/></bsdf>
<bsdf type="conductor" id="metal"><rgb name="eta" value="0.2, 0.9, 1.1"/><rgb name="k" value="3.9, 2.4, 2.2"/></bsdf>
<shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/>
  <translate y="-1"/></transform><ref id="floor"/></shape>
<shape type="sphere"><float name="radius" value="0.8"/><ref id="metal"/></shape>
<emitter type="constant" id="sky"><rgb name="radiance" value="1, 0.9, 0.8"/></emitter>
"""


@pytest.fixture(scope="module")
def room(make_scene):
    return make_scene(ROOM, res=16, depth=5, origin="0, 0.5, 3", fov=50)


NAMES = ["floor.reflectance", "metal.eta", "metal.k", "metal.specular_reflectance", "sky.radiance"]


@pytest.mark.parametrize("name", NAMES)
def test_right_derivatives_pass(room, name):
    result = pj.check_gradient(room, name, spp=16, seeds=8)
    assert result.passed and result.mean_square < 4
    assert result.z.shape == (2, 2, 3) and result.jacobian.shape == (16, 16, 3)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_values_at_a_bound_pass(room, value):
    assert pj.check_gradient(pj.with_parameters(room, {NAMES[0]: value}), NAMES[0], spp=16, seeds=8).passed


@pytest.mark.parametrize("name, error", [("floor.reflectance", 1.02), ("metal.eta", 1.02), ("sky.radiance", 1.001)])
def test_wrong_derivatives_do_not_pass(room, monkeypatch, name, error):
    def wrong(*arguments):
        image, J = pj.jacobian(*arguments)
        return image, replace(J, derivatives={k: d * error for k, d in J.items()})

    monkeypatch.setattr(check, "jacobian", wrong)
    assert not pj.check_gradient(room, name, spp=16, seeds=8).passed


@pytest.mark.slow
def test_smooth_ior_passes(shipped):
    """36 blocks: the mean of z^2, of 15 degrees of freedom, is 1.15, and known to 0.3."""
    result = pj.check_gradient(shipped("glass_ball", res=48), "glass.int_ior", spp=64)
    assert result.passed and result.mean_square < 1.15 + 4 * 0.3


def test_weights_differentiate_polynomials():
    nodes = np.array([-0.3, -0.1, 0.0, 0.2, 0.5])
    np.testing.assert_allclose(check._weights(nodes) @ (2 + 3 * nodes - nodes**4), 3, rtol=1e-9)


def test_bad_input_is_refused(room):
    with pytest.raises(pj.InputError, match="did you mean floor.reflectance"):
        pj.check_gradient(room, "flor.reflectance")
    with pytest.raises(pj.InputError, match="at least 3"):
        pj.check_gradient(room, "floor.reflectance", seeds=2)
