"""Samples of a pixel are distributed by its filter, with weights of mean 1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pathjax.sensors import film
from pathjax.sensors.filters import Box, CatmullRom, Gaussian, Lanczos, Mitchell, Tent

# Probability that a correct filter fails one test; seeds are fixed.
FALSE_ALARM = 1e-4
N = 400_000


def built(filter, border=True):
    return film.HDRFilm(8, 6, (2, 1, 4, 3), filter, border).build(jnp.float32)


def sampled(made, pixel, u):
    """Return offsets in pixels from the centre of the pixel on the film, and weights, float64."""
    positions, weights = jax.jit(jax.vmap(lambda u: film.sample_position(made, jnp.int32(pixel), u)))(u)
    center = np.array([2 + pixel % 4, 1 + pixel // 4]) + 0.5
    return np.asarray(positions, np.float64) * [8, 6] - center, np.asarray(weights, np.float64)


def uniform(n=N, seed=1):
    return jnp.asarray(np.random.default_rng(seed).integers(0, 1 << 24, (n, 2)) * 2.0**-24, jnp.float32)


def cubic(B, C):
    """Mitchell and Netravali 1988, equation 8."""

    def height(x):
        x = np.abs(x)
        near = (12 - 9 * B - 6 * C) * x**3 + (-18 + 12 * B + 6 * C) * x**2 + 6 - 2 * B
        far = (-B - 6 * C) * x**3 + (6 * B + 30 * C) * x**2 + (-12 * B - 48 * C) * x + 8 * B + 24 * C
        return np.where(x < 1, near, far) / 6

    return height


FILTERS = {
    "box": (Box(), 0.5, lambda x: np.ones_like(x)),
    "wide box": (Box(1.5), 1.5, lambda x: np.ones_like(x)),
    "tent": (Tent(), 1.0, lambda x: 1 - np.abs(x)),
    "wide tent": (Tent(2.0), 2.0, lambda x: 1 - np.abs(x) / 2),
    "gaussian": (Gaussian(), 2.0, lambda x: np.exp(-2 * x**2) - np.exp(-8)),
    "wide gaussian": (Gaussian(1.0, 3.0), 3.0, lambda x: np.exp(-(x**2) / 2) - np.exp(-4.5)),
    "mitchell": (Mitchell(), 2.0, cubic(1 / 3, 1 / 3)),
    "another mitchell": (Mitchell(0.1, 0.6), 2.0, cubic(0.1, 0.6)),
    "catmullrom": (CatmullRom(), 2.0, cubic(0, 0.5)),
    "lanczos": (Lanczos(), 3.0, lambda x: np.sinc(x) * np.sinc(x / 3)),
}
# Filters with negative lobes, where weights are negative too.
RINGING = ("mitchell", "another mitchell", "catmullrom", "lanczos")


@pytest.mark.parametrize("name", FILTERS)
def test_weighted_samples_have_the_filter_for_their_density(name):
    filter, radius, shape = FILTERS[name]
    offsets, weights = sampled(built(filter), 5, uniform())
    assert np.abs(offsets).max() <= radius * (1 + 1e-5)
    # Mean weight 1, and each cell of x and y gets its share of the filter, by weight.
    assert abs(weights.mean() - 1) < 5 * max(weights.std() / np.sqrt(N), 1e-6)
    edges = np.linspace(-radius, radius, 13)
    fine = (np.arange(200) + 0.5) / 200
    share = np.array([shape(a + fine * (b - a)).mean() for a, b in zip(edges[:-1], edges[1:], strict=True)])
    share = np.outer(share, share) / share.sum() ** 2
    # Samples may pass the rim by an ulp.
    inside = np.clip(offsets, -radius * (1 - 1e-9), radius * (1 - 1e-9))
    total, squares = (np.histogram2d(*inside.T, [edges, edges], weights=w)[0] for w in (weights, weights**2))
    full = np.abs(share) * N > 20  # the corners of a Gaussian hold next to nothing
    error = np.sqrt(np.maximum(squares - total**2 / N, 1))
    z = ((total - share * N) / error)[full]
    p = 2 * stats.norm.sf(np.abs(z).max())
    assert -np.expm1(z.size * np.log1p(-p)) > FALSE_ALARM
    assert stats.chi2.sf((z**2).sum(), z.size) > FALSE_ALARM


@pytest.mark.parametrize("name", ["gaussian", "wide gaussian", *RINGING])
def test_heights_are_those_of_the_filter(name):
    filter, radius, shape = FILTERS[name]
    x = np.linspace(-radius * 1.2, radius * 1.2, 97)
    heights = np.asarray(filter.build(np.float32).evaluate(jnp.asarray(x, jnp.float32)))
    expected = np.where(np.abs(x) <= radius, shape(x), 0)
    np.testing.assert_allclose(heights / heights[48], expected / expected[48], atol=1e-5)


@pytest.mark.parametrize("name", RINGING)
def test_weights_are_one_but_for_the_sign_and_its_share(name):
    """Samples are drawn by |f|, so all weights have one size: the squared ratio of the integrals of |f| and f."""
    filter, radius, shape = FILTERS[name]
    x = np.linspace(-radius, radius, 100_001)
    size = (np.trapezoid(np.abs(shape(x)), x) / np.trapezoid(shape(x), x)) ** 2
    weights = sampled(built(filter), 0, uniform(50_000))[1]
    assert weights.min() < 0
    # Where f changes sign, one step of the table contains all heights from 0 up.
    assert np.quantile(np.abs(np.abs(weights) - size), 0.95) < 0.05 * size and np.abs(weights).max() < 5 * size


@pytest.mark.parametrize("name", [name for name in FILTERS if name not in RINGING])
def test_weights_vary_little(name):
    """Importance sampling: only the tails of a Gaussian leave a weight other than 1, most in the last of 1024 steps."""
    weights = sampled(built(FILTERS[name][0]), 0, uniform(50_000))[1]
    assert weights.min() >= 0 and weights.max() < 5 and weights.std() < (0.15 if "gaussian" in name else 1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_without_a_border_weights_of_mean_1_are_0_outside_of_the_crop_window(name):
    """Pixel 0 is the upper left corner of the window."""
    offsets, weights = sampled(built(FILTERS[name][0], border=False), 0, uniform(100_000))
    assert abs(weights.mean() - 1) < 5 * max(weights.std() / np.sqrt(len(weights)), 1e-6)
    outside = (offsets < -0.5 - 1e-5).any(1)
    assert (weights[outside] == 0).all() and (outside.any() == (name != "box"))


def test_box_samples_of_a_pixel_stay_in_it():
    made = built(Box())
    for pixel in (0, 3, 4, 11):
        offsets, weights = sampled(made, pixel, uniform(10_000))
        assert np.abs(offsets).max() <= 0.5 + 1e-5 and (weights == 1).all()


@pytest.mark.parametrize("name", FILTERS)
def test_samples_are_finite_at_the_ends_of_the_interval(name):
    ends = [0, 0.5, 1 - 2**-24]
    offsets, weights = sampled(
        built(FILTERS[name][0]), 1, jnp.array([[a, b] for a in ends for b in ends], jnp.float32)
    )
    assert np.isfinite(offsets).all() and np.isfinite(weights).all()


def test_pixels_count_rows_of_the_crop_window():
    made = built(Box())
    assert film.pixel_count(made) == 12 and film.image_shape(made) == (3, 4)
    middle = jax.vmap(lambda p: film.sample_position(made, p, jnp.array([0.5, 0.5]))[0])(jnp.arange(12))
    np.testing.assert_allclose(
        middle * jnp.array([8, 6]), [[2.5 + x, 1.5 + y] for y in range(3) for x in range(4)], rtol=1e-6
    )


@pytest.mark.parametrize("name", ["tent", "gaussian", *RINGING])
def test_filters_are_those_of_mitsuba(name):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    theirs = mi.load_dict({"type": "mitchell", "B": 0.1, "C": 0.6} if name == "another mitchell" else {"type": name})
    filter, radius, shape = FILTERS[name]
    assert theirs.radius() == pytest.approx(radius)
    x = np.linspace(-radius, radius, 41)
    values = np.array([theirs.eval(float(v)) for v in x])
    # Filters may differ by a constant factor: both programs divide by their sum. Mitsuba's Gaussian is a polynomial
    # fit, off by 5e-4.
    np.testing.assert_allclose(values / values[20], shape(x) / shape(0 * x)[0], atol=1e-3)
