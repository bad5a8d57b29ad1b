"""Fixtures shared by the tests of media."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax import media
from pathjax.kinds import Parameters


@pytest.fixture
def average_to_1():
    """(medium, ray, throughput, count, rounding) -> weights of flights, whose mean it asserts to be 1."""

    def check(medium, ray, throughput, count, rounding):
        scattering = media.Homogeneous.scattering(medium, media.Isotropic.instance())
        made = media.build([], scattering, np.float32, (), Parameters())
        u = jnp.asarray(np.random.default_rng(1).random((count, 2)), jnp.float32)

        def weight(u):
            t, surface = media.distance(made, jnp.int32(0), ray, throughput, u), 0.7
            return media.flight_weight(made, jnp.int32(0), ray, throughput, jnp.minimum(t, surface), t < surface)

        weights = np.asarray(jax.jit(jax.vmap(weight))(u), float)
        error = weights.std(0) / np.sqrt(len(u))
        assert (np.abs(weights.mean(0) - 1) < 4 * error + rounding).all()
        return weights

    return check
