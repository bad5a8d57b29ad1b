"""Ray queries: `any_hit` agrees with `closest_hit`, and both work within JAX's transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.io.load import load_scene


@pytest.fixture(scope="module")
def spheres(root):
    return load_scene(root / "scenes/nine_spheres.xml", res=4)


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(0)
    origins = rng.uniform(-2, 2, (600, 3)).astype(np.float32)
    return origins, rng.normal(size=(600, 3)).astype(np.float32) * 7  # not unit vectors


def test_what_blocks_is_met_before_the_distance(spheres, rays):
    t = np.asarray(pj.closest_hit(spheres, *rays).t)
    np.testing.assert_array_equal(pj.any_hit(spheres, *rays), np.isfinite(t))
    distances = np.random.default_rng(1).uniform(0, 3, 600).astype(np.float32)
    blocked = np.asarray(pj.any_hit(spheres, *rays, distances))
    np.testing.assert_array_equal(blocked, t < distances)
    assert 0.1 < blocked.mean() < 0.9
    np.testing.assert_array_equal(pj.any_hit(spheres, *rays, 1.5), t < 1.5)
    assert pj.any_hit(spheres, *(x[:0] for x in rays)).shape == (0,)


@pytest.mark.parametrize(
    "origins, directions, says",
    [
        ((3,), (3,), r"shapes \(3,\) and \(3,\); both must be \(N, 3\)"),
        ((2, 2), (2, 2), r"both must be \(N, 3\)"),
        ((2, 3), (5, 3), r"shapes \(2, 3\) and \(5, 3\)"),
    ],
)
def test_rays_of_other_shapes_are_refused(spheres, origins, directions, says):
    for query in (pj.closest_hit, pj.any_hit):
        with pytest.raises(pj.InputError, match=says):
            query(spheres, np.zeros(origins), np.ones(directions))


def test_another_number_of_distances_is_refused(spheres):
    with pytest.raises(pj.InputError, match=r"distances have the shape \(3,\); give one, or one for each"):
        pj.any_hit(spheres, np.zeros((2, 3)), np.ones((2, 3)), np.ones(3))


def test_queries_within_jit_vmap_and_loops(spheres, rays):
    alone = np.asarray(pj.closest_hit(spheres, *rays).t), np.asarray(pj.any_hit(spheres, *rays, 1.0))

    def both(o, d):
        return pj.closest_hit(spheres, o, d).t, pj.any_hit(spheres, o, d, 1.0)

    parts = [jnp.reshape(x, (3, 200, 3)) for x in rays]
    for name, query in {
        "jit": lambda: jax.jit(both)(*rays),
        "vmap": lambda: jax.vmap(both)(*parts),
        "map": lambda: jax.jit(lambda *parts: jax.lax.map(lambda part: both(*part), parts))(*parts),
    }.items():
        for expected, found in zip(alone, query(), strict=True):
            # Other programs differ in the last bits.
            np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-5, err_msg=name)
