"""Phase functions: densities, samples and mean cosines, and kinds registered by a user's script."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import media, testing
from pathjax.core.math import safe_sqrt
from pathjax.core.warp import cos_sin_turns
from pathjax.kinds import Parameters, Row

SAMPLES = 100_000


@pytest.mark.slow
def test_isotropic_is_drawn_evenly():
    testing.check_phase(media.Isotropic)


@pytest.mark.parametrize(
    "g", [0.0, 0.5, -0.8, pytest.param(0.9, marks=pytest.mark.slow), pytest.param(1e-6, marks=pytest.mark.slow)]
)
def test_henyey_and_greenstein_is_drawn_by_its_density(g):
    testing.check_phase(media.HG, g=g)


@pytest.mark.parametrize("g", [0.8, -0.3, 0.999, -0.999, 1 - 2**-24])
def test_the_mean_cosine_is_g(g):
    table = media.HG.build([media.HG.instance(g=g)], np.float32, (), Parameters(), None)
    u = jnp.asarray(np.random.default_rng(1).random((SAMPLES, 2)), jnp.float32)
    wo = np.asarray(jax.vmap(lambda u: media.HG.sample(Row(table, 0), u))(u), float)
    cos = -wo[:, 2]
    # 4 standard errors, a false alarm in 16,000; and rounding of cosines near -1 or 1.
    assert abs(cos.mean() - g) < 4 * cos.std() / math.sqrt(SAMPLES) + 1e-6


TABLES = [1, 1], [0, 1], [1, 0, 3, 2], [0, 0, 1, 0, 0], list(np.exp(np.linspace(-3, 3, 50)))


@pytest.mark.parametrize("values", TABLES, ids=len)
def test_a_table_is_drawn_by_its_density(values):
    testing.check_phase(media.TabPhase, samples=50_000, values=np.array(values, float))


def test_tables_of_any_length_stand_beside_each_other():
    """Each interpolates its values linearly, up to scale, and its samples have the mean cosine of that density."""
    made = [media.TabPhase.instance(values=np.array(values, float)) for values in TABLES]
    table = media.TabPhase.build(made, np.float32, (), Parameters(), None)
    cos = np.linspace(-1, 1, 20_001)
    wo = jnp.asarray(np.stack([np.sqrt(1 - cos * cos), 0 * cos, -cos], -1), jnp.float32)
    u = jnp.asarray(np.random.default_rng(1).random((SAMPLES, 2)), jnp.float32)
    for row, values in enumerate(TABLES):
        lines = np.interp(cos, np.linspace(-1, 1, len(values)), values)
        lines /= np.trapezoid(lines, cos)
        found = jax.jit(jax.vmap(lambda wo, row=row: media.TabPhase.evaluate(Row(table, row), wo)))(wo)
        np.testing.assert_allclose(2 * np.pi * found, lines, rtol=1e-4, atol=1e-4 * lines.max())
        sample = jax.jit(jax.vmap(lambda u, row=row: media.TabPhase.sample(Row(table, row), u)))
        drawn = -np.asarray(sample(u), float)[:, 2]
        # 4.5 standard errors for each of five, a false alarm in 30,000; and the steps of the cumulative table.
        assert abs(drawn.mean() - np.trapezoid(lines * cos, cos)) < 4.5 * drawn.std() / math.sqrt(SAMPLES) + 1e-5


def test_a_density_that_is_not_drawn_is_noticed():
    class Wrong(media.HG):
        @staticmethod
        def evaluate(p, wo):
            return media.HG.evaluate(p, -wo)

    with pytest.raises(AssertionError, match="do not follow"):
        testing.check_phase(Wrong, g=0.3)


class Rayleigh(media.Phase):
    """3/4 (1 + cos^2) over 4 pi."""

    @staticmethod
    def evaluate(p, wo):
        return 3 / (16 * math.pi) * (1 + wo[2] * wo[2])

    @staticmethod
    def sample(p, u):
        # The cubic z^3 + 3 z = 8 u - 4 has one real root (Cardano).
        b = 4 * u[1] - 2
        a = jnp.cbrt(b + jnp.sqrt(b * b + 1))
        z = a - 1 / a
        cos, sin = cos_sin_turns(u[0])
        r = safe_sqrt(1 - z * z)
        return jnp.stack([r * cos, r * sin, z])


@pytest.fixture
def rayleigh():
    media.register("own")(Rayleigh)
    yield
    del media.PHASES["own"]


def test_rayleigh_is_drawn_by_its_density():
    testing.check_phase(media.Rayleigh, samples=50_000)


def test_a_registered_phase_function_is_read_from_scenes(rayleigh):
    testing.check_phase(Rayleigh, samples=50_000)
    fog = {"type": "homogeneous", "phase": {"type": "own"}}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}
    sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2}}
    rest = {"integrator": {"type": "volpath"}, "sky": {"type": "constant"}}
    scene = pj.load_dict({"type": "scene", **rest, "sensor": sensor, "ball": ball})
    assert [table.kind for table in scene.media.phases] == [Rayleigh]


def test_another_class_is_no_phase_function():
    with pytest.raises(pj.InputError, match="must be a class derived from media.Phase"):
        media.register("wrong")(pj.Scene)
