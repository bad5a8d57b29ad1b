"""Random numbers of a vertex: a bsdf with lobes draws one more, which does not change the others."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.bsdfs.diffuse import Diffuse
from pathjax.core import sampler
from pathjax.integrators.random_numbers import bounce_numbers


def test_a_bsdf_with_lobes_draws_a_third_number_and_changes_no_other(shipped, monkeypatch):
    scene = shipped("furnace", res=4)
    depths, samples = (x.ravel().astype(jnp.int32) for x in jnp.meshgrid(jnp.arange(32), jnp.arange(256)))

    def draw():
        stream = sampler.pixel_stream(jnp.uint32(1), jnp.int32(5))
        return jax.vmap(lambda depth, sample: bounce_numbers(scene, stream, sample, depth))(depths, samples)

    without = draw()
    monkeypatch.setattr(Diffuse, "lobes", True)
    with_lobes = draw()
    assert without.bsdf.shape == (len(depths), 2) and with_lobes.bsdf.shape == (len(depths), 3)
    for a, b in zip(without, with_lobes._replace(bsdf=with_lobes.bsdf[:, :2]), strict=True):
        np.testing.assert_array_equal(a, b)
    # It is uniform and independent of the others: 8192 samples, 4.5 standard errors for each test (false alarm 1e-5).
    lobe = np.asarray(with_lobes.bsdf[:, 2], float)
    error = 4.5 / np.sqrt(len(lobe))
    assert abs(lobe.mean() - 0.5) < error / np.sqrt(12)
    for other in (*np.asarray(without.bsdf).T, without.triangle, without.roulette, np.roll(lobe, 32)):
        assert abs(np.corrcoef(lobe, np.asarray(other, float))[0, 1]) < error
