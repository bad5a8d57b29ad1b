"""`check_gradient` passes right derivatives and rejects wrong ones."""

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


# ---- scenes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["floor.reflectance", "metal.eta"])
def test_right_derivatives_pass(room, name):
    result = pj.check_gradient(room, name, spp=16, seeds=8)
    assert result.passed and result.mean_square < 4 and result.resolution < 0.01
    assert result.z.shape == (2, 2, 3) and result.derivative.shape == (16, 16, 3) and result.direction.shape == (3,)


@pytest.mark.parametrize("value", [0.0, 1.0, [0.0, 0.5, 1.0]])
def test_values_at_bounds_pass(room, value):
    result = pj.check_gradient(
        pj.with_parameters(room, {"floor.reflectance": value}), "floor.reflectance", spp=16, seeds=8
    )
    assert result.passed and result.resolution < 0.01


@pytest.mark.parametrize(("name", "error"), [("floor.reflectance", 1.02), ("metal.eta", 1.02)])
def test_wrong_derivatives_do_not_pass(room, monkeypatch, name, error):
    def wrong(*arguments):
        image, J = pj.jacobian(*arguments)
        return image, replace(J, derivatives={k: d * error for k, d in J.items()})

    monkeypatch.setattr(check, "jacobian", wrong)
    assert not pj.check_gradient(room, name, spp=16, seeds=8).passed


@pytest.mark.slow
def test_smooth_ior_passes(shipped):
    """36 blocks: the expected mean of z^2, with 15 degrees of freedom, is 1.15, with a standard error of 0.3."""
    result = pj.check_gradient(shipped("glass_ball", res=48), "glass.int_ior", spp=64)
    assert result.passed and result.mean_square < 1.15 + 4 * 0.3


@pytest.mark.slow  # its material has a kernel of its own
def test_black_passes_whose_hue_jumps(make_scene):
    """Near black, sheen and reflections take the hue of the color; at black they have no hue."""
    tints = '<float name="spec_tint" value="1"/><float name="sheen" value="0.5"/><float name="sheen_tint" value="1"/>'
    black = f'<bsdf type="principled" id="it"><rgb name="base_color" value="0"/>{tints}</bsdf>'
    scene = make_scene(f'<shape type="sphere">{black}</shape><emitter type="constant"/>', res=16)
    result = pj.check_gradient(scene, "it.base_color", spp=64, seeds=8)
    assert result.passed and result.kink


# ---- any function that renders --------------------------------------------------------------------------------------


class Renderer:
    """Images that are noisy polynomials of theta, and their derivatives along v with a relative error."""

    bounds = 0, 1

    def __init__(self, error=0.0, noise=0.1):
        self.error, self.noise = error, noise

    def coefficients(self, seed, count):
        return 1 + self.noise * np.random.default_rng(seed).normal(size=(24, 16, 2, count))

    def image(self, theta, seed):
        return self.coefficients(seed, np.size(theta)) @ np.ravel(theta + theta**3)

    def derivative(self, theta, v, seed):
        # Independent noise, like that of a renderer whose derivative uses other random numbers.
        return (1 + self.error) * self.coefficients(~seed & 0xFFFF, np.size(theta)) @ np.ravel((1 + 3 * theta**2) * v)

    def check(self, theta=0.4, **how):
        return pj.check_gradient(self.image, theta, derivative=self.derivative, bounds=self.bounds, **how)


@pytest.mark.parametrize("theta", [0.4, 0.0, 1.0, [0.2, 0.9], np.linspace(0, 1, 12).reshape(2, 2, 3)])
def test_functions_that_render_are_tested_at_any_values_within_the_bounds(theta):
    right, wrong = Renderer().check(np.asarray(theta)), Renderer(error=0.02).check(np.asarray(theta))
    assert right.passed and not wrong.passed
    assert right.direction.shape == np.shape(theta) and right.difference.shape == (24, 16, 2)


def test_false_alarms_are_as_frequent_as_stated():
    """With false_alarm = 0.05, 20 of 400 right derivatives should fail on average, and 6 to 38 with probability
    1 - 1e-3. Blocks are independent, so Sidak's rule is exact."""
    passed = [Renderer().check(seed=100 * k, seeds=8, false_alarm=0.05).passed for k in range(400)]
    assert 6 <= passed.count(False) <= 38


def test_the_stated_resolution_is_what_is_found_half_of_the_time():
    resolution = np.mean([Renderer().check(seed=100 * k).resolution for k in range(20)])
    wrong = Renderer(error=resolution)
    assert 10 <= [wrong.check(seed=100 * k).passed for k in range(100)].count(False) <= 98


def test_nothing_is_resolved_where_no_image_changes():
    black = pj.check_gradient(lambda theta, seed: np.zeros((8, 8, 3)), 1.0, derivative=lambda *of: np.zeros((8, 8, 3)))
    assert black.passed and black.resolution == np.inf


def test_what_is_not_finite_does_not_pass():
    for value in (np.nan, np.inf):
        broken = Renderer()
        broken.derivative = lambda theta, v, seed, value=value: np.full((24, 16, 2), value)
        assert not broken.check().passed and broken.check().p_value == 0


def test_a_moving_edge_is_seen_by_differences():
    """A sampled step whose edge moves with theta: its derivative is that of the area, not 0."""

    def image(theta, seed):
        x = (np.arange(64)[:, None, None] + np.random.default_rng(seed).uniform(size=(64, 8, 256))) / 64
        return (x < theta).mean(-1)[..., None] * np.ones(3)

    def without_edge(theta, v, seed):
        return np.zeros((64, 8, 3))

    assert not pj.check_gradient(image, 0.5, derivative=without_edge, reach=0.02).passed


KINKS = {
    # |theta - 0.4| has slope -1 to the left and 1 to the right; a value at 0 alone has no slope.
    "kink": (lambda theta: theta + abs(theta - 0.4), 0.4, (0, 2)),
    "jump": (lambda theta: theta + theta**2 + (theta == 0), 0.0, (1, 1)),
}


@pytest.mark.parametrize("case", KINKS)
def test_at_a_kink_the_slope_of_either_side_passes(case):
    of, theta, slopes = KINKS[case]
    noise = Renderer()

    def image(theta, seed):
        return noise.coefficients(seed, 1)[..., 0] * of(theta)

    def check(slope):
        def derivative(theta, v, seed):
            return noise.coefficients(seed, 1)[..., 0] * slope

        return pj.check_gradient(image, theta, derivative=derivative, bounds=(0, 1))

    assert all(check(slope).passed for slope in slopes)
    for slope in (min(slopes) - 0.1, 1.1, max(slopes) + 0.1):
        assert check(slope).kink and not check(slope).passed


def test_what_is_curved_is_no_kink():
    """A wrong derivative of a smooth image fails without being reported as a kink, even without noise."""
    for theta in (0.4, 0.0, 1.0):
        wrong = Renderer(error=0.02, noise=1e-6).check(theta)
        assert not wrong.passed and not wrong.kink


# ---- the rest -------------------------------------------------------------------------------------------------------


def test_weights_differentiate_polynomials():
    nodes = np.array([-0.3, -0.1, 0.0, 0.2, 0.5])
    np.testing.assert_allclose(check._weights(nodes) @ (2 + 3 * nodes - nodes**4), 3, rtol=1e-9)


def test_bad_input_is_refused(room):
    with pytest.raises(pj.InputError, match=r"did you mean floor\.reflectance"):
        pj.check_gradient(room, "flor.reflectance")
    with pytest.raises(pj.InputError, match="no parameter is named 0.5; the scene has"):
        pj.check_gradient(room, 0.5)
    with pytest.raises(pj.InputError, match="at least 3"):
        pj.check_gradient(room, "floor.reflectance", seeds=2)
    with pytest.raises(pj.InputError, match="between 0 and 1"):
        pj.check_gradient(room, "floor.reflectance", false_alarm=0)
    with pytest.raises(pj.InputError, match="a scene has its own"):
        pj.check_gradient(room, "floor.reflectance", derivative=lambda *of: 0)
    right = Renderer()
    with pytest.raises(pj.InputError, match="derivative is missing"):
        pj.check_gradient(right.image, 0.5)
    with pytest.raises(pj.InputError, match=r"lies outside the bounds \[0, 1\]"):
        right.check(1.5)
    for reach in (0, -1, np.nan):
        with pytest.raises(pj.InputError, match="reach = .*; it must be positive"):
            right.check(reach=reach)
    with pytest.raises(pj.InputError, match="block = 0; .* at least 1"):
        right.check(block=0)
    with pytest.raises(pj.InputError, match="theta holds no number"):
        right.check(np.zeros(0))
    with pytest.raises(pj.InputError, match="no room"):
        pj.check_gradient(right.image, 0.5, derivative=right.derivative, bounds=(0.5, 0.5))
    with pytest.raises(pj.InputError, match="three axes"):
        pj.check_gradient(lambda theta, seed: np.zeros(3), 0.5, derivative=right.derivative)
    with pytest.raises(pj.InputError, match=r"the derivative has the shape \(8, 8, 3\), the image \(24, 16, 2\)"):
        pj.check_gradient(right.image, 0.5, derivative=lambda *of: np.zeros((8, 8, 3)))
