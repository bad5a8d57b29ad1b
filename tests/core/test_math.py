"""Frames are orthonormal everywhere; functions that could divide by zero and their derivatives are finite there."""

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.core import math
from pathjax.core.types import Surface


def unit_normals():
    rng = np.random.default_rng(1)
    n = rng.normal(size=(100_000, 3))
    tiny = [[x, y, z] for z in (1, -1) for x in (0.0, -0.0, 1e-20, -1e-20, 1e-7, -1e-4) for y in (0.0, 1e-7, -1e-30)]
    flat = [[1, 0, 0.0], [1, 0, -0.0], [0, 1, -0.0], [0.6, 0.8, 1e-30], [0.6, 0.8, -1e-30]]
    n = np.concatenate([n, tiny, flat])
    return jnp.asarray(n / np.linalg.norm(n, axis=1, keepdims=True), jnp.float32)


def test_frames_are_orthonormal_and_right_handed():
    n = unit_normals()
    frame = np.asarray(jax.jit(jax.vmap(lambda n: jnp.stack(math.frame_from_normal(n))))(n), np.float64)
    # The normals are unit to 1e-7, and that error is doubled.
    np.testing.assert_allclose(frame @ np.swapaxes(frame, 1, 2), np.broadcast_to(np.eye(3), frame.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(frame), 1, atol=1e-6)


def test_local_and_world_are_inverse():
    n = unit_normals()
    v = jnp.asarray(np.random.default_rng(2).normal(size=n.shape), jnp.float32)

    def round_trip(n, v):
        frame = math.frame_from_normal(n)
        return math.to_world(frame, math.to_local(frame, v)), math.to_local(frame, n)

    back, z = jax.jit(jax.vmap(round_trip))(n, v)
    np.testing.assert_allclose(back, v, atol=5e-6)
    np.testing.assert_allclose(z, np.broadcast_to([0, 0, 1], n.shape), atol=1e-6)


@pytest.mark.parametrize("x", [-1.0, 0.0, -0.0, 1e-37, 4.0])
def test_safe_sqrt_and_its_derivatives_are_finite(x):
    value, slope = jax.value_and_grad(math.safe_sqrt)(x)
    assert float(value) == pytest.approx(np.sqrt(max(x, 0)))
    assert float(slope) == pytest.approx(0 if x <= 0 else 0.5 / np.sqrt(x))
    assert np.isfinite(jax.jvp(math.safe_sqrt, (x,), (1.0,))[1])


def test_safe_divide_is_zero_at_zero_with_its_derivatives():
    for a in (0.0, 3.0):
        value, slopes = jax.value_and_grad(math.safe_divide, argnums=(0, 1))(a, 0.0)
        assert value == 0 and slopes == (0, 0)
    value, slopes = jax.value_and_grad(math.safe_divide, argnums=(0, 1))(3.0, 2.0)
    assert (value, *slopes) == (1.5, 0.5, -0.75)


def test_normalize_keeps_zero_and_its_derivative_finite():
    np.testing.assert_array_equal(math.normalize(jnp.zeros(3)), np.zeros(3))
    assert np.isfinite(jax.jit(jax.jacfwd(math.normalize))(jnp.zeros(3))).all()
    assert np.isfinite(jax.jit(jax.jacrev(math.normalize))(jnp.zeros(3))).all()


def test_normalize_is_unit():
    v = np.random.default_rng(3).normal(size=(10_000, 3))
    v *= 10 ** np.random.default_rng(4).uniform(-15, 15, (10_000, 1))
    n = np.asarray(jax.vmap(math.normalize)(jnp.asarray(v, jnp.float32)), np.float64)
    # Three roundings.
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=3e-7)


def test_smaller_and_larger_drop_nan_in_the_first_place():
    nan = jnp.float32(jnp.nan)
    assert math.smaller(nan, 1.0) == 1 and math.larger(nan, 1.0) == 1
    assert math.smaller(1.0, 2.0) == 1 and math.larger(1.0, 2.0) == 2


def test_offset_point_moves_to_the_side_of_the_direction():
    n = unit_normals()[:1000]
    d = jnp.asarray(np.random.default_rng(5).normal(size=n.shape), jnp.float32)
    p = jnp.asarray(np.random.default_rng(6).uniform(-100, 100, n.shape), jnp.float32)
    margin = jnp.full(len(n), 1e-3, jnp.float32)

    def moved(n, d, p, margin):
        return math.offset_point(Surface(p, n, margin, n, jnp.zeros(2)), d)

    step = np.asarray(jax.jit(jax.vmap(moved))(n, d, p, margin), np.float64) - np.asarray(p, np.float64)
    along, side = np.sum(step * n, 1), np.sum(np.asarray(d, np.float64) * n, 1)
    # The sum is rounded at |p| = 100: 4e-6 per axis.
    np.testing.assert_allclose(along * np.sign(side), 1e-3, atol=2e-5)


def test_spawned_ray_excludes_its_primitive_and_has_no_end():
    n = jnp.array([0.0, 0.0, 1.0])
    ray = math.spawn_ray(Surface(n, n, jnp.float32(0.1), n, jnp.zeros(2)), -n, jnp.int32(7))
    assert ray.exclude == 7 and ray.t_max == np.inf
    np.testing.assert_allclose(ray.o, [0, 0, 0.9], rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_angles_are_right_to_rounding(dtype, x64):
    eps = np.finfo(dtype).eps
    with x64() if dtype == np.float64 else nullcontext():
        u = np.concatenate([np.linspace(0, 1, 10_001), [0, 1 - 2**-24, 1]]).astype(dtype)
        cos, sin = math.cos_sin_turns(jnp.asarray(u))
        # u - k / 4 is exact, and the series ends below rounding.
        np.testing.assert_allclose(cos, np.cos(2 * np.pi * u.astype(np.longdouble)), atol=2 * eps)
        np.testing.assert_allclose(sin, np.sin(2 * np.pi * u.astype(np.longdouble)), atol=2 * eps)
        turns = np.linspace(-np.pi, np.pi, 10_001)[1:-1]
        for length in (1e-20, 1, 1e20):
            y, x = (length * np.sin(turns)).astype(dtype), (length * np.cos(turns)).astype(dtype)
            np.testing.assert_allclose(math.safe_atan2(y, x), np.arctan2(y.astype(float), x), rtol=4 * eps, atol=eps)
        axes = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]], dtype)
        np.testing.assert_allclose(math.safe_atan2(*axes.T), [0, np.pi / 2, np.pi, -np.pi / 2], rtol=eps)
