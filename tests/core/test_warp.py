"""Every map of uniform numbers has its stated density, and is finite at the ends of [0, 1)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pathjax.core import warp

# Chance that a correct map fails: 1e-4 over all tests of this file together (Sidak). Seeds are fixed.
FALSE_ALARM = 1e-4
TESTS = 8
LAST = 1 - 2**-24
N = 400_000


def uniform(*shape, seed=1):
    """Return multiples of 2^-24 in [0, 1), also 0; the sampler's odd multiples would avoid all cell borders."""
    return jnp.asarray(np.random.default_rng(seed).integers(0, 1 << 24, shape) * 2.0**-24, jnp.float32)


def mapped(f, *arguments):
    return np.asarray(jax.jit(jax.vmap(f))(*arguments), np.float64)


def assert_density(counts, probabilities):
    counts, expected = np.ravel(counts), np.ravel(probabilities) * np.sum(counts)
    assert abs(np.sum(probabilities) - 1) < 1e-6, "the stated density does not integrate to 1"
    assert expected.min() > 5
    p = stats.chisquare(counts, expected * (counts.sum() / expected.sum())).pvalue
    assert p > 1 - (1 - FALSE_ALARM) ** (1 / TESTS), p


def sphere_cells(w, z_edges, phi_cells=16):
    """Count directions in cells of z and azimuth."""
    phi = np.arctan2(w[:, 1], w[:, 0]) / (2 * np.pi) % 1
    return np.histogram2d(w[:, 2], phi, [z_edges, np.linspace(0, 1, phi_cells + 1)])[0]


def integral(f, low, high, steps=64):
    x = low + (np.arange(steps) + 0.5) * (high - low) / steps
    return np.mean(f(x)) * (high - low)


def test_cosine_hemisphere_has_its_density():
    w = mapped(warp.square_to_cosine_hemisphere, uniform(N, 2))
    assert np.abs(np.linalg.norm(w, axis=1) - 1).max() < 1e-6 and w[:, 2].min() >= 0
    edges = np.linspace(0, 1, 13)

    def pdf(z):
        zero = jnp.zeros_like(jnp.asarray(z))
        return np.asarray(warp.square_to_cosine_hemisphere_pdf(jnp.stack([zero, zero, jnp.asarray(z)])), np.float64)

    # dw = dz dphi
    rows = np.array([integral(pdf, a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]) * 2 * np.pi
    assert_density(sphere_cells(w, edges), np.repeat(rows[:, None] / 16, 16, 1))
    assert warp.square_to_cosine_hemisphere_pdf(jnp.array([0, 0, -0.5])) == 0


def test_disk_is_uniform():
    p = mapped(warp.square_to_disk, uniform(N, 2))
    assert np.linalg.norm(p, axis=1).max() <= 1 + 1e-6
    squared, phi = (p**2).sum(1), np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) % 1
    counts = np.histogram2d(squared, phi, [np.linspace(0, 1 + 1e-6, 17), np.linspace(0, 1, 33)])[0]
    assert_density(counts, np.full(counts.shape, 1 / counts.size))


def test_sphere_is_uniform():
    w = mapped(warp.square_to_sphere, uniform(N, 2))
    assert np.abs(np.linalg.norm(w, axis=1) - 1).max() < 1e-6
    counts = sphere_cells(w, np.linspace(-1, 1, 17))
    assert_density(counts, np.full(counts.shape, warp.SPHERE_PDF * (2 / 16) * (2 * np.pi / 16)))


@pytest.mark.parametrize("one_minus_cos", [1e-6, 0.1, 1.0])
def test_cone_is_uniform(one_minus_cos):
    w = mapped(lambda u: warp.square_to_cone(u, one_minus_cos), uniform(N, 2))
    # 1 - z comes from x and y, since z has no digits left in a narrow cone.
    squared = w[:, 0] ** 2 + w[:, 1] ** 2
    h = squared / (1 + np.sqrt(np.maximum(1 - squared, 0)))
    # The last ulps of the rim may fall outside.
    h = np.minimum(h / one_minus_cos, 1 - 1e-9)
    phi = np.arctan2(w[:, 1], w[:, 0]) / (2 * np.pi) % 1
    counts = np.histogram2d(h, phi, [np.linspace(0, 1, 17), np.linspace(0, 1, 17)])[0]
    solid_angle = 2 * np.pi * one_minus_cos
    assert_density(counts, np.full(counts.shape, float(warp.cone_pdf(one_minus_cos)) * solid_angle / counts.size))


def test_triangle_is_uniform():
    b = mapped(warp.square_to_triangle, uniform(N, 2))
    assert b.min() >= 0 and b.sum(1).max() <= 1
    # Cells of equal area: s = 1 - b1 has density 2 s, and b2 / s is uniform.
    s = 1 - b[:, 0]
    counts = np.histogram2d(s * s, b[:, 1] / s, [np.linspace(0, 1, 17), np.linspace(0, 1 + 1e-6, 17)])[0]
    assert_density(counts, np.full(counts.shape, 1 / counts.size))


def test_tent_has_its_density():
    x = mapped(warp.tent, uniform(N))
    edges = np.linspace(-1, 1, 65)
    pdf = [integral(lambda x: np.asarray(warp.tent_pdf(jnp.asarray(x)), np.float64), a, b)
           for a, b in zip(edges[:-1], edges[1:], strict=True)]
    assert_density(np.histogram(x, edges)[0], np.array(pdf))


def test_maps_are_finite_at_the_ends_of_the_interval_with_their_derivatives():
    corners = jnp.array([[a, b] for a in (0, 0.5, LAST) for b in (0, 0.5, LAST)], jnp.float32)
    maps = [
        warp.square_to_disk,
        warp.square_to_cosine_hemisphere,
        warp.square_to_sphere,
        lambda u: warp.square_to_cone(u, 0.5),
        warp.square_to_triangle,
        warp.tent,
    ]
    for f in maps:
        assert np.isfinite(mapped(f, corners)).all()
        assert np.isfinite(mapped(jax.jacfwd(f), corners)).all()


def test_disk_map_keeps_its_orientation_and_centre():
    np.testing.assert_array_equal(warp.square_to_disk(jnp.array([0.5, 0.5])), [0, 0])
    np.testing.assert_allclose(warp.square_to_disk(jnp.array([LAST, 0.5])), [1, 0], atol=2e-7)
    np.testing.assert_allclose(warp.square_to_disk(jnp.array([0.5, LAST])), [0, 1], atol=2e-7)
