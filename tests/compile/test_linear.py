"""A linear function with its own transpose, under JAX's transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.compile import linear
from pathjax.errors import InputError

MATRIX = np.arange(6, dtype=np.float32).reshape(2, 3)
X, Y = np.array([1, -2, 5], np.float32), np.array([3, 4], np.float32)


def times(known, x):
    return {"y": known["matrix"] @ x[0]}


def transposed(known, y):
    return (known["matrix"].T @ y["y"],)


def f(x, matrix=MATRIX):
    return linear(times, transposed, {"matrix": jnp.asarray(matrix)}, (x,))["y"]


@pytest.mark.parametrize("jit", [lambda f: f, jax.jit])
def test_products_both_ways(jit):
    value, moved = jit(lambda x, t: jax.jvp(f, (x,), (t,)))(X, 2 * X)
    np.testing.assert_array_equal(value, MATRIX @ X)
    np.testing.assert_array_equal(moved, 2 * MATRIX @ X)
    np.testing.assert_array_equal(jit(jax.grad(lambda x: f(x) @ Y))(X), MATRIX.T @ Y)
    np.testing.assert_array_equal(jit(jax.linearize(f, X)[1])(X), MATRIX @ X)
    np.testing.assert_array_equal(jit(jax.linear_transpose(f, X))(Y)[0], MATRIX.T @ Y)
    back = jax.linear_transpose(lambda y: jax.linear_transpose(f, X)(y)[0], Y)
    np.testing.assert_array_equal(jit(back)(X)[0], MATRIX @ X)


def test_matrices_from_both_sides_and_batches_of_what_is_known():
    np.testing.assert_array_equal(jax.jacfwd(f)(X), MATRIX)
    np.testing.assert_array_equal(jax.jacrev(f)(X), MATRIX)
    both = jax.vmap(f, (None, 0))(X, jnp.stack([MATRIX, 2 * MATRIX]))
    np.testing.assert_array_equal(both, [MATRIX @ X, 2 * MATRIX @ X])


def test_derivatives_in_what_is_known_are_refused():
    with pytest.raises(InputError, match="second derivative"):
        jax.grad(lambda matrix: f(X, matrix).sum())(jnp.asarray(MATRIX))
