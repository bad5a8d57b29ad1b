"""Primitives for lanes (`compute_once`, `one_by_one`, ...) under JAX's transformations, outside and inside lanes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from pathjax.compile import Search, compute_once, interleaved, one_by_one, persistent_loop
from pathjax.compile.lanes import lanes


def once(x, n):
    x, n = compute_once((x, n))
    return x * x[::-1] * n


@one_by_one
def search(x, n):
    """Nowhere linear in x; the loop has a fixed length, so that every kind of derivative exists."""
    return {"y": lax.fori_loop(0, 3, lambda i, y: y * x + n, jnp.sin(x)), "n": n + 1}


def plain(x, n):
    return {"y": lax.fori_loop(0, 3, lambda i, y: y * x + n, jnp.sin(x)), "n": n + 1}


PAIRS = {"compute_once": (once, lambda x, n: x * x[::-1] * n), "one_by_one": (search, plain)}
X, N = jnp.array([0.3, -1.2, 2.0]), jnp.int32(2)


@pytest.fixture(params=PAIRS)
def pair(request):
    """The function with the primitive, and the same function without it."""
    return PAIRS[request.param]


def same(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), found, expected)
    jax.tree.map(lambda a, b: np.testing.assert_equal(np.asarray(a).dtype, np.asarray(b).dtype), found, expected)


def of_x(f):
    """Return f's floating-point result as a function of x."""

    def result(x):
        y = f(x, N)
        return y["y"] if isinstance(y, dict) else y

    return result


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_values(pair, transform):
    said, plain = pair
    same(transform(said)(X, N), jax.jit(plain)(X, N))


@pytest.mark.parametrize("axes", [(0, None), (None, 0), (0, 0)])
def test_vmap(pair, axes):
    said, plain = pair
    xs = X * jnp.arange(1.0, 5)[:, None] if axes[0] == 0 else X
    ns = jnp.arange(4, dtype=jnp.int32) if axes[1] == 0 else N
    same(jax.jit(jax.vmap(said, axes))(xs, ns), jax.jit(jax.vmap(plain, axes))(xs, ns))


def test_forward_derivatives(pair):
    same(*(jax.jit(lambda x, f=f: jax.jvp(f, (x,), (x + 1,)))(X) for f in map(of_x, pair)))
    same(*(jax.jit(jax.jacfwd(f))(X) for f in map(of_x, pair)))


def test_reverse_derivatives(pair):
    same(*(jax.jit(jax.jacrev(f))(X) for f in map(of_x, pair)))
    same(*(jax.jit(lambda x, f=f: jax.jvp(jax.jacrev(f), (x,), (x,)))(X) for f in map(of_x, pair)))


def test_derivatives_within_lanes(pair):
    xs = jnp.asarray(np.random.default_rng(0).normal(size=(7, 3)), jnp.float32)
    said, plain = (lambda x, f=f: (jax.jacfwd(f)(x), jax.jacrev(f)(x)) for f in map(of_x, pair))
    same(jax.jit(lanes(said, 4))(xs), jax.jit(jax.vmap(plain))(xs))


def test_what_has_no_tangent_gets_none():
    """Otherwise derivative kernels would carry zeros along."""
    program = jax.make_jaxpr(lambda t: jax.jvp(lambda x: compute_once((x, X))[0], (X,), (t,)))(X)
    tangents = [e for e in program.eqns if e.primitive.name == "compute_once"][-1]
    assert len(tangents.invars) == 1


def test_a_value_computed_once_is_an_optimization_barrier_outside_of_lanes():
    assert "optimization_barrier" in jax.jit(once).lower(X, N).as_text()


def test_values_computed_once_may_be_any_tree():
    assert compute_once(()) == () and compute_once({"a": None}) == {"a": None}
    np.testing.assert_array_equal(compute_once([np.ones(2), 3])[1], 3)


def test_a_search_may_close_over_what_is_traced():
    def f(x, table):
        return one_by_one(lambda k: table[k] * x)(jnp.int32(1)) + one_by_one(lambda: x + 1)()

    np.testing.assert_allclose(jax.jit(f)(2.0, X), 2 * X[1] + 3)
    np.testing.assert_allclose(jax.vmap(f, (0, None))(X, X), X[1] * X + X + 1, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(f)(2.0, X), X[1] + 1)


def test_a_persistent_loop_is_a_loop():
    def power(loop):
        return lambda x, n: loop(lambda s: s[0] < n, lambda s: (s[0] + 1, s[1] * x), (jnp.int32(0), x))[1]

    said, plain = power(persistent_loop), power(lax.while_loop)
    same(said(X, N), plain(X, N))
    ns = jnp.arange(4, dtype=jnp.int32)
    same(*(jax.jit(jax.vmap(f, (None, 0)))(X, ns) for f in (said, plain)))
    same(*(jax.jit(jax.jacfwd(f))(X, N) for f in (said, plain)))


def collatz(n, scale):
    """Return the scaled number of steps from n > 0 to 1: a search of scalars, of any length. Visits are steps up."""

    def begin():
        return 2 * n, jnp.int32(-1)

    def goes_on(odd):
        return lambda state: (state[0] > 1) & (state[0] % 2 == odd)

    def halve(state):
        return state[0] // 2, state[1] + 1

    def rise(state):
        return 3 * state[0] + 1, state[1] + 1

    return interleaved(Search(begin, goes_on(0), halve, goes_on(1), rise, lambda state: {"steps": state[1] * scale}))


def collatz_steps(n):
    return 0 if n == 1 else 1 + collatz_steps(3 * n + 1 if n % 2 else n // 2)


NUMBERS = np.arange(1, 60, dtype=np.int32)
STEPS = np.array(list(map(collatz_steps, NUMBERS)), np.float32)


@pytest.mark.parametrize("width", [2, 8, 64])
def test_interleaved_searches_of_lanes_end_each_with_its_own_result(width):
    """With fewer lanes than slots, and with more."""
    found = jax.jit(lanes(lambda n, scale: collatz(n, scale)["steps"], width))(NUMBERS, 0.5)
    np.testing.assert_array_equal(found, STEPS / 2)


def test_a_search_may_hold_numbers_of_any_type_and_arrays():
    """Base-3 digits of n with alternating signs: the last two, and which digits occur."""

    def digits(n):
        sign = jnp.where(n % 2 == 1, jnp.float32(1), -1)

        def begin():
            return n, jnp.uint32(0), sign, n < 0, jnp.zeros((2,), jnp.float32), jnp.zeros((1, 3), jnp.int8)

        def third(state):
            n, steps, sign, odd, last, seen = state
            last = jnp.stack([last[1], sign * (n % 3)])
            return n // 3, steps + 1, -sign, ~odd, last, seen.at[0, n % 3].set(1)

        def goes_on(odd):
            return lambda state: (state[0] > 0) & (state[3] == odd)

        return interleaved(Search(begin, goes_on(False), third, goes_on(True), third, lambda state: state[1:]))

    steps, sign, odd, last, seen = jax.jit(lanes(digits, 8))(NUMBERS)
    for k, n in enumerate(NUMBERS):
        found = [int(digit) for digit in np.base_repr(n, 3)]
        assert steps[k] == len(found) and odd[k] == len(found) % 2
        first = 1 if n % 2 else -1
        signed = [digit * first * (-1) ** place for place, digit in enumerate(found[::-1])]
        assert sign[k] == first * (-1) ** len(found)
        np.testing.assert_array_equal(last[k], ([0] + signed)[-2:])
        np.testing.assert_array_equal(seen[k, 0], [digit in found for digit in range(3)])


def test_interleaved_searches_run_for_active_lanes_alone():
    def some(n):
        return lax.cond(n % 3 == 0, lambda: collatz(n, n.astype(jnp.float32))["steps"], lambda: jnp.float32(-1))

    found = jax.jit(lanes(some, 16))(NUMBERS)
    np.testing.assert_array_equal(found, np.where(NUMBERS % 3 == 0, STEPS * NUMBERS, -1))


@pytest.mark.parametrize("of", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_an_interleaved_search_alone(of):
    for n, steps in zip(NUMBERS[:7:2], STEPS[:7:2], strict=True):
        assert of(collatz)(jnp.int32(n), 2.0)["steps"] == 2 * steps


def test_interleaved_searches_under_vmap_and_forward_derivatives():
    found = jax.jit(jax.vmap(collatz, (0, None)))(NUMBERS, 3.0)["steps"]
    np.testing.assert_array_equal(found, 3 * STEPS)

    def derivative(n):
        return jax.jacfwd(lambda scale: collatz(n, scale)["steps"])(2.0)

    np.testing.assert_array_equal(jax.jit(lanes(derivative, 8))(NUMBERS), STEPS)
