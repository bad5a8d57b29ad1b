"""Errors, slopes and efficiencies against closed forms."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.bench import figures
from pathjax.images.metrics import RELATIVE_FLOOR


def rows(spps, seconds, errors):
    return [figures.row(n, n, [s], [e], 0.0, 64) for n, s, e in zip(spps, seconds, errors, strict=True)]


def test_slopes_of_power_laws():
    spps = [4, 16, 64]
    found = figures.slopes(rows(spps, [0.1 * n**0.5 for n in spps], [3 * n**-1.5 for n in spps]))
    assert found["spp"] == pytest.approx(-0.75)
    assert found["seconds"] == pytest.approx(-1.5)


def test_no_slope_of_one_point_or_without_noise():
    assert figures.slopes(rows([4], [1], [0.1])) == {"spp": None, "seconds": None}
    assert figures.slopes(rows([4, 16], [1, 2], [0, 0])) == {"spp": None, "seconds": None}
    assert figures.slope([2, 2], [1, 3]) is None


def test_the_error_of_the_reference_is_known_and_subtracted():
    rng = np.random.default_rng(1)
    truth, size = 0.5, (64, 64, 3)
    reference = figures.reference_of((truth + 0.05 * rng.standard_normal(size) for _ in range(16)), spp_each=8)
    assert reference.spp == 128
    assert reference.noise == pytest.approx(0.05**2 / 16 / (truth**2 + RELATIVE_FLOOR), rel=0.05)
    errors = reference.errors(truth + 0.1 * rng.standard_normal(size) for _ in range(4))
    row = figures.row(4, 4, [1, 2, 9], errors, reference.noise, 4096)
    assert row["rel_mse"] == pytest.approx(0.1**2 / (truth**2 + RELATIVE_FLOOR), rel=0.03)
    assert row["rel_mse_to_reference"] == pytest.approx(row["rel_mse"] + reference.noise)
    assert row["efficiency"] == pytest.approx(1 / (row["rel_mse"] * 2))
    assert not row["reference_too_noisy"]
    assert figures.row(4, 4, [1], [1.5 * reference.noise], reference.noise, 4096)["reference_too_noisy"]


def test_moments_of_renders_have_the_digits_of_float64():
    """Images that differ by up to two float32 ulps, as of a scene with little noise."""
    images = [jnp.full((2, 2, 3), 1 + k * 2**-23, jnp.float32) for k in (0, 1, 2)]
    mean, variance, count = figures.moments(images)
    assert mean.dtype == variance.dtype == np.float64 and count == 3
    np.testing.assert_allclose(variance, 2.0**-46 / 3, rtol=1e-6)
    assert figures.deviation(images[1], np.ones((2, 2, 3)))["largest_deviation"] == pytest.approx(2**-23 / 1.01**0.5)


def test_what_is_not_known_is_told_as_such():
    lost = figures.row(4, 4, [1.0], [math.nan], 0.0, 64)
    assert math.isnan(lost["rel_mse"]) and lost["efficiency"] is None
    assert math.isnan(lost["rel_mse_standard_error"])
    hidden = figures.row(4, 4, [1.0], [1e-3], 2e-3, 64)
    assert hidden["rel_mse"] == pytest.approx(-1e-3) and hidden["efficiency"] is None
    assert figures.row(4, 4, [1.0], [1e-13], 0.0, 64)["efficiency"] is None  # rounding


def test_the_best_is_the_most_efficient_of_its_spp():
    found = [*rows([4, 4], [1, 2], [0.1, 0.01]), *rows([16], [1], [1e-6]), *rows([4], [1], [0])]
    assert figures.best(found, 4) is found[1]
    assert figures.best(found, 64) is None


def test_deviation():
    found = figures.deviation(np.float32([[[1, 2, 3]]]), [[[1, 2, 4]]])
    assert found["rel_mse"] == pytest.approx(1 / (16 + RELATIVE_FLOOR) / 3)
    assert found["largest_deviation"] == pytest.approx(1 / math.sqrt(16 + RELATIVE_FLOOR))


def test_bias_is_what_noise_does_not_explain():
    rng = np.random.default_rng(2)
    truth, size = 0.5, (64, 64, 3)
    reference = figures.reference_of((truth + 0.1 * rng.standard_normal(size) for _ in range(64)), spp_each=1)
    scale = truth**2 + RELATIVE_FLOOR
    for offset in (0, 0.02):
        bias = reference.bias([truth + offset + 0.1 * rng.standard_normal(size) for _ in range(8)])
        assert abs(bias["rel_mse"] - offset**2 / scale) < 4 * bias["standard_error"] < 1e-3
    assert all(map(math.isnan, reference.bias([np.full(size, truth)]).values()))
