"""Map a function of one item over millions of items: one native loop per device on CPUs, `vectorised` chunks elsewhere.

Where several processes have joined (`distributed`), the devices of all of them are used. Each process holds all items,
computes its share, and gets all results, so that the code before and after is the same program in each.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.sharding import Mesh, PartitionSpec

from pathjax.compile.lanes import lanes
from pathjax.compile.promotion import standard_promotion
from pathjax.compile.rows import Rows
from pathjax.compile.vectorised import most_lanes, vectorised, vectorised_sum
from pathjax.compile.xla import native

# Lanes of a native loop: enough that loops over them vectorise and loop overhead vanishes, few enough that their state
# stays in the nearest caches. Of 64 to 512, 128 was fastest in most scenes of the bench; 256 took up to a tenth longer.
# Fewer lanes for few items, which would leave most of the lanes idle.
_LANES, _FEW_LANES = 128, 64
MANY_ITEMS = 2 * _LANES
# Sums over items: items per part, so that few lanes wait for its last item; and limits on the number of parts, and on
# the bytes of the sums of all parts.
ITEMS_OF_A_PART, MOST_PARTS, MOST_BYTES = 8192, 16, 1 << 26
# On an accelerator the items of a kernel may be cut into parts, so that there are several for each of its lanes.
_ITEMS_OF_A_LANE, _MOST_CUTS = 4, 16


@standard_promotion
def native_map(f: Callable, xs, *shared, form: str | None = None, devices: int | None = None):
    """Return `f(x, *shared)` for every x of `xs`, computed on all devices.

    Under `jax.vmap` each item loops over the batch, within the same kernel.

    Args:
        f: pure function of one item, with real control flow.
        xs: pytree of arrays (N, ...).
        shared: pytrees that every item sees whole.
        form: "lanes" (one native loop per device over groups of items, see `lanes`), "loop" (the same, item by item),
            "vmap" (as many vectorised items as fit into memory), or None: the one that suits the backend. All return
            the same results up to rounding.
        devices: number of devices of this process to use; None: all devices of all processes, which must all call it.
    Returns:
        pytree of arrays (N, ...); bitwise the same for every number of devices.
    """

    @custom_vmap
    def run(xs, *shared):
        return _map(f, xs, shared, form, devices)

    @run.def_vmap
    @standard_promotion
    def run_batch(size, batched, xs, *shared):
        xs_batched, *shared_batched = batched

        def entries(x, *shared):
            def entry(b):
                def pick(leaf, is_batched):
                    return lax.dynamic_index_in_dim(leaf, b, keepdims=False) if is_batched else leaf

                picked = jax.tree.map(pick, (x, *shared), (xs_batched, *shared_batched))
                return f(*picked)

            return lax.map(entry, jnp.arange(size))

        def swap(y):
            return jnp.swapaxes(y, 0, 1)

        xs = jax.tree.map(lambda x, is_batched: swap(x) if is_batched else x, xs, xs_batched)
        ys = jax.tree.map(swap, native_map(entries, xs, *shared, form=form, devices=devices))
        return ys, jax.tree.map(lambda _: True, ys)

    return run(xs, *shared)


@standard_promotion
def native_fold(
    f: Callable, xs, *shared, start: Callable, finish: Callable, form: str | None = None, devices: int | None = None
):
    """Accumulate all items into memory that they share (`together`), on all devices.

    Items are dealt to parts, whose number depends only on the number of items. Each part has its own memory and runs on
    one device, and parts are summed in order: so the sums are bitwise the same for every number of devices.

    Args:
        f: (x, *shared, memory) -> memory, of one item. An item of zeros must leave the memory unchanged.
        xs: pytree of arrays (N, ...), N > 0.
        shared: pytrees that every item sees whole.
        start: number of lanes -> memory before the first item.
        finish: memory after the last item of a part -> pytree of arrays, which are summed over the parts.
        form, devices: as in `native_map`; "vmap" gives each item its own memory, as lanes give each part its own.
    """
    form = _form(form)
    if form == "loop":
        raise ValueError("items that share memory have no form loop; use lanes or vmap")
    sums = jax.eval_shape(lambda: finish(start(_LANES)))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), sums)

    def alone(x, *shared):
        return finish(f(x, *shared, start(1)))

    def part(xs, width, shared):
        if form == "vmap":
            return vectorised_sum(alone, xs, jax.tree.map(jnp.asarray, shared))
        (memory,) = lanes(lambda *args: (f(*args),), width, memory=start(width))(xs, *shared)
        return finish(memory)

    return _by_parts(part, xs, shared, devices, max(1, MOST_BYTES // _bytes(lambda: zeros)), zeros)


@standard_promotion
def native_rows(
    f: Callable, xs, *shared, start: Callable, finish: Callable, form: str | None = None, devices: int | None = None
):
    """Map items that each return a result and write rows of memory of their own, in parts as in `native_fold`.

    `jax.vmap` runs its calls one after another.

    Args:
        f: (x, index of the item in its part, *shared, memory) -> (y, memory).
        start: (number of lanes, number of items, *shared) -> memory before the first item.
        finish: memory after the last item of a part -> array (M, items, ...).
        xs, shared, form, devices: as in `native_fold`.
    Returns:
        y, a pytree of arrays (N, ...), and the M `Rows` of all items: a reader of one scalar per item finds the scalars
        of neighbouring items side by side.
    """
    count = jax.tree.leaves(xs)[0].shape[0]
    form = _form(form)
    if form == "loop":
        raise ValueError("items with rows of memory have no form loop; use lanes or vmap")

    def alone(x, *shared):
        y, memory = f(x, jnp.int32(0), *shared, start(1, 1, *shared))
        return y, finish(memory)[:, 0]

    if form == "vmap":
        ys, rows = native_map(alone, xs, *shared, form=form, devices=devices)
        return ys, Rows((rows.swapaxes(0, 1)[None],), (count, *rows.shape[2:]))

    @custom_vmap
    def run(xs, *shared):
        def part(xs, width, shared):
            items = len(jax.tree.leaves(xs)[0])
            of_part = lanes(lambda x, *args: f(*x, *args), width, memory=start(width, items, *shared))
            ys, memory = of_part((xs, jnp.arange(items, dtype=jnp.int32)), *shared)
            return ys, finish(memory)

        ys, rows = _by_parts(part, xs, shared, devices)
        ys = jax.tree.map(lambda y: y.swapaxes(0, 1).reshape(-1, *y.shape[2:])[:count], ys)
        return ys, Rows((rows,), (count, *rows.shape[3:]))

    @run.def_vmap
    @standard_promotion
    def _(size, batched, *args):
        def one(b):
            def pick(leaf, is_batched):
                return lax.dynamic_index_in_dim(leaf, b, keepdims=False) if is_batched else leaf

            return run(*jax.tree.map(pick, args, tuple(batched)))

        results = lax.map(one, jnp.arange(size))
        return results, jax.tree.map(lambda _: True, results)

    return run(xs, *shared)


def sum_of_parts(f: Callable, xs, *shared, devices: int | None = None):
    """Sum f(x, *shared) over the x of `xs`, each of which is much work, and stack its second results.

    Args:
        f: pytrees of arrays x, *shared -> (pytree to sum, pytree to stack); its kernels use `devices=1`.
        xs: pytree of arrays (parts, ...), dealt to the devices. Parts are summed in order for every number of devices.
        devices: as in `native_map`.
    Returns:
        The sums, a pytree of arrays (...), and the stacked results, a pytree of arrays (parts, ...).
    """
    used = _used(devices)
    xs, shared = jax.tree.map(jnp.asarray, (xs, shared))
    parts = jax.tree.leaves(xs)[0].shape[0]
    rounds = -(-parts // len(used))

    def one(x, *shared):
        return lax.optimization_barrier(f(*lax.optimization_barrier((x, *shared))))

    def add(total, new):
        return jax.tree.map(jnp.add, total, new)

    first, _ = jax.eval_shape(one, jax.tree.map(lambda x: x[0], xs), *shared)
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), first)

    def step(total, x):
        new, kept = one(x, *shared)
        return add(total, new), kept

    if len(used) == 1:
        return lax.scan(step, zeros, xs)

    def deal(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[:1], (rounds * len(used) - parts, *x.shape[1:]))])
        return x.reshape(rounds, len(used), *x.shape[1:]).swapaxes(0, 1)

    def on_one_device(xs, *shared):
        return lax.map(lambda x: one(x, *shared), xs)

    results = _dealt(on_one_device, used, jax.tree.map(deal, xs), shared)
    found, kept = jax.tree.map(lambda x: x.swapaxes(0, 1).reshape(-1, *x.shape[2:])[:parts], results)
    return lax.scan(lambda total, new: (add(total, new), None), zeros, found)[0], kept


def _by_parts(part: Callable, xs, shared, devices: int | None, most: int = MOST_PARTS, total=None):
    """Run part(items, lanes, shared) for all parts, and add the results to the total in order: pytree of arrays.

    Item i belongs to part i % parts. Each device runs some parts; their number depends only on the number of items.

    Args:
        total: pytree of arrays; None: nothing is summed, and the results are stacked, (parts, ...).
    """
    count = jax.tree.leaves(xs)[0].shape[0]
    used = _used(devices)
    # A power of 2, which most numbers of devices share evenly.
    parts = 1 << (min(MOST_PARTS, -(-count // ITEMS_OF_A_PART), most).bit_length() - 1)
    rounds = -(-parts // len(used))
    each = -(-count // parts)
    width = _LANES if each >= MANY_ITEMS else _FEW_LANES

    def deal(x):
        """(N, ...) -> (devices, rounds, items, ...)"""
        x = jnp.pad(x, [(0, each * parts - count), *[(0, 0)] * (x.ndim - 1)])
        x = x.reshape(each, parts, *x.shape[1:]).swapaxes(0, 1)
        x = jnp.pad(x, [(0, rounds * len(used) - parts), *[(0, 0)] * (x.ndim - 1)])
        return x.reshape(rounds, len(used), *x.shape[1:]).swapaxes(0, 1)

    def on_one_device(xs, *shared):
        return lax.map(lambda xs: part(xs, width, shared), xs)

    xs = jax.tree.map(deal, xs)
    if total is None:
        results = _dealt(on_one_device, used, xs, shared)
        return jax.tree.map(lambda x: x.swapaxes(0, 1).reshape(-1, *x.shape[2:])[:parts], results)

    def shares(x):
        """Return, for each part of one round in order, the share of its scalars that this device sums."""
        share = -(-x.size // len(used))
        x = jnp.pad(x.ravel(), (0, share * len(used) - x.size)).reshape(len(used), share)
        return x if len(used) == 1 else lax.all_to_all(x, "device", 0, 0)

    def share_of_sum(xs, *shared):
        """Add up the parts of each round at once: keeping all parts until the end would take far more memory."""

        def step(totals, xs):
            found = jax.tree.map(shares, part(xs, width, shared))
            return jax.tree.map(lambda total, new: reduce(jnp.add, list(new), total), totals, found), None

        zeros = jax.tree.map(lambda x: jnp.zeros((-(-x.size // len(used)),), x.dtype), total)
        return lax.scan(step, zeros, xs)[0]

    sums = _dealt(share_of_sum, used, xs, shared)
    return jax.tree.map(lambda zero, x: x.reshape(-1)[: zero.size].reshape(zero.shape), total, sums)


def parts_per_item(count: int, form: str | None = None) -> int:
    """Return the number of parts to cut each of `count` items into: a lane of an accelerator needs several items."""
    return 1 if _form(form) != "vmap" else min(-(-_ITEMS_OF_A_LANE * most_lanes() // max(count, 1)), _MOST_CUTS)


def _form(form: str | None) -> str:
    return form or ("lanes" if native() else "vmap")


def _bytes(made: Callable) -> int:
    """Return the bytes of the arrays that a function returns."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(made)))


def _used(devices: int | None) -> list[jax.Device]:
    return jax.devices() if devices is None else jax.local_devices()[:devices]


def _dealt(f: Callable, used: list[jax.Device], xs, shared):
    """Run f(x, *shared) on each device, with its row x of xs. xs and results are pytrees of arrays (devices, ...)."""
    if len(used) == 1:
        return jax.tree.map(lambda y: y[None], f(jax.tree.map(lambda x: x[0], xs), *shared))
    # Across processes, results are gathered to each: a process that held only its part of an array could use the array
    # only in operations that all processes run at the same time.
    alone = all(device.process_index == jax.process_index() for device in used)

    def on_one_device(xs, *shared):
        mine = 0 if alone else lax.axis_index("device")
        results = f(jax.tree.map(lambda x: x[mine], xs), *shared)
        return jax.tree.map(lambda y: y[None] if alone else lax.all_gather(y, "device"), results)

    rows = PartitionSpec("device") if alone else PartitionSpec()
    mapped = jax.shard_map(
        on_one_device,
        mesh=Mesh(np.array(used), ("device",)),
        in_specs=(rows, *(PartitionSpec() for _ in shared)),
        out_specs=rows,
        check_vma=False,
    )
    return mapped(xs, *shared)


def _map(f, xs, shared, form, devices):
    count = jax.tree.leaves(xs)[0].shape[0]
    form = _form(form)
    used = _used(devices)
    each = -(-count // len(used))
    run = {
        # By the items of all devices, so that the number of devices does not change the program.
        "lanes": partial(_lanes, width=_LANES if count >= MANY_ITEMS else _FEW_LANES),
        "loop": _loop,
        "vmap": vectorised,
    }[form]
    if len(used) == 1:
        return run(f, xs, shared)

    # Device i takes items i, i + D, i + 2 D, ...: each gets its share of the expensive part of an image.
    def deal(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[:1], (each * len(used) - count, *x.shape[1:]))])
        return x.reshape(each, len(used), *x.shape[1:]).swapaxes(0, 1)

    def gather(y):
        return y.swapaxes(0, 1).reshape(each * len(used), *y.shape[2:])[:count]

    def on_one_device(xs, *shared):
        return run(f, xs, shared)

    return jax.tree.map(gather, _dealt(on_one_device, used, jax.tree.map(deal, xs), shared))


def split_map(f: Callable, count: int, *shared, devices: int | None = None):
    """Split `count` columns into one run per device, call `f(first, size, *shared)` -> (..., size) for each, and join.

    For arithmetic on whole arrays that every device holds: each device computes a part of the columns.

    Returns:
        array (..., count).
    """
    used = _used(devices)
    size = -(-count // len(used))
    if len(used) == 1:
        return f(jnp.int32(0), size, *shared)

    def on_one_device(_, *shared):
        return f(lax.axis_index("device") * size, size, *shared)

    runs = jnp.moveaxis(_dealt(on_one_device, used, (), shared), 0, -2)
    return runs.reshape(*runs.shape[:-2], size * len(used))[..., :count]


def _loop(f, xs, shared):
    return lax.map(lambda x: f(x, *shared), xs)


def _lanes(f, xs, shared, width):
    return lanes(f, width)(xs, *shared)
