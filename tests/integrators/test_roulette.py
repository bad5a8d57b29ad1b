"""Survival probabilities of paths."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.integrators import roulette


@pytest.mark.parametrize(
    "throughput, passive, expected", [(0.1, None, 0.3), (0.2, 2.0, 0.3), (1, None, 0.95), (0, 1, 0.05)]
)
def test_paths_go_on_in_proportion_to_the_light_that_is_left(throughput, passive, expected):
    """It is bounded, so that every path ends but never with certainty; scaling by refraction is divided out."""
    color = jnp.array([throughput / 2, throughput, 0.0])
    passive = None if passive is None else jnp.float32(passive)
    scene = SimpleNamespace(rr_depth=3)
    np.testing.assert_allclose(roulette.survival(scene, jnp.int32(3), color, passive), expected, rtol=1e-6)
    assert roulette.survival(scene, jnp.int32(2), color, passive) == 1
