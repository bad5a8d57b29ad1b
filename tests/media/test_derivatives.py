"""Derivatives in parameters of surfaces in scenes with media, and fits of media."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import pathjax as pj
from pathjax.derivatives import jacobian, matrix_free
from pathjax.derivatives.jacobian import pixel_jacobians
from pathjax.integrators.options import DEFAULTS
from pathjax.scene.parameters import find, nameless
from pathjax.sensors import film

pytestmark = pytest.mark.slow


def test_a_sweep_adds_up_what_the_jacobian_holds(shipped, monkeypatch):
    """For surfaces and lights in a scene with media, in which paths scatter between them."""
    scene = shipped("media", res=16)
    wanted = {name: find(scene, name) for name in pj.parameters(scene)}
    wanted = {name: parameter for name, parameter in wanted.items() if matrix_free.is_swept(scene, parameter)}
    assert "floor.reflectance" in wanted and "lamp.radiance" in wanted
    pixels = film.pixels(scene.film)
    v = np.random.default_rng(1).normal(size=(len(pixels), 3)).astype(np.float32)
    work = pixels, 0, 16, 1
    swept = matrix_free.pull(nameless(scene), wanted, jax.numpy.asarray(v), *work, DEFAULTS)
    _, by_rows, *_ = pixel_jacobians(nameless(scene), wanted, *work, DEFAULTS)
    monkeypatch.setattr(jacobian, "takes_sweep", lambda *_, **__: False)
    _, J, *_ = pixel_jacobians(nameless(scene), wanted, *work, DEFAULTS)
    for name in wanted:
        np.testing.assert_allclose(by_rows[name], J[name], rtol=1e-4, atol=1e-5 * np.abs(J[name]).max())
        expected = np.einsum("nc,nc...->...", v, np.asarray(J[name], float))
        size = np.einsum("nc,nc...->...", np.abs(v), np.abs(np.asarray(J[name], float)))
        assert (np.abs(swept[name] - expected) < 1e-4 * size.max()).all(), name


def test_both_branches_of_glass_may_be_followed_in_media(shipped, estimate, agree):
    scene = shipped("media", res=16)
    agree(estimate(scene, spp=64), estimate(scene, spp=64, first_seed=101, split_depth=1))


def test_an_extinction_is_recovered_from_an_image(make_scene):
    """For a ball that only absorbs, within 4 standard errors (a false alarm in 5,000, over three channels)."""
    text = """<shape type="sphere"><bsdf type="null"/><medium type="homogeneous" name="interior" id="ink">
      <rgb name="sigma_t" value="{}"/><float name="albedo" value="0"/></medium></shape><emitter type="constant"/>"""
    wanted = np.array([0.4, 0.7, 1.0])
    truth, start = (make_scene(text.format(x), res=12, integrator="volpath") for x in ("0.4, 0.7, 1", "0.5, 0.5, 0.5"))
    fitted = pj.fit(start, np.asarray(pj.render(truth, 1024, seed=9)), ["ink.sigma_t"], seed=1)
    error = np.abs(fitted.values["ink.sigma_t"] - wanted)
    assert (error < 4 * fitted.standard_errors["ink.sigma_t"]).all() and (error < 0.02).all()
