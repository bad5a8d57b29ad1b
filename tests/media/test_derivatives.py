"""Derivatives in media against differences, and those of surfaces in scenes with media."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import pathjax as pj
from pathjax.derivatives import matrix_free
from pathjax.derivatives.jacobian import pixel_jacobians
from pathjax.integrators.options import DEFAULTS
from pathjax.scene.parameters import find, nameless
from pathjax.sensors import film

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "name", ["fog.sigma_t", "fog.scale", "inner_interior.albedo", "jelly_interior.sigma_t", "forwards.g"]
)
def test_derivatives_of_media_are_those_of_differences(shipped, name):
    """Of images with common random numbers; with the false-alarm rate of the check, 1e-3."""
    assert pj.check_gradient(shipped("media", res=16), name, spp=64).passed


def test_a_sweep_adds_up_what_the_jacobian_holds(shipped):
    """Of surfaces and lights in a scene with media, where paths meet particles between them."""
    scene = shipped("media", res=16)
    wanted = {name: find(scene, name) for name in pj.parameters(scene)}
    wanted = {name: parameter for name, parameter in wanted.items() if matrix_free.is_swept(scene, parameter)}
    assert "floor.reflectance" in wanted and "lamp.radiance" in wanted
    pixels = film.pixels(scene.film)
    v = np.random.default_rng(1).normal(size=(len(pixels), 3)).astype(np.float32)
    work = pixels, 0, 16, 1
    swept = matrix_free.pull(nameless(scene), wanted, jax.numpy.asarray(v), *work, DEFAULTS)
    _, J, *_ = pixel_jacobians(nameless(scene), wanted, *work, DEFAULTS)
    for name in wanted:
        expected = np.einsum("nc,nc...->...", v, np.asarray(J[name], float))
        size = np.einsum("nc,nc...->...", np.abs(v), np.abs(np.asarray(J[name], float)))
        assert (np.abs(swept[name] - expected) < 1e-4 * size.max()).all(), name


def test_both_branches_of_glass_may_be_followed_in_media(shipped, estimate, agree):
    scene = shipped("media", res=16)
    agree(estimate(scene, spp=64), estimate(scene, spp=64, first_seed=101, split_depth=1))
