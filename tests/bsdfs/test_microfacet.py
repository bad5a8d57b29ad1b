"""Distributions of facet normals: samples have the stated density, which is normalised, and float32 suffices."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pathjax.bsdfs.microfacet import DISTRIBUTIONS, MIN_ALPHA, Beckmann

FALSE_ALARM = 1e-4
# Normal, oblique and grazing.
COSINES = (1.0, 0.6, 0.05)
kinds = pytest.mark.parametrize("kind", DISTRIBUTIONS.values(), ids=DISTRIBUTIONS)
alphas = pytest.mark.parametrize("alpha", [(0.1, 0.6), (1.0, 1.0)])


@partial(jax.jit, static_argnums=(0, 1))
def _ask(kind, method, alpha, *vectors):
    made = kind.of(*alpha)
    return jax.vmap(lambda last: getattr(made, method)(*vectors[:-1], last))(vectors[-1])


def ask(kind, method, alpha, *vectors, dtype=np.float32):
    """Call a method for each row of the last vector, (N, 2 or 3)."""
    alpha, vectors = ([jnp.asarray(x, dtype) for x in each] for each in (alpha, vectors))
    return np.asarray(_ask(kind, method, alpha, *vectors), np.float64)


def direction(cos, azimuth=2.2):
    sin = np.sqrt(1 - cos * cos)
    return np.array([sin * np.cos(azimuth), sin * np.sin(azimuth), cos])


def hemisphere(alpha, n=256):
    """Return normals (N, 3) at midpoints of cells, distributed as on an ellipsoid, and their solid angles (N,)."""
    s, phi = ((np.arange(n) + 0.5) / n for _ in range(2))
    s, phi = (x.ravel() for x in np.meshgrid(s, 2 * np.pi * phi, indexing="ij"))
    t, dt = 1 - (1 - s) ** 2, 2 * (1 - s)  # sin^2 on the sphere that becomes the ellipsoid; denser in the tails
    z, r = np.sqrt(1 - t), np.sqrt(t)
    m = np.stack([alpha[0] * r * np.cos(phi), alpha[1] * r * np.sin(phi), z], -1)
    length = np.linalg.norm(m, axis=1)
    return m / length[:, None], alpha[0] * alpha[1] / length**3 * dt / (2 * z) * (2 * np.pi / n**2)


@kinds
@alphas
def test_facets_cover_the_surface_once(kind, alpha):
    m, share = hemisphere(alpha)
    area = ask(kind, "area", alpha, m) * share
    assert area @ m[:, 2] == pytest.approx(1, abs=1e-3)
    for cos in COSINES:
        # Heitz 2014, equation 14: the facets visible from a direction have the projected area cos theta.
        wi = direction(cos)
        facing = area @ np.maximum(m @ wi, 0)
        assert ask(kind, "drawn", alpha, wi[None]) * facing == pytest.approx(1, abs=1e-3)
        rational = 3.5e-3 if kind is Beckmann else 0
        assert ask(kind, "seen", alpha, wi[None]) * facing == pytest.approx(1, abs=1e-3 + rational)


@kinds
@alphas
def test_normals_are_drawn_with_the_stated_density(kind, alpha, n=100_000, cells=16):
    def cell(m):
        """Return the cell of each normal, by slopes over roughness."""
        x, y = (m[:, i] / alpha[i] / m[:, 2].clip(1e-6) for i in range(2))
        t, phi = 1 / np.sqrt(1 + x * x + y * y), np.arctan2(y, x) / (2 * np.pi) % 1
        return (t * cells).astype(int).clip(0, cells - 1) * cells + (phi * cells).astype(int) % cells

    u = np.random.default_rng(1).integers(0, 1 << 24, (n, 2)) * 2.0**-24
    m, share = hemisphere(alpha, 512)
    for cos in COSINES:
        wi = direction(cos)
        drawn = ask(kind, "sample", alpha, wi, u)
        np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-6)
        assert (drawn[:, 2] >= 0).all() and (drawn @ wi > -1e-6).all()
        expected = n * np.bincount(cell(m), ask(kind, "pdf", alpha, wi, m) * share, cells**2)
        seen = np.bincount(cell(drawn), minlength=cells**2)
        few = expected < 20
        seen, expected = np.append(seen[~few], seen[few].sum()), np.append(expected[~few], expected[few].sum())
        used = expected > 20
        statistic = ((seen - expected)[used] ** 2 / expected[used]).sum()
        assert stats.chi2.sf(statistic, used.sum() - 1) > FALSE_ALARM, cos


@kinds
def test_float32_is_as_good_as_float64_down_to_the_least_roughness(kind):
    """For sampled normals; nothing is NaN at the ends of all ranges."""
    ends = np.array([0, 2**-24, 0.3, 0.5, 1 - 2**-24])
    u = np.stack(np.meshgrid(ends, ends), -1).reshape(-1, 2)
    for alpha in ((a, a) for a in (MIN_ALPHA, 1e-3, 0.03, 1.0)):
        for cos in (1.0, 0.7, 0.02, 1e-4, 0.0):
            wi = direction(cos)
            m32 = ask(kind, "sample", alpha, wi, u)
            assert np.isfinite(m32).all()
            with jax.enable_x64(True):
                m = ask(kind, "sample", alpha, wi, u, dtype=np.float64)
                assert np.isfinite(m).all()
                # The rounding of a normal's components, 6e-8, is divided by the roughness. Far in the tails, at the
                # ends of u, the logarithm of a density has a steeper slope.
                near = np.hypot(m[:, 0], m[:, 1]) < 4 * alpha[0] * m[:, 2]
                for method, at, error in (
                    ("area", m[near], 2e-6 / alpha[0]),
                    ("seen", wi[None], 0),
                    ("drawn", wi[None], 0),
                ):
                    precise = ask(kind, method, alpha, at, dtype=np.float64)
                    np.testing.assert_allclose(ask(kind, method, alpha, at), precise, rtol=1e-5 + error)


@kinds
def test_small_roughnesses_are_raised_to_the_least(kind):
    m = np.array([[1e-5, 0, 1]])
    assert ask(kind, "area", (0, 1e-5), m) == ask(kind, "area", (MIN_ALPHA, MIN_ALPHA), m)
