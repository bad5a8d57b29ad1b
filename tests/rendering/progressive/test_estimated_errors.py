"""The error of an image: replicates and the estimates from them, on values whose truth is known."""

import numpy as np
import pytest
from scipy import ndimage

from pathjax.rendering.progressive import error_estimate, replicates

R = replicates.COUNT


def normal_image(rng, sigma, count=64):
    """Return an image of truth 1 and its variance, (H, W, 3) each, from samples of standard deviation `sigma`."""
    shape = np.broadcast_shapes(np.shape(sigma), (64, 64, 3))
    counts = np.full(shape[0] * shape[1], count, np.int32)
    spread = sigma / np.sqrt(replicates.shares(counts).reshape(R, *shape[:2], 1))
    means = (1 + spread * rng.normal(size=(R, *shape))).astype(np.float32).reshape(R, -1, 3)
    image, variance = replicates.moments(means, counts)
    return image.reshape(shape), variance.reshape(shape)


# ---- replicates -----------------------------------------------------------------------------------------------------


def test_replicates_have_seeds_of_their_own():
    seeds = [tuple(replicates.seeds(seed)) for seed in range(256)]
    assert len({s for row in seeds for s in row}) == R * 256


def test_samples_are_dealt_in_turn():
    count = np.arange(20, dtype=np.int32)
    expected = [[len(range(r, n, R)) for n in count] for r in range(R)]
    np.testing.assert_array_equal(replicates.shares(count), expected)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7, 64])
def test_mean_and_variance_of_unequal_replicates(count):
    """The mean weighs all samples equally, and the variance is unbiased: a z-test of 70,000 pixels (4 sigma)."""
    rng = np.random.default_rng(count)
    counts = np.full(70_000, count, np.int32)  # more than one block
    shares = replicates.shares(counts)[..., None]
    means = rng.normal(size=(R, len(counts), 3)) * 2 / np.sqrt(np.maximum(shares, 1))
    means = np.where(shares > 0, 1 + means, 0).astype(np.float32)
    image, variance = replicates.moments(means, counts)
    np.testing.assert_allclose(image, (means * shares).sum(0) / count, rtol=1e-4, atol=1e-6)
    standard_error = variance.std() / np.sqrt(variance.size)
    assert abs(variance.mean() - 4 / count) < 4 * standard_error


def test_one_sample_tells_no_variance():
    means = np.ones((R, 2, 3), np.float32)
    _, variance = replicates.moments(means, np.array([1, 4], np.int32))
    assert np.isnan(variance[0]).all() and not variance[1].any()


def test_a_pixel_without_samples_is_black():
    image, _ = replicates.moments(np.zeros((R, 1, 3), np.float32), np.zeros(1, np.int32))
    assert not image.any()


# ---- standard error of pixels ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [1.0, np.linspace(0.2, 3, 64)[:, None, None]])
def test_standard_errors_are_calibrated(sigma):
    """1/4 of a pixel's own variance plus 3/32 of each neighbour's has 22.6 degrees of freedom, so z has the variance
    22.6 / 20.6 = 1.10 (a little more at the border); 4 standard errors of the 12,288 z^2 are 0.06."""
    image, variance = normal_image(np.random.default_rng(0), sigma)
    z = (image - 1) / error_estimate.standard_error(image, variance, np.full((64, 64), 64))
    assert 1.03 < (z**2).mean() < 1.17


def test_pooling_is_a_weighted_mean_of_the_square_around():
    variance = np.random.default_rng(1).random((7, 9, 3)).astype(np.float32)
    weights = np.full((3, 3, 1), (1 - error_estimate.OWN_SHARE) / 8)
    weights[1, 1] = error_estimate.OWN_SHARE
    expected = ndimage.correlate(variance.astype(float), weights)
    pooled = error_estimate.standard_error(np.zeros_like(variance), variance, np.ones((7, 9))) ** 2
    np.testing.assert_allclose(pooled[1:-1, 1:-1], expected[1:-1, 1:-1], rtol=1e-5)


def test_pixels_that_are_not_finite_do_not_spread():
    image, variance = normal_image(np.random.default_rng(2), 1.0)
    image[10, 10], variance[10, 10] = np.nan, np.nan
    errors = error_estimate.standard_error(image, variance, np.full((64, 64), 64))
    assert np.isnan(errors[10, 10]).all() and np.isfinite(errors).mean() > 0.999
    assert np.isfinite(error_estimate.image_error(image, variance)).all()
    assert np.isfinite(error_estimate.sample_weights(image, variance)).all()


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 5, 3), (2, 2, 3)])
def test_images_smaller_than_the_neighbourhood(shape):
    variance = np.full(shape, 0.25, np.float32)
    image = np.ones(shape, np.float32)
    np.testing.assert_allclose(error_estimate.standard_error(image, variance, np.full(shape[:2], 64)), 0.5)
    np.testing.assert_allclose(error_estimate.sample_weights(image, variance), 1)


def test_agreement_of_few_samples_is_not_certainty():
    image = np.full((5, 5, 3), 6.0, np.float32)
    errors = error_estimate.standard_error(image, np.zeros_like(image), np.full((5, 5), 20))
    np.testing.assert_allclose(errors, 6 / 60)


# ---- error of the image ---------------------------------------------------------------------------------------------


def test_image_error_is_the_root_of_rel_mse():
    """For 12,288 normal values its relative standard error is sqrt(2/3 / 12288) / 2 = 0.4 %; five are allowed."""
    image, variance = normal_image(np.random.default_rng(3), 0.5)
    error = error_estimate.image_error(image, variance)
    assert error.estimate == pytest.approx(0.5 / 8 / np.sqrt(1.01), rel=0.02)
    assert error.estimate < error.bound < 1.05 * error.estimate


def test_few_pixels_that_rule_the_error_make_it_unsure():
    image = np.ones((64, 64, 3), np.float32)
    variance = np.full_like(image, 1e-6)
    sure = error_estimate.image_error(image, variance)
    variance[3, 5] = 0.5
    unsure = error_estimate.image_error(image, variance)
    assert sure.bound < 1.02 * sure.estimate
    assert unsure.bound > 1.5 * unsure.estimate


def test_bound_is_exceeded_in_few_renders():
    """In 5 % of 400 images of lognormal samples of skewness 6, by design; 36 are beyond chance (1e-4, binomial)."""
    rng = np.random.default_rng(4)
    s, scale, count = 1.0, 0.02, np.full(256, 16, np.int32)
    truth = scale * np.sqrt(np.expm1(s**2) / 16 / 1.01)
    exceeded = 0
    for _ in range(400):
        samples = 1 + scale * np.expm1(s * rng.normal(size=(R, 4, 256, 3)) - s**2 / 2)
        means = samples.mean(1).astype(np.float32)
        bound = error_estimate.image_error(*replicates.moments(means, count)).bound
        exceeded += bound < truth
    assert 0 < exceeded < 36


def test_nothing_known_is_nan():
    assert np.isnan(error_estimate.image_error(np.full((2, 2, 3), np.nan), np.full((2, 2, 3), np.nan))).all()


def test_without_noise_the_error_is_0():
    assert error_estimate.image_error(np.ones((4, 4, 3)), np.zeros((4, 4, 3))) == (0, 0)


def test_a_black_image_has_no_error():
    """There is no level for it to be relative to."""
    black = np.zeros((4, 4, 3), np.float32)
    assert np.isnan(error_estimate.image_error(black, black)).all()
    assert (error_estimate.sample_weights(black, black) == 1).all()


def test_one_pixel_has_its_relative_error():
    pixel = np.full((1, 1, 3), 3.0, np.float32)
    assert error_estimate.image_error(pixel, 0.09 * pixel).estimate == pytest.approx(0.3 / np.sqrt(3 * (1.01 - 0.03)))


def test_a_lamp_in_view_does_not_hide_the_noise_of_the_room():
    """The lamp is a tenth of the pixels and 10^6 times brighter; the others keep their error."""
    image, variance = normal_image(np.random.default_rng(8), 0.5)
    room = error_estimate.image_error(image, variance).estimate
    lamp = np.arange(64) < 6
    image[lamp], variance[lamp] = 1e6, 0
    assert error_estimate.image_error(image, variance).estimate == pytest.approx(room * np.sqrt(58 / 64), rel=0.05)


# ---- where samples go -----------------------------------------------------------------------------------------------


def test_weights_never_look_at_the_pixel_itself():
    image, variance = normal_image(np.random.default_rng(5), 1.0)
    before = error_estimate.sample_weights(image, variance)
    image[20, 30], variance[20, 30] = 7, 100
    after = error_estimate.sample_weights(image, variance)
    assert after[20, 30] / after[50, 50] == pytest.approx(before[20, 30] / before[50, 50], rel=1e-5)
    assert after[20, 31] > 2 * before[20, 31]


def test_weights_follow_the_relative_standard_deviation():
    sigma = np.where(np.arange(64) < 32, 1.0, 2.0)[:, None, None]
    weights = error_estimate.sample_weights(*normal_image(np.random.default_rng(6), sigma * 0.1))
    assert weights.mean() == pytest.approx(1, abs=1e-6)
    assert weights[40:].mean() / weights[:24].mean() == pytest.approx(2, rel=0.05)


def test_weights_have_a_floor():
    sigma = np.where(np.arange(64) < 32, 0.0, 1.0)[:, None, None]
    weights = error_estimate.sample_weights(*normal_image(np.random.default_rng(7), sigma))
    assert weights.min() > 0.2


def test_weights_without_noise_are_even():
    assert (error_estimate.sample_weights(np.ones((5, 5, 3)), np.zeros((5, 5, 3))) == 1).all()


# ---- the unit of radiance -------------------------------------------------------------------------------------------


def everything(means, counts):
    """Return the estimates from replicates (R, 64 * 64, 3): those in units of radiance, and those without a unit."""
    image, variance = replicates.moments(means, counts)
    image, variance = image.reshape(64, 64, 3), variance.reshape(64, 64, 3)
    errors = error_estimate.standard_error(image, variance, counts.reshape(64, 64))
    found = error_estimate.image_error(image, variance), error_estimate.sample_weights(image, variance)
    return (image, errors), found


@pytest.mark.parametrize("power", [-90, -66, -40, -4, 4, 40, 66, 110])
def test_a_power_of_two_scales_every_bit_of_an_estimate(power):
    """2^-66 is 1.4e-20, and 2^66 7e19."""
    rng = np.random.default_rng(9)
    counts = rng.integers(2, 40, 64 * 64).astype(np.int32)
    means = rng.lognormal(-1, 2, (R, 64 * 64, 3)).astype(np.float32)
    of_radiance, without = everything(means, counts)
    scaled_radiance, still_without = everything(np.ldexp(means, power), counts)
    for here, there in zip(of_radiance, scaled_radiance, strict=True):
        assert here.dtype == there.dtype == np.float32
        np.testing.assert_array_equal(np.ldexp(here, power), there)
    assert without[0] == still_without[0]
    np.testing.assert_array_equal(without[1], still_without[1])


@pytest.mark.parametrize("power", [-110, -130])
def test_an_image_too_dark_for_float32_has_no_error(power):
    image, variance = normal_image(np.random.default_rng(10), 0.5)
    assert np.isnan(error_estimate.image_error(np.ldexp(image, power), np.ldexp(variance, 2 * power))).all()
