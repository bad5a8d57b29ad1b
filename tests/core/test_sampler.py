"""The numbers of a path: (0, 2)-nets in every pair, independent of each other, of pixels and of seeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pathjax.core import sampler

PAIRS = 8
# Chance that a correct sampler fails a statistical test of this file: 1e-4 over each test's comparisons (Sidak).
FALSE_ALARM = 1e-4


def sidak(p_values):
    """The smallest p of independent tests, as one p."""
    p = np.min(p_values)
    return -np.expm1(np.size(p_values) * np.log1p(-p))


@jax.jit
def _sobol(seeds, pixels, samples):
    def one(seed, pixel):
        stream = sampler.pixel_stream(seed, pixel)
        return jax.vmap(lambda i: jax.vmap(lambda k: sampler.sobol_pair(stream, i, k))(jnp.arange(PAIRS)))(samples)

    return jax.vmap(one)(seeds, pixels)


def sobol(seeds, pixels, samples):
    """(K, N, PAIRS, 2): K streams, N samples."""
    return np.asarray(_sobol(*(np.asarray(x, np.uint32) for x in (seeds, pixels, samples))), np.float64)


@jax.jit
def _hashed(stream, samples, first):
    return jax.vmap(lambda i: sampler.hashed(sampler.path_key(stream, i), first, 8))(samples)


def hashed(stream, samples, first=0):
    return np.asarray(_hashed(np.uint32(stream), np.asarray(samples, np.uint32), np.uint32(first)), np.float64)


def assert_net(points):
    """Every elementary interval of area 1/N holds one of the N points (..., N, 2)."""
    count = points.shape[-2]
    bits = count.bit_length() - 1
    for split in range(bits + 1):
        cell = (points * [1 << split, 1 << (bits - split)]).astype(int)
        number = cell[..., 0] << (bits - split) | cell[..., 1]
        np.testing.assert_array_equal(np.sort(number, axis=-1), np.broadcast_to(np.arange(count), number.shape))


@pytest.mark.parametrize("count", [16, 64, 256])
def test_each_pair_is_a_net_for_every_stream(count):
    points = sobol(np.arange(20), 7 * np.arange(20), np.arange(count))
    assert_net(np.moveaxis(points, 1, 2))


@pytest.mark.parametrize("first", [256, 5 * 256, 1 << 24, (1 << 32) - 256])
def test_each_aligned_block_of_samples_is_a_net(first):
    points = sobol(np.arange(8), np.arange(8), first + np.arange(256, dtype=np.int64))
    assert_net(np.moveaxis(points, 1, 2))


def test_numbers_lie_below_one_and_are_multiples_of_2_to_the_minus_24():
    x = np.concatenate([sobol([0, 1], [3, 4], np.arange(50_000)).ravel(), hashed(5, np.arange(50_000)).ravel()])
    assert x.min() >= 0 and x.max() < 1
    assert (x * 2**24 == np.floor(x * 2**24)).all()
    assert float(sampler.to_unit(jnp.uint32(0xFFFFFFFF))) == 1 - 2**-24


def correlation_p(a, b):
    """p of no correlation, for K independent pairs of N independent numbers: z = r sqrt(N)."""
    z = np.mean((a - a.mean(-1, keepdims=True)) * (b - b.mean(-1, keepdims=True)), -1) * np.sqrt(a.shape[-1])
    return 2 * stats.norm.sf(np.abs(z) / (a.std(-1) * b.std(-1)))


def test_dimensions_are_uncorrelated():
    # One sample of each of many pixels: independent points, unlike the samples of one pixel.
    x = sobol(np.zeros(20_000), np.arange(20_000), [3])[:, 0].reshape(-1, 2 * PAIRS).T
    i, j = np.triu_indices(2 * PAIRS, 1)
    assert sidak(correlation_p(x[i], x[j])) > FALSE_ALARM


def test_pairs_are_in_independent_orders():
    """Padded pairs must not visit their nets in step: correlation over the samples of one pixel."""
    x = sobol(np.arange(64), np.arange(64), np.arange(1024)).reshape(64, 1024, 2 * PAIRS)
    i, j = np.triu_indices(2 * PAIRS, 1)
    keep = i // 2 != j // 2
    z = np.mean((x[:, :, i[keep]] - 0.5) * (x[:, :, j[keep]] - 0.5), 1) * 12 * np.sqrt(1024)
    # Stratified numbers have a variance below that of independent ones, so the bound is safe.
    assert sidak(2 * stats.norm.sf(np.abs(np.sqrt(64) * z.mean(0)))) > FALSE_ALARM
    assert np.abs(z).max() < 6


@pytest.mark.parametrize("axis", ["pixels", "seeds"])
def test_neighbouring_streams_are_uncorrelated(axis):
    streams = np.arange(512)
    other = np.zeros(512, int)
    pixels, seeds = (streams, other) if axis == "pixels" else (other, streams)
    x = sobol(seeds, pixels, np.arange(64))  # (stream, sample, pair, 2)
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
    # Too even is no better.
    assert np.max(p) < 1 - FALSE_ALARM / len(p)


def test_hashed_dimensions_are_the_same_however_they_are_asked_for():
    key = sampler.path_key(jnp.uint32(9), 4)
    np.testing.assert_array_equal(sampler.hashed(key, 0, 16)[8:], sampler.hashed(key, 8, 8))


def test_hashed_and_sobol_numbers_are_uncorrelated():
    pixels = np.arange(20_000)
    streams = jax.vmap(sampler.pixel_stream, in_axes=(None, 0))(0, jnp.asarray(pixels, jnp.uint32))
    h = np.asarray(jax.vmap(lambda s: sampler.hashed(sampler.path_key(s, 3), 0, 8))(streams), np.float64).T
    x = sobol(np.zeros(20_000), pixels, [3])[:, 0].reshape(-1, 2 * PAIRS).T
    p = correlation_p(np.repeat(h, 2 * PAIRS, 0), np.tile(x, (8, 1)))
    assert sidak(p) > FALSE_ALARM


def smooth(u):
    return np.exp(-u[..., 0]) * np.cos(u[..., 1]) + u[..., 0] * u[..., 1]


SMOOTH_MEAN = (1 - np.exp(-1)) * np.sin(1) + 0.25


def test_mean_is_unbiased_over_seeds():
    # 16 samples of 4096 seeds: the means are independent.
    means = smooth(sobol(np.arange(4096), np.full(4096, 5), np.arange(16))).mean(1)
    z = (means.mean(0) - SMOOTH_MEAN) / (means.std(0) / np.sqrt(4096))
    assert sidak(2 * stats.norm.sf(np.abs(z))) > FALSE_ALARM


def test_variance_falls_as_a_scrambled_net_does():
    """Var ~ N^-3 log N for smooth integrands (Owen 1997), N^-1 for independent numbers."""
    variance = {n: smooth(sobol(np.arange(512), np.arange(512), np.arange(n))).mean(1).var(0).mean() for n in (16, 256)}
    assert variance[256] < variance[16] / 16**2.5
    one = np.concatenate([smooth(hashed(k, np.arange(4096))[:, :2]) for k in range(8)])
    assert variance[256] < one.var() / 256 / 1000


def test_sample_numbers_beyond_2_to_the_24_do_not_repeat():
    samples = np.concatenate([np.arange(4096), (1 << 24) + np.arange(4096), (1 << 31) + np.arange(4096)])
    points = sobol([1], [2], samples)[0].reshape(len(samples), -1)
    assert len(np.unique(points, axis=0)) == len(samples)
    assert len(np.unique(hashed(1, samples), axis=0)) == len(samples)
