"""`lanes` against `jax.vmap`: the same results from programs of every structure that kernels are made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from pathjax.compile.lanes import lanes, one_by_one

WIDTH = 5
TABLE = np.arange(24, dtype=np.float32).reshape(4, 2, 3) ** 1.5


def agrees(f, *xs, shared=(TABLE,)):
    xs = tuple(map(jnp.asarray, xs))

    def of(x, *shared):
        return f(*x, *shared)

    shared = tuple(map(jnp.asarray, shared))
    expected = jax.vmap(of, in_axes=(0, *(None for _ in shared)))(xs, *shared)
    found = jax.jit(lanes(of, WIDTH))(xs, *shared)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, expected)
    jax.tree.map(lambda a, b: np.testing.assert_equal(a.dtype, b.dtype), found, expected)


@pytest.fixture
def vectors():
    return np.random.default_rng(0).normal(size=(2, WIDTH, 3)).astype(np.float32)


@pytest.fixture
def rows():
    return np.array([0, 3, 1, 2, 3], np.int32)


def test_arithmetic_and_structure(vectors):
    def f(a, b, table):
        c = jnp.stack([a[1], b[2], a[0] * b[0]])
        c = jnp.concatenate([c, a[::-1], jnp.zeros(2)]).reshape(2, 4).T
        return c.sum(0), jnp.where(a > 0, a, b), jnp.max(c), jnp.clip(a, -0.5, 0.5), jnp.copysign(a, b), table[0, 1] @ a

    agrees(f, *vectors)


def test_matrices(vectors):
    def f(a, b, table):
        m = jnp.outer(a, b)
        return m @ a, a @ b, m.T @ m, jnp.trace(m)

    agrees(f, *vectors)


def test_what_lanes_share_stays_shared(vectors):
    agrees(lambda a, table: (table.sum(), jnp.float32(2), jnp.zeros((0, 3))), vectors[0])


def test_rows_of_a_shared_table(rows):
    def f(row, table):
        block = lax.dynamic_slice(table, (row, 0, 0), (1, 2, 3))[0]
        pair = lax.dynamic_slice(table, (row, row % 2, row), (2, 1, 2))
        return block, table[row], pair, table[0, row % 2]

    agrees(f, rows)


def test_rows_outside_of_a_table_are_clamped_as_slices_are():
    rows = np.array([-7, 0, 3, 4, 2**30], np.int32)
    agrees(lambda row, table: lax.dynamic_slice(table, (row, 0, 0), (1, 2, 3), allow_negative_indices=False), rows)


def test_rows_of_lanes_own_tables(vectors, rows):
    def f(a, row, table):
        own = jnp.stack([a, 2 * a, 3 * a, 4 * a])
        return lax.dynamic_slice(own, (row, row), (2, 1)), lax.dynamic_update_slice(a, row[None] * 1.0, (row % 3,))

    agrees(f, vectors[0], rows)


def test_branches(vectors, rows):
    def f(a, row, table):
        two = lax.cond(a[0] > 0, lambda: (a, jnp.int32(1)), lambda: (jnp.zeros(3), row))
        many = lax.switch(row, [lambda: a, lambda: -a, lambda: table[0, 0], lambda: a * a])
        beyond = lax.switch(row + 7, [lambda: a, lambda: -a])
        shared = lax.cond(table[0, 0, 1] > 0.5, lambda: a * 2, lambda: a)
        return two, many, beyond, shared

    agrees(f, vectors[0], rows)


def test_loops_run_until_their_last_lane_is_done(rows):
    def collatz(n, table):
        def step(state):
            n, steps, path = state
            return jnp.where(n % 2 == 0, n // 2, 3 * n + 1), steps + 1, path + n

        return lax.while_loop(lambda s: s[0] != 1, step, (n + 2, jnp.int32(0), jnp.float32(0)))

    agrees(collatz, rows)
    agrees(lambda n, table: collatz(n, table)[1], rows)


def test_loops_with_a_shared_counter(vectors):
    def f(a, table):
        def add(i, state):
            total, seen = state
            return total + a * lax.dynamic_index_in_dim(table, i, keepdims=False)[1], seen + i

        return lax.fori_loop(0, 4, add, (jnp.zeros(3), jnp.int32(0)))

    agrees(f, vectors[0])


def test_loops_whose_length_lanes_choose(vectors, rows):
    agrees(lambda a, n, table: lax.fori_loop(0, n, lambda i, x: x * 1.5 + i, a), vectors[0], rows)


def test_a_carry_that_becomes_different_in_its_second_trip(vectors):
    def f(a, table):
        return lax.fori_loop(0, 3, lambda i, s: (s[1], s[2], a), (jnp.zeros(3), jnp.ones(3), jnp.ones(3)))

    agrees(f, vectors[0])


def test_scans_over_rows_and_into_rows(vectors):
    def f(a, table):
        def step(total, x):
            total = total + a * x
            return total, (total, x.sum(), jnp.float32(1))

        shared = lax.scan(step, jnp.zeros(3), table[:, 0])
        own = lax.scan(step, jnp.zeros(3), jnp.stack([a, a * 2]), reverse=True)
        return shared, own

    agrees(f, vectors[0])


def test_one_lane_after_another(vectors, rows):
    @one_by_one
    def search(a, n, table):
        return lax.while_loop(lambda x: x[0] < table[n, 0, 0], lambda x: 2 * x + 1, jnp.abs(a))

    agrees(search, vectors[0], rows)


def test_only_lanes_in_a_branch_or_a_loop_have_their_turn():
    """Half of the items enter the branch, a third of those make a trip of the loop in it."""
    seen = []

    def count(k):
        seen.append(int(k))
        return np.int32(1)

    def called(k):
        return one_by_one(lambda: jax.pure_callback(count, jax.ShapeDtypeStruct((), jnp.int32), k))()

    def f(k, table):
        def branch():
            return lax.while_loop(lambda x: x < jnp.where(k % 3 == 0, 1, 0), lambda x: x + called(k), called(k) - 1)

        return lax.cond(k % 2 == 0, branch, lambda: jnp.int32(7))

    items = np.arange(2 * WIDTH, dtype=np.int32)
    result = lanes(f, WIDTH)(jnp.asarray(items), jnp.asarray(TABLE))
    np.testing.assert_array_equal(result, np.where(items % 2, 7, items % 3 == 0))
    assert sorted(seen) == sorted([*range(0, 2 * WIDTH, 2), *range(0, 2 * WIDTH, 6)])


def test_what_other_lanes_lack_keeps_no_loop_from_its_end():
    """A step that only lanes in the branch have; in the others it is 0, with which their loop would not end."""

    def f(n, table):
        step = one_by_one(lambda: 1 + n * n)
        return lax.cond(n > 2, lambda: lax.while_loop(lambda x: x < 50, lambda x: x + step(), n), lambda: n)

    agrees(f, np.arange(2 * WIDTH, dtype=np.int32))


def test_barriers_and_calls(vectors):
    def f(a, b, table):
        a, table = lax.optimization_barrier((a, table))
        return jax.jit(lambda x: x + table[0, 0])(a), jax.nn.relu(b), jnp.hypot(a, b)

    agrees(f, *vectors)


def test_no_tracer_outlives_its_function(vectors):
    def f(a, table):
        def step(state):
            k, x = state
            return k + 1, lax.optimization_barrier(x * a)

        return lax.while_loop(lambda s: s[0] < 3, step, (0, lax.optimization_barrier(a + 1)))[1]

    with jax.checking_leaks():
        agrees(f, vectors[0])


def test_any_other_primitive(vectors, rows):
    def f(a, row, table):
        added = a.at[row].add(1.0, mode="drop")
        return jnp.sort(a), jnp.cumsum(a), jnp.argmin(a), added, jnp.searchsorted(table[:, 0, 0], 3 * a)

    agrees(f, vectors[0], rows)


def test_derivatives_are_taken_before(vectors):
    def f(a, b, table):
        def loss(x):
            return lax.while_loop(lambda s: jnp.sum(s * s) < 9, lambda s: s * x, jnp.abs(x) + 1.5)

        return jax.vmap(lambda t: jax.jvp(loss, (jnp.abs(a) + 1,), (t,))[1])(jnp.eye(3))

    agrees(f, *vectors)


def test_numbers_of_lanes_that_are_done_do_no_harm():
    """A lane whose state overflows after its end must not keep the others from theirs, nor hang the loop."""

    def f(n, table):
        def step(state):
            k, x = state
            return k + 1, x * x * 1e10

        k, x = lax.while_loop(lambda s: s[0] < n, step, (jnp.int32(0), jnp.float32(1)))
        return k

    agrees(f, np.array([0, 1, 2, 3, 50], np.int32))


# ---- more items than lanes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, WIDTH - 1, WIDTH, 4 * WIDTH + 3])
def test_a_lane_that_leaves_the_own_loop_of_an_item_takes_the_next(count):
    """Items of 0 to 40 trips, with work before and after the loop, and results that all share or that are empty."""

    def f(n, start, table):
        row = lax.dynamic_index_in_dim(table, n % 4, keepdims=False)[0] + start

        def step(state):
            k, x, path = state
            return k + 1, x * 0.9 + row, path.at[k % 3].add(x[0])

        k, x, path = lax.while_loop(lambda s: s[0] < n, step, (jnp.int32(0), row, jnp.zeros(3)))
        return k, {"x": x - start, "path": path, "table": table[0], "none": jnp.zeros((0, 3))}

    rng = np.random.default_rng(count)
    trips = rng.integers(0, 40, count).astype(np.int32) * rng.integers(0, 2, count).astype(np.int32)
    agrees(f, trips, rng.normal(size=(count, 3)).astype(np.float32))


def test_the_last_of_two_loops_is_the_own_one():
    def f(n, table):
        first = lax.while_loop(lambda s: s[0] < n, lambda s: (s[0] + 1, s[1] + s[0]), (jnp.int32(0), jnp.int32(0)))
        return lax.while_loop(lambda s: s[0] < first[1], lambda s: (s[0] + 2, s[1] + n), (jnp.int32(0), jnp.int32(1)))

    agrees(f, np.random.default_rng(1).integers(0, 9, 23).astype(np.int32))


@pytest.mark.parametrize("width", [1, 5, 32, 33, 64, 100])
@pytest.mark.parametrize("count", [0, 1, 64, 300])
def test_any_number_of_items_in_any_number_of_lanes(count, width):
    trips = jnp.asarray(np.random.default_rng(count).integers(0, 9, count, np.int32))
    found = jax.jit(lanes(lambda n: lax.while_loop(lambda k: k < n, lambda k: k + 1, jnp.int32(0)), width))(trips)
    np.testing.assert_array_equal(found, trips)


def test_items_are_worked_on_without_waiting_for_the_slowest():
    """Trips of the loop over all items: as many as the longest item takes, not the longest of each group."""
    trips = np.ones(64 * WIDTH, np.int32)
    trips[::WIDTH] = 100  # one in every group
    seen = []

    def count(_):
        seen.append(1)
        return np.int32(0)

    def f(n, table):
        def step(k):
            return k + 1 + one_by_one(lambda: jax.pure_callback(count, jax.ShapeDtypeStruct((), jnp.int32), k))()

        return lax.while_loop(lambda k: k < n, step, jnp.int32(0))

    np.testing.assert_array_equal(lanes(f, WIDTH)(jnp.asarray(trips), jnp.asarray(TABLE)), trips)
    ideal = trips.sum()  # the calls, one for each lane and trip, of lanes that never wait
    assert ideal <= len(seen) < 1.2 * ideal + 100 * WIDTH
