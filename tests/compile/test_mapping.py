"""`native_map` in its forms, on any number of devices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from pathjax.compile import mapping, native_fold, native_map, native_rows, persistent_loop, together, vectorised
from pathjax.compile.jax_compat import ClosedJaxpr, program_of


def collatz(n):
    """Return the steps to 1, by real control flow of a different length for every item."""

    def step(state):
        n, steps = state
        return lax.cond(n % 2 == 0, lambda n: n // 2, lambda n: 3 * n + 1, n), steps + 1

    return lax.while_loop(lambda state: state[0] > 1, step, (n, jnp.int32(0)))[1]


def collatz_by_hand(n):
    steps = 0
    while n > 1:
        n, steps = (n // 2 if n % 2 == 0 else 3 * n + 1), steps + 1
    return steps


MANY = len(jax.local_devices())


@pytest.mark.parametrize("count", [1, 2, 3, 17])
@pytest.mark.parametrize("form", ["loop", "vmap"])
@pytest.mark.parametrize("devices", [1, None])
def test_map_of_any_length_form_and_number_of_devices(count, form, devices):
    mapped = jax.jit(lambda xs: native_map(collatz, xs, form=form, devices=devices))
    xs = jnp.arange(1, count + 1, dtype=jnp.int32)
    np.testing.assert_array_equal(mapped(xs), [collatz_by_hand(n) for n in range(1, count + 1)])


@pytest.mark.parametrize("form", ["loop", "vmap"])
def test_map_over_trees_with_shared_trees(form):
    def f(item, table, number):
        (a, b), index = item["pair"], item["index"]
        return {"sum": a + b * number, "picked": (table["rows"][index],)}

    xs = {"pair": (np.arange(5, dtype=np.float32), np.ones(5, np.float32)), "index": np.array([2, 0, 1, 1, 2])}
    table = {"rows": np.arange(12, dtype=np.float32).reshape(3, 4)}
    out = jax.jit(lambda xs, table: native_map(f, xs, table, 3.0, form=form))(xs, table)
    np.testing.assert_array_equal(out["sum"], np.arange(5) + 3)
    np.testing.assert_array_equal(out["picked"][0], table["rows"][xs["index"]])


@pytest.mark.skipif(MANY < 2, reason="needs two devices")
def test_order_is_kept_for_every_number_of_devices():
    xs = np.arange(101, dtype=np.float32)
    for devices in range(1, MANY + 1):
        np.testing.assert_array_equal(native_map(lambda x: 2 * x, xs, devices=devices), 2 * xs)


def test_chunks_of_the_vectorised_form_cover_all_items(monkeypatch):
    """The chunks do not divide the number of items, as on an accelerator."""
    monkeypatch.setattr(vectorised, "MOST_LANES_OF_CPU", 7)
    xs = jnp.arange(1, 101, dtype=jnp.int32)
    np.testing.assert_array_equal(
        native_map(collatz, xs, form="vmap", devices=1), [collatz_by_hand(n) for n in range(1, 101)]
    )


@pytest.mark.parametrize("lanes", [1, 8, 40])
def test_lanes_of_the_vectorised_form_that_are_done_take_other_items(monkeypatch, lanes):
    """Some items end at once. There are hardly more trips than with all lanes busy."""
    monkeypatch.setattr(vectorised, "MOST_LANES_OF_CPU", lanes)
    steps = np.random.default_rng(0).geometric(0.02, 300).astype(np.int32) - 1
    table, made = jnp.arange(5.0), []

    def f(n, table):
        scale = table[n % 5]

        def step(state):
            jax.debug.callback(lambda: made.append(1))
            return state[0] + 1, state[1] + scale

        k, total = persistent_loop(lambda state: state[0] < n, step, (jnp.int32(0), jnp.float32(0)))
        return {"steps": k, "total": total + n}

    found = jax.jit(lambda xs: native_map(f, xs, table, form="vmap", devices=1))(steps)
    np.testing.assert_array_equal(found["steps"], steps)
    np.testing.assert_allclose(found["total"], steps * (1 + steps % 5.0), rtol=1e-6)
    jax.effects_barrier()
    if lanes > 1:
        assert len(made) < 1.15 * steps.sum() / lanes + steps.max()


def test_live_values_are_those_that_something_still_reads():
    def f(x, table):
        y = x + table.sum()
        z = jnp.sin(y)
        return (z * z)[:1]

    program, _ = program_of(f, jnp.zeros(4, jnp.float32), jnp.zeros(1000, jnp.float32))
    # x, y and the operands of y count; a shared table does not.
    of_item = ClosedJaxpr(program.jaxpr.replace(invars=program.jaxpr.invars[::-1]), ())
    assert 32 <= vectorised.live_bytes(of_item, 1) <= 52
    assert vectorised.live_bytes(program, 1) >= 4000


@pytest.mark.parametrize("form", ["lanes", "vmap"])
def test_items_keep_rows_of_their_own(form):
    """In the form for accelerators each item is the only lane."""

    def f(x, number, scale, memory):
        def add(memory, here, values):
            k, row, scale = values

            def one(lane, memory):
                return memory.at[row[lane], k[lane]].add(jnp.where(here[lane], scale[lane], 0))

            return lax.fori_loop(0, len(k), one, memory)

        def step(state):
            k, memory = state
            return k + 1, together(add)(memory, (k, number, scale))

        k, memory = persistent_loop(lambda state: state[0] != x, step, (jnp.int32(0), memory))
        return 2 * k, memory

    xs = np.array([3, 0, 1, 4, 2], np.int32)

    def start(lanes, items, scale):
        return jnp.zeros((items + 1, 4))

    twice, rows = native_rows(f, xs, jnp.float32(0.5), start=start, finish=lambda memory: memory[:-1].T, form=form)
    np.testing.assert_array_equal(twice, 2 * xs)
    np.testing.assert_array_equal(rows.all(), 0.5 * (np.arange(4)[:, None] < xs))
    np.testing.assert_array_equal(rows[2], rows.all()[2])


def test_rows_are_read_of_items_in_any_number_of_parts(monkeypatch):
    """Each device has its own rows, under `jax.vmap` too; `here` moves them to one device."""

    def f(x, number, memory):
        def put(memory, here, numbers):
            def one(lane, memory):
                return memory.at[numbers[lane]].add(jnp.where(here[lane], 1, 0))

            return lax.fori_loop(0, len(numbers), one, memory)

        def step(state):
            k, memory = state
            return k + 1, together(put)(memory, number)

        return persistent_loop(lambda state: state[0] != x, step, (jnp.int32(0), memory))

    def rows(xs, parts):
        monkeypatch.setattr(mapping, "ITEMS_OF_A_PART", -(-len(xs) // parts))
        start = lambda lanes, items: jnp.zeros(items, jnp.int32)  # noqa: E731
        run = lambda xs: native_rows(f, xs, start=start, finish=lambda x: jnp.stack([x, -x]))[1]  # noqa: E731
        return jax.jit(run)(xs), jax.jit(jax.vmap(run))(jnp.stack([xs, xs + 2]))

    xs = jnp.arange(37, dtype=jnp.int32) % 5
    for parts in (1, 2, 4):
        found, pair = rows(xs, parts)
        for one in (found, found.here()):
            np.testing.assert_array_equal(one[1], -xs)
            np.testing.assert_array_equal(one.all(), [xs, -xs])
            assert one.count == 2
        assert len(found.here()[0].devices()) == 1 or parts == 1
        np.testing.assert_array_equal(found.like(found.all()).of_parts[0], found.of_parts[0])
        np.testing.assert_array_equal(pair.here()[1], [-xs, -xs - 2])


def test_map_passes_tangents():
    xs = jnp.linspace(0.1, 1, 7)
    primal, tangent = jax.jvp(lambda s: native_map(lambda x, s: jnp.sin(s * x), xs, s), (2.0,), (1.0,))
    np.testing.assert_allclose(primal, np.sin(2 * xs), rtol=1e-6)
    np.testing.assert_allclose(tangent, xs * np.cos(2 * xs), rtol=1e-6)


def test_lanes_of_the_vectorised_form_share_one_table():
    """A conditional on which lanes differ, inside a loop, must not copy the looked-up table for each lane."""
    lanes, rows = 64, 1000

    def f(x, table):
        def step(i, y):
            return lax.cond(y > 0, lambda: y - table[i], lambda: y + table[2 * i])

        return lax.fori_loop(0, 10, step, x)

    xs, table = jnp.linspace(-1, 1, lanes), jnp.sin(jnp.arange(rows, dtype=jnp.float32))
    program = jax.jit(lambda xs, table: native_map(f, xs, table, form="vmap", devices=1)).lower(xs, table)
    assert f"tensor<{lanes}x{rows}" not in program.as_text()
    assert f"tensor<{rows}xf32>" in program.as_text()
    np.testing.assert_allclose(
        native_map(f, xs, table, form="vmap"), native_map(f, xs, table, form="loop"), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("differing", [False, True])
def test_branches_of_the_vectorised_form(differing):
    """All lanes take one branch, or lanes differ; results have several shapes, one of them without entries."""

    def f(x, which):
        def branch(k):
            return lambda: (jnp.full(2, k) * x, jnp.zeros((0, 3)), jnp.int32(k))

        return lax.switch(which + jnp.int32(x) if differing else which, [branch(k) for k in range(3)])

    xs = jnp.arange(3.0)
    for a, b in zip(*(native_map(f, xs, 0, form=form, devices=1) for form in ("vmap", "loop")), strict=True):
        np.testing.assert_array_equal(a, b)


# ---- items that add to shared memory --------------------------------------------------------------------------------


def histogram(steps, numbers, table):
    """Add 1 / (k + 1) to the entry `numbers[k % 5]` after each step k of an item."""

    def add(table, here, values):
        k, number = values

        def one(lane, table):
            return table.at[number[lane]].add(jnp.where(here[lane], 1 / (k[lane] + 1), 0))

        return lax.fori_loop(0, len(k), one, table)

    def step(state):
        k, table = state
        return k + 1, together(add)(table, (k, numbers[k % 5]))

    return persistent_loop(lambda state: state[0] != steps, step, (jnp.int32(0), table))[1]


@pytest.mark.parametrize(("count", "form"), [(3, "lanes"), (1500, "lanes"), (1500, "vmap")])
def test_items_share_memory(monkeypatch, count, form):
    """Results are bitwise the same on every number of devices; lanes without an item add nothing."""
    monkeypatch.setattr(mapping, "ITEMS_OF_A_PART", 400)
    numbers = np.array([0, 3, 3, 1, 2], np.int32)
    steps = np.random.default_rng(0).integers(0, 9, count).astype(np.int32)
    expected = np.zeros(4)
    for n in steps:
        np.add.at(expected, numbers[np.arange(n) % 5], 1 / (np.arange(n) + 1))

    def fold(devices):
        start = lambda lanes: jnp.zeros(4)  # noqa: E731
        return native_fold(histogram, steps, numbers, start=start, finish=lambda x: x, form=form, devices=devices)

    results = [np.asarray(jax.jit(lambda devices=devices: fold(devices))()) for devices in range(1, MANY + 1)]
    np.testing.assert_allclose(results[0], expected, rtol=1e-5)
    for other in results[1:]:
        np.testing.assert_array_equal(other, results[0])


def test_one_item_alone_is_the_only_lane():
    table = histogram(jnp.int32(3), jnp.array([0, 3, 3, 1, 2], jnp.int32), jnp.zeros(4))
    np.testing.assert_allclose(table, [1, 0, 0, 1 / 2 + 1 / 3])


def test_products_of_the_vectorised_form_are_not_rounded_to_fewer_bits():
    """Accelerators round unless told otherwise; a CPU never does, so the test reads the program."""
    xs, m = jnp.ones((5, 3)), jnp.eye(3)
    program = jax.jit(lambda xs, m: native_map(lambda x, m: m @ x, xs, m, form="vmap", devices=1)).lower(xs, m)
    (product,) = [line for line in program.as_text().splitlines() if "dot_general" in line]
    assert "precision = [HIGHEST, HIGHEST]" in product
