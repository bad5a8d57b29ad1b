"""Uniform numbers of a path: a lattice for each pixel and seed, independent of all others, and hashes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pathjax.core import sampler

VERTICES = 16
DIMENSIONS = VERTICES * sampler.DIMENSIONS
# Chance that a correct sampler fails a statistical test of this file: 1e-4 over each test's comparisons (Sidak).
FALSE_ALARM = 1e-4


def sidak(p_values):
    """Return the p-value of the smallest p of independent tests."""
    p = np.min(p_values)
    return -np.expm1(np.size(p_values) * np.log1p(-p))


@jax.jit
def _lattice(seeds, pixels, samples):
    def one(seed, pixel):
        stream = sampler.pixel_stream(seed, pixel)
        vertices = jnp.arange(VERTICES)
        return jax.vmap(lambda i: jax.vmap(lambda k: sampler.lattice_point(stream, i, k))(vertices))(samples)

    return jax.vmap(one)(seeds, pixels)


def lattice(seeds, pixels, samples):
    """Return points (K, N, DIMENSIONS) of K streams and N samples."""
    points = _lattice(*(np.asarray(x, np.uint32) for x in (seeds, pixels, samples)))
    return np.asarray(points, np.float64).reshape(len(pixels), len(samples), DIMENSIONS)


@jax.jit
def _hashed(stream, samples, first):
    return jax.vmap(lambda i: sampler.hashed(sampler.path_key(stream, i), first, 8))(samples)


def hashed(stream, samples, first=0):
    return np.asarray(_hashed(np.uint32(stream), np.asarray(samples, np.uint32), np.uint32(first)), np.float64)


def assert_stratified(points):
    """Assert that in every dimension each interval of length 1/N holds one of the N points (..., N, D)."""
    count = points.shape[-2]
    cells = np.sort((points * count).astype(int), axis=-2)
    np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(count)[:, None], cells.shape))


@pytest.mark.parametrize("count", [16, 64, 256])
def test_each_dimension_is_stratified_for_every_stream(count):
    assert_stratified(lattice(np.arange(20), 7 * np.arange(20), np.arange(count)))


@pytest.mark.parametrize("name", ["independent", "subpixel"])
def test_points_of_classic_path_tracers_are_uniform_and_independent(name):
    """Of the next dimension, and, except on the film, of the same dimension four samples later."""
    n = 1 << 16

    def one(sample):
        return jax.vmap(lambda vertex: sampler.POINTS[name](jnp.uint32(7), sample, vertex))(jnp.arange(4))

    u = np.asarray(jax.jit(jax.vmap(one))(jnp.arange(n, dtype=jnp.uint32)), np.float64).reshape(n, 16)
    assert 0 < u.min() and u.max() < 1
    pairs = [(u[:, i], u[:, i + 1]) for i in range(15)] + [(u[4:, i], u[:-4, i]) for i in range(2, 16)]
    p = []
    for a, b in pairs:
        counts = np.histogram2d(a, b, 16, [[0, 1], [0, 1]])[0]
        # Strata make counts more even than chance does.
        p.append(stats.chi2.sf(((counts - len(a) / 256) ** 2).sum() * 256 / len(a), 255))
    assert sidak(p) > FALSE_ALARM


def test_four_subpixel_points_in_a_row_lie_in_the_four_quarters_of_the_pixel():
    stream = sampler.pixel_stream(1, 2)
    for first in (0, 6, (1 << 32) - 2):
        samples = (first + np.arange(4)) % (1 << 32)
        film = [np.asarray(sampler.subpixel_point(stream, np.uint32(i), 0))[:2] for i in samples]
        assert {tuple(q) for q in (np.array(film) // 0.5).tolist()} == {(0, 0), (1, 0), (0, 1), (1, 1)}


@pytest.mark.parametrize("first", [256, 5 * 256, 1 << 24, (1 << 32) - 256])
def test_each_aligned_block_of_samples_is_stratified(first):
    assert_stratified(lattice(np.arange(8), np.arange(8), first + np.arange(256, dtype=np.int64)))


@pytest.mark.parametrize("count", [64, 256, 1024])
def test_points_are_a_lattice_under_a_shift(count):
    """Sums and differences of points are points, up to the shift and the truncation to 24 bits."""
    points = lattice([3], [5], np.arange(count))[0] * 2**24
    moved = (points - points[0]) % 2**24
    steps = np.rint(moved * count / 2**24)
    assert np.abs(moved * count / 2**24 - steps).max() < 2 * count / 2**24
    first = {tuple(row) for row in (steps % count).astype(int)}
    assert len(first) == count
    again = {tuple(row) for row in ((steps + steps[count // 3]) % count).astype(int)}
    assert again == first


def pairs_in_terms():
    """Yield the pairs of dimensions that the estimator multiplies: a term depends on the film, the bsdf samples of the
    vertices before, and one light sample or one more bsdf sample."""
    vertex, column = np.divmod(np.arange(DIMENSIONS), sampler.DIMENSIONS)
    is_light = (vertex > 0) & (column < 2)
    for i, j in zip(*np.triu_indices(DIMENSIONS, 1), strict=True):
        same = vertex[i] == vertex[j] and is_light[i] == is_light[j]
        if same or vertex[i] < vertex[j] and not is_light[i]:
            yield i, j


def test_pairs_of_dimensions_are_stratified_jointly():
    """The variance of x y (centred) over shifts, against that of independent numbers, in all pairs of a term.

    With few points, some pairs are worse than independent ones, since there are fewer rules than pairs; most are not.
    """

    def ratios(count):
        x = lattice(np.arange(32), np.arange(32), np.arange(count)) - 0.5
        squares = [np.mean(np.mean(x[..., a] * x[..., b], 1) ** 2) for a, b in pairs_in_terms()]
        return np.array(squares) * 144 * count

    assert np.median(ratios(64)) < 0.5
    assert np.mean(ratios(1024)) < 0.5


def error_of_terms(generators, count):
    """Return the sum of the squared shift-averaged errors of the terms up to vertex 6, with weights 1/2 per vertex.

    This is for functions whose Fourier coefficients fall like 1 / h, as across edges (Dick, Kuo and Sloan 2013).
    """
    x = np.arange(count)[:, None, None] * generators % count / count
    factors = 6 * (x * x - x + 1 / 6)
    chain, error = np.prod(1 + factors[:, 0, :2], -1), 0.0
    for vertex in range(1, 7):
        weight = 0.5**vertex
        for own in (slice(0, 2), slice(2, 4)):
            term = chain * np.prod(1 + weight * factors[:, vertex, own], -1)
            error += weight * (term.mean() - 1)
        chain = chain * np.prod(1 + weight * factors[:, vertex, 2:], -1)
    return error


@pytest.mark.parametrize("count", [64, 256, 1024, 4096, 1 << 14])
def test_generators_serve_the_terms_of_the_estimator(count):
    """With other weights than they were chosen by, they beat nine in ten random generators. (16 points have only four
    rules, up to signs, so random generators find the best rule too.)
    """
    rng = np.random.default_rng(count)
    others = [error_of_terms(2 * rng.integers(0, 1 << 19, sampler._GENERATORS.shape) + 1, count) for _ in range(100)]
    assert error_of_terms(sampler._GENERATORS.astype(int), count) < np.quantile(others, 0.1)


def test_numbers_lie_below_one_and_are_multiples_of_2_to_the_minus_24():
    x = np.concatenate([lattice([0, 1], [3, 4], np.arange(10_000)).ravel(), hashed(5, np.arange(50_000)).ravel()])
    assert x.min() >= 0 and x.max() < 1
    assert (x * 2**24 == np.floor(x * 2**24)).all()
    assert float(sampler.to_unit(jnp.uint32(0xFFFFFFFF))) == 1 - 2**-24


def correlation_p(a, b):
    """Return p of no correlation, for K independent pairs of N independent numbers: z = r sqrt(N)."""
    z = np.mean((a - a.mean(-1, keepdims=True)) * (b - b.mean(-1, keepdims=True)), -1) * np.sqrt(a.shape[-1])
    return 2 * stats.norm.sf(np.abs(z) / (a.std(-1) * b.std(-1)))


def test_dimensions_are_uncorrelated():
    # One sample of each of many pixels: independent points, unlike the samples of one pixel.
    x = lattice(np.zeros(20_000), np.arange(20_000), [3])[:, 0].T
    i, j = np.triu_indices(DIMENSIONS, 1)
    assert sidak(correlation_p(x[i], x[j])) > FALSE_ALARM


@pytest.mark.parametrize("axis", ["pixels", "seeds"])
def test_neighbouring_streams_are_uncorrelated(axis):
    streams = np.arange(512)
    other = np.zeros(512, int)
    pixels, seeds = (streams, other) if axis == "pixels" else (other, streams)
    x = lattice(seeds, pixels, np.arange(64))[:, :, :16]  # (stream, sample, dimension)
    for lag in (1, 2, 16, 256):
        a, b = (np.moveaxis(y, 0, -1).reshape(-1, 512 - lag) for y in (x[:-lag], x[lag:]))
        p = correlation_p(a, b).reshape(64, -1)
        # Samples of one stream depend on each other, so only the first of each pair counts as independent.
        assert sidak(p[0]) > FALSE_ALARM
        assert p.min() > FALSE_ALARM / p.size


def test_streams_differ_for_every_pixel_and_seed():
    pixels = jnp.arange(1 << 16, dtype=jnp.uint32)
    stream = jax.jit(jax.vmap(sampler.pixel_stream, in_axes=(None, 0)))
    first, second = np.asarray(stream(0, pixels)), np.asarray(stream(1, pixels))
    assert len(np.unique(first)) == 1 << 16
    assert (first != second).all()
    # Across seeds, 2^32 pairs of 32-bit numbers: one collision is expected.
    assert len(np.intersect1d(first, second)) < 10


def test_hashed_is_uniform_in_every_dimension_and_pair():
    x = np.concatenate([hashed(11, np.arange(1 << 17), first) for first in (0, 8)], 1)
    n, d = x.shape
    p = [stats.chisquare(np.bincount((x[:, k] * 256).astype(int), minlength=256)).pvalue for k in range(d)]
    for i in range(d):
        for j in range(i):
            cell = (x[:, i] * 16).astype(int) * 16 + (x[:, j] * 16).astype(int)
            p.append(stats.chisquare(np.bincount(cell, minlength=256)).pvalue)
    assert sidak(p) > FALSE_ALARM
    # Counts that are too even are wrong as well.
    assert np.max(p) < 1 - FALSE_ALARM / len(p)


def test_hashed_dimensions_are_the_same_however_they_are_asked_for():
    key = sampler.path_key(jnp.uint32(9), 4)
    np.testing.assert_array_equal(sampler.hashed(key, 0, 16)[8:], sampler.hashed(key, 8, 8))


def test_hashed_and_lattice_numbers_are_uncorrelated():
    pixels = np.arange(20_000)
    streams = jax.vmap(sampler.pixel_stream, in_axes=(None, 0))(0, jnp.asarray(pixels, jnp.uint32))
    h = np.asarray(jax.vmap(lambda s: sampler.hashed(sampler.path_key(s, 3), 0, 8))(streams), np.float64).T
    x = lattice(np.zeros(20_000), pixels, [3])[:, 0].T
    p = correlation_p(np.repeat(h, DIMENSIONS, 0), np.tile(x, (8, 1)))
    assert sidak(p) > FALSE_ALARM


def smooth(u):
    return np.exp(-u[..., 0]) * np.cos(u[..., 1]) + u[..., 0] * u[..., 1]


def pairs(points):
    return points.reshape(*points.shape[:-1], -1, 2)


SMOOTH_MEAN = (1 - np.exp(-1)) * np.sin(1) + 0.25


def test_mean_is_unbiased_over_seeds():
    # 16 samples of 4096 seeds: the means are independent.
    means = smooth(pairs(lattice(np.arange(4096), np.full(4096, 5), np.arange(16)))).mean(1)
    z = (means.mean(0) - SMOOTH_MEAN) / (means.std(0) / np.sqrt(4096))
    assert sidak(2 * stats.norm.sf(np.abs(z))) > FALSE_ALARM


def test_variance_falls_as_that_of_a_shifted_lattice_does():
    """Var ~ N^-2 (log N)^2 for smooth integrands that are not periodic, N^-1 for independent numbers."""
    streams = np.arange(256)
    few, many = 16, 1024
    variance = {n: smooth(pairs(lattice(streams, streams, np.arange(n)))).mean(1).var(0).mean() for n in (few, many)}
    assert variance[many] < variance[few] * (few / many * np.log(many) / np.log(few)) ** 2
    one = np.concatenate([smooth(hashed(k, np.arange(4096))[:, :2]) for k in range(8)])
    assert variance[many] < one.var() / many / 10


def test_sample_numbers_beyond_2_to_the_24_do_not_repeat():
    samples = np.concatenate([np.arange(4096), (1 << 24) + np.arange(4096), (1 << 31) + np.arange(4096)])
    points = lattice([1], [2], samples)[0]
    assert len(np.unique(points, axis=0)) == len(samples)
    assert len(np.unique(hashed(1, samples), axis=0)) == len(samples)
