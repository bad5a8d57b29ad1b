"""`lanes` against `jax.vmap`: the same results for programs of every structure that occurs in kernels."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from pathjax.compile import basis, compute_once, one_by_one, persistent_loop, unset
from pathjax.compile.lanes import lanes, runs

WIDTH = 5
TABLE = np.arange(24, dtype=np.float32).reshape(4, 2, 3) ** 1.5


def agrees(f, *xs, shared=(TABLE,), width=WIDTH):
    xs = tuple(map(jnp.asarray, xs))

    def of(x, *shared):
        return f(*x, *shared)

    shared = tuple(map(jnp.asarray, shared))
    expected = jax.jit(jax.vmap(of, in_axes=(0, *(None for _ in shared))))(xs, *shared)
    found = jax.jit(lanes(of, width))(xs, *shared)
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


def test_branches_of_much_work_are_run_for_the_lanes_that_take_them():
    """In runs of `runs.WIDTH` lanes: most lanes take one branch, few take another, and none takes the third."""

    def much(scale, n):
        def work(x, k, table):
            for _ in range(70):
                x = x * scale + table[0, 0]
            return lax.fori_loop(0, k if n else 2, lambda _, y: y * 0.9 + 1, x), k + n, x[0] > 0

        return work

    def f(x, k, table):
        branches = [much(0.5, 0), much(0.3, 1), lambda x, k, table: (much(0.7, 2)(x, k, table)[0], k, k > 2)]
        made = jax.make_jaxpr(lambda: lax.switch(k, branches, x, k, table))()
        used.append(runs.pays(width, next(e for e in made.eqns if e.primitive.name == "cond").params["branches"]))
        both = lax.cond(x[0] > 0.3, lambda: lax.switch(k, branches, x, k, table), lambda: (x, k, x[1] > 0))
        return lax.switch(k, branches, x, k, table), both

    width, count, used = 3 * runs.WIDTH + 5, 450, []
    rng = np.random.default_rng(0)
    x, k = rng.normal(size=(count, 3)).astype(np.float32), rng.choice(3, count, p=[0.95, 0, 0.05])
    agrees(f, x, k.astype(np.int32), width=width)
    assert all(used)


def test_loops_run_until_their_last_lane_is_done(rows):
    def collatz(n, table):
        def step(state):
            n, steps, path = state
            return jnp.where(n % 2 == 0, n // 2, 3 * n + 1), steps + 1, path + n

        return lax.while_loop(lambda s: s[0] != 1, step, (n + 2, jnp.int32(0), jnp.float32(0)))

    agrees(collatz, rows)
    agrees(lambda n, table: collatz(n, table)[1], rows)


@pytest.mark.parametrize("kept", [0, 1, 2])
def test_a_lane_that_is_done_stays_so_where_the_test_is_a_carried_value_itself(rows, kept):
    """If its carry were updated further, it would start again: the test is false at one trip in 7 only."""

    def f(n, table):
        def step(state):
            _, k, total = state
            return (k * 3 + n) % 7 != 0, k + 1, total + k

        return lax.while_loop(lambda state: state[0], step, (n >= 0, n, jnp.int32(0)))[kept]

    agrees(f, rows)


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
    """Half of the items enter the branch; a third of those make one trip of its loop."""
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
    """Only lanes in the branch compute the step; in the others it is 0, with which their loop would never end."""

    def f(n, table):
        step = one_by_one(lambda: 1 + n * n)
        return lax.cond(n > 2, lambda: lax.while_loop(lambda x: x < 50, lambda x: x + step(), n), lambda: n)

    agrees(f, np.arange(2 * WIDTH, dtype=np.int32))


def test_values_computed_once_and_calls(vectors):
    def f(a, b, table):
        a, table = compute_once((a, table))
        return jax.jit(lambda x: x + table[0, 0])(a), jax.nn.relu(b), jnp.hypot(a, b)

    agrees(f, *vectors)


def test_a_value_computed_once_is_not_computed_again():
    """Otherwise XLA computes it again for each consumer. The barrier that prevents this copies no column."""

    def f(how, x):
        y = how(lax.population_count(x))
        return lax.fori_loop(0, 2, lambda i, s: (s[1] + y, s[2] ^ y, s[0] * y), (y + 1, y * 3, y ^ 5))

    def compiled(how):
        items = jnp.arange(640, dtype=jnp.int32)
        return jax.jit(lanes(lambda x: f(how, x), 64)).lower(items).compile().as_text()

    once, again = compiled(compute_once), compiled(lambda y: y)
    assert once.count(" popcnt(") == 1
    assert again.count(" popcnt(") > 1
    assert once.count(" copy(") == again.count(" copy(")


def tangents_of(f, tangents):
    """Return a function of (a, b, table): f and its derivatives in the entries of f's first argument, at 0."""

    def of(a, b, table):
        def push(t):
            return jax.jvp(lambda x: f(x, a, b, table), (jnp.zeros(len(t)),), (t,))

        return jax.vmap(push, out_axes=(None, 0))(tangents(4))

    return of


def test_derivatives_of_several_numbers_at_once(vectors):
    """Through branches, loops, calls, tables and matrix products, some of which do not depend on a given scalar."""

    def f(x, a, b, table):
        branch = lax.cond(a[0] > 0, lambda x: x[0] * b + x[1], lambda x: jnp.exp(x[2] * a), x)
        loop = lax.fori_loop(0, 3, lambda i, y: y * 0.5 + x[i % 2], branch[0])
        picked = table[jnp.int32(a[1] > 0), 0] * x[3] + x[jnp.int32(b[0] > 0)]
        product = jnp.stack([x[0] * a[0], x[1], a[2] - x[3] / b[1]]) @ table[0].T
        return branch, loop, compute_once(picked), product, jnp.where(b > 0, a, x[:3]).sum(), jax.jit(jnp.sum)(x * a[0])

    agrees(tangents_of(f, lambda n: basis(n, jnp.float32)), *vectors)


def test_what_does_not_depend_on_a_number_costs_its_tangent_nothing(vectors):
    """Each of these functions depends on one scalar, so the four tangents cost as much as one."""

    def f(x, a, b, table):
        return [jnp.sin(a * x[k] + b) * jnp.exp(a * (b + k)) for k in range(4)]

    def products(tangents):
        of = tangents_of(f, tangents)
        program = jax.make_jaxpr(lanes(lambda x, table: of(*x, table), WIDTH))(tuple(vectors), TABLE)
        return str(program).count(" = mul ")

    # Each tangent costs three products (with a, the cosine and the exponential) of 3 components.
    assert products(jnp.eye) - products(lambda n: basis(n, jnp.float32)) == 3 * 4 * 3 * 3


def test_no_tracer_outlives_its_function(vectors):
    def f(a, table):
        def step(state):
            k, x = state
            return k + 1, compute_once(x * a)

        return lax.while_loop(lambda s: s[0] < 3, step, (0, compute_once(a + 1)))[1]

    with jax.checking_leaks():
        agrees(f, vectors[0])


def test_arithmetic_of_every_kind(vectors):
    def f(a, table):
        positive, whole = jnp.abs(a) + 0.5, (10 * a).astype(jnp.int32)
        of_any = (jnp.sin, jnp.tanh, jnp.exp, jnp.expm1, jnp.floor, jnp.round, jnp.sign, lax.logistic)
        of_positive = (jnp.sqrt, lax.rsqrt, jnp.cbrt, jnp.log1p, lax.lgamma, lax.digamma, lax.erf)
        of_two = (jnp.arctan2, jnp.power, lax.rem, lax.nextafter, jnp.maximum, jnp.less_equal)
        reals = (
            [g(a) for g in of_any],
            [g(positive) for g in of_positive],
            [g(positive, a) for g in of_two],
            (a**3, lax.erf_inv(a / 9), lax.igamma(positive, positive), a.astype(jnp.int8), jnp.isfinite(a)),
            (lax.clamp(a[0], a, positive), lax.clamp(jnp.float32(0), a, jnp.float32(1))),
        )
        integers = (
            (lax.population_count(whole), lax.clz(whole), ~whole, lax.bitcast_convert_type(a, jnp.int32)),
            (whole & 3, whole ^ 5, whole << 2, whole >> 1, lax.shift_right_logical(whole, 3)),
        )
        return reals, integers

    agrees(f, vectors[0])


def twice_product(x, y):
    return 2 * x * y


# Not componentwise, although some results have the shape of their operand.
OTHERS = {
    "sort": jnp.sort,
    "argsort": jnp.argsort,
    "sort of pairs": lambda a: lax.sort((a, -a), num_keys=1),
    "top_k": lambda a: lax.top_k(a, 2),
    "cumsum": jnp.cumsum,
    "cumprod": jnp.cumprod,
    "cummax": lax.cummax,
    "cumlogsumexp": lax.cumlogsumexp,
    "argmin": jnp.argmin,
    "prod": jnp.prod,
    "reduce of any kind": lambda a: lax.reduce(a, np.float32(0), lambda x, y: x + 2 * y, (0,)),
    "reduce_precision": lambda a: lax.reduce_precision(a, 5, 4),
    "reduce_window": lambda a: lax.reduce_window(a, np.float32(0), lax.add, (2,), (1,), "SAME"),
    "reduce_window of any kind": lambda a: lax.reduce_window(a, np.float32(1), twice_product, (2,), (1,), "SAME"),
    "conv": lambda a: jnp.convolve(a, jnp.array([1.0, 2.0, 3.0]), mode="same"),
    "fft": lambda a: jnp.abs(jnp.fft.fft(a)),
    "rfft": lambda a: jnp.fft.rfft(a).real,
    "fft of complex numbers": lambda a: jnp.fft.ifft(jnp.fft.fft(a)).imag,
    "cholesky": lambda a: jnp.linalg.cholesky(jnp.outer(a, a) + 9 * jnp.eye(3)),
    "triangular_solve": lambda a: jax.scipy.linalg.solve_triangular(jnp.tril(jnp.outer(a, a)) + 9 * jnp.eye(3), a),
    "scatter": lambda a: a.at[(3 * a).astype(jnp.int32) % 3].set(7.0),
    "scatter-add": lambda a: a.at[jnp.array([0, 0, 1])].add(a),
    "gather": lambda a: a[(3 * a).astype(jnp.int32) % 3],
    "pad": lambda a: jnp.pad(a, 1, constant_values=2.0),
    "batched products": lambda a: jnp.einsum("ij,ijk->ik", jnp.outer(a, a), jnp.ones((3, 3, 3))),
    "narrower numbers": lambda a: lax.bitcast_convert_type(a, jnp.uint8),
    "wider numbers": lambda a: lax.bitcast_convert_type(lax.bitcast_convert_type(a, jnp.uint8), jnp.float32),
    "random bits": lambda a: jax.random.uniform(jax.random.key(lax.bitcast_convert_type(a[0], jnp.int32)), (3,)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_component_by_component_is_left_to_vmap(vectors, name):
    agrees(lambda a, table: OTHERS[name](a), vectors[0])


def test_functions_with_rules_of_their_own_are_called(vectors):
    @jax.custom_jvp
    def doubled(x):
        return 2 * x

    @jax.custom_vjp
    def tripled(x):
        return 3 * x

    doubled.defjvp(lambda primals, tangents: (doubled(*primals), 5 * tangents[0]))
    tripled.defvjp(lambda x: (3 * x, None), lambda _, ct: (7 * ct,))
    agrees(lambda a, table: (doubled(a), tripled(a), jax.checkpoint(jnp.sin)(a)), vectors[0])
    agrees(lambda a, table: (jax.jvp(doubled, (a,), (a,)), jax.grad(lambda x: tripled(x).sum())(a)), vectors[0])


def test_derivatives_are_taken_before(vectors):
    def f(a, b, table):
        def loss(x):
            return lax.while_loop(lambda s: jnp.sum(s * s) < 9, lambda s: s * x, jnp.abs(x) + 1.5)

        return jax.vmap(lambda t: jax.jvp(loss, (jnp.abs(a) + 1,), (t,))[1])(jnp.eye(3))

    agrees(f, *vectors)


def test_numbers_of_lanes_that_are_done_do_no_harm():
    """A lane whose state overflows after its end must neither stop the other lanes nor hang the loop."""

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
    """Items of 0 to 39 trips, with work before and after the loop; one result is shared by all items, one is empty."""

    def f(n, start, table):
        row = lax.dynamic_index_in_dim(table, n % 4, keepdims=False)[0] + start

        def step(state):
            k, x, path = state
            return k + 1, x * 0.9 + row, path.at[k % 3].add(x[0])

        k, x, path = persistent_loop(lambda s: s[0] < n, step, (jnp.int32(0), row, jnp.zeros(3)))
        return k, {"x": x - start, "path": path, "table": table[0], "none": jnp.zeros((0, 3))}

    rng = np.random.default_rng(count)
    trips = rng.integers(0, 40, count).astype(np.int32) * rng.integers(0, 2, count).astype(np.int32)
    agrees(f, trips, rng.normal(size=(count, 3)).astype(np.float32))


def test_what_a_persistent_loop_begins_with_unset_is_not_written():
    """The lane still holds the last item's value, which is not read: the item's loop stores before it reads."""

    def f(n, start, table):
        def step(state):
            k, kept = state
            return k + 1, jnp.where(k == 0, start, kept) * 1.5

        return persistent_loop(lambda s: s[0] < n, step, (jnp.int32(0), unset(jnp.zeros(3))))

    rng = np.random.default_rng(3)
    trips = rng.integers(1, 9, 4 * WIDTH + 3).astype(np.int32)
    agrees(f, trips, rng.normal(size=(len(trips), 3)).astype(np.float32))

    # A body that does read it, in a single lane, counts the trips of all items.
    def trips_so_far(n):
        first = jnp.int32(0), unset(jnp.int32(0))
        return persistent_loop(lambda s: s[0] < n, lambda s: (s[0] + 1, s[1] + 1), first)[1]

    np.testing.assert_array_equal(jax.jit(lanes(trips_so_far, 1))(jnp.array([2, 3, 1])), [2, 5, 6])


def test_a_loop_before_the_persistent_one_runs_when_an_item_begins():
    def f(n, table):
        first = lax.while_loop(lambda s: s[0] < n, lambda s: (s[0] + 1, s[1] + s[0]), (jnp.int32(0), jnp.int32(0)))
        return persistent_loop(lambda s: s[0] < first[1], lambda s: (s[0] + 2, s[1] + n), (jnp.int32(0), jnp.int32(1)))

    agrees(f, np.random.default_rng(1).integers(0, 9, 23).astype(np.int32))


def test_a_persistent_loop_that_is_left_together_or_within_others_is_an_ordinary_one():
    def count(n):
        return persistent_loop(lambda k: k < n, lambda k: k + 1, jnp.int32(0))

    trips = np.random.default_rng(2).integers(0, 9, 13).astype(np.int32)
    agrees(lambda n, table: count(jnp.int32(table[0, 0, 2])) + n, trips)
    agrees(lambda n, table: lax.map(count, jnp.stack([n, n + 1])), trips)
    agrees(lambda n, table: lax.cond(n > 4, count, lambda n: -n, n), trips)


def test_two_persistent_loops_are_refused():
    def count(n):
        return persistent_loop(lambda k: k < n, lambda k: k + 1, jnp.int32(0))

    with pytest.raises(ValueError, match="one persistent_loop"):
        lanes(lambda n: count(count(n)), WIDTH)(jnp.arange(3))


def test_derivatives_of_a_persistent_loop():
    """Derivatives in some of the carried values, several at once; lanes leave the loop by the primal values."""

    def f(n, x, table):
        def power(x):
            return persistent_loop(lambda s: s[0] < n, lambda s: (s[0] + 1, s[1] * x), (jnp.int32(0), jnp.ones(3)))[1]

        return jax.vmap(lambda t: jax.jvp(power, (x,), (t,)))(jnp.eye(3))

    rng = np.random.default_rng(3)
    agrees(f, rng.integers(0, 9, 23).astype(np.int32), rng.normal(size=(23, 3)).astype(np.float32))


@pytest.mark.parametrize("width", [1, 5, 32, 33, 64, 100])
@pytest.mark.parametrize("count", [0, 1, 64, 300])
def test_any_number_of_items_in_any_number_of_lanes(count, width):
    trips = jnp.asarray(np.random.default_rng(count).integers(0, 9, count, np.int32))
    found = jax.jit(lanes(lambda n: persistent_loop(lambda k: k < n, lambda k: k + 1, jnp.int32(0)), width))(trips)
    np.testing.assert_array_equal(found, trips)


def test_items_are_worked_on_without_waiting_for_the_slowest():
    """Lanes take the next item instead of waiting for the longest item of their group."""
    trips = np.ones(64 * WIDTH, np.int32)
    trips[::WIDTH] = 100  # one in every group
    seen = []

    def count(_):
        seen.append(1)
        return np.int32(0)

    def f(n, table):
        def step(k):
            return k + 1 + one_by_one(lambda: jax.pure_callback(count, jax.ShapeDtypeStruct((), jnp.int32), k))()

        return persistent_loop(lambda k: k < n, step, jnp.int32(0))

    np.testing.assert_array_equal(lanes(f, WIDTH)(jnp.asarray(trips), jnp.asarray(TABLE)), trips)
    ideal = trips.sum()  # one call per lane and trip, if lanes never wait
    assert ideal <= len(seen) < 1.2 * ideal + 100 * WIDTH


def test_what_lanes_make_of_an_equation_stands_where_it_stands(vectors):
    """Profiles, dumps and errors name the code of one item, not the interpreter alone."""

    def tripled(v):
        return 3 * v

    assert "tripled" in jax.jit(lanes(tripled, WIDTH)).lower(vectors).as_text(debug_info=True)
