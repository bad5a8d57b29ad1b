"""Compiles a function of one ray to a native kernel over millions of rays.

- `native_map` runs a function of one item over all items, on all devices; on CPUs `lanes/` implements it. `native_fold`
  is for items that accumulate into shared memory, `native_rows` for items that each write rows of their own.
- `compute_once`, `one_by_one`, `interleaved`, `persistent_loop`, `unset` and `basis` are used in code of one item. They
  change no result, only what is computed and when. `together` updates the memory of a `native_fold`.
- `linear` is a linear function with a transpose of its own.
- `register_dataclass` makes a dataclass a pytree; with JAX's own function it may get the kernel of another dataclass.
- `on_all_devices` keeps arrays from being copied at each call.
- `concurrently` calls one kernel several times at once.
- `setup` prepares XLA. It runs here, so that importing pathjax is enough. `keep_kernels` is for programs; `compiled`
  then loads kernels from disk without tracing them.

Only `jax_compat` imports JAX internals.
"""

from __future__ import annotations

from pathjax.compile.cache import compiled, keep_kernels
from pathjax.compile.jax_compat import is_symbolic_zero, is_traced, register_dataclass
from pathjax.compile.lanes.interpreter import SELECTED_ROWS
from pathjax.compile.linear import linear
from pathjax.compile.mapping import (
    MANY_ITEMS,
    native_fold,
    native_map,
    native_rows,
    parts_per_item,
    split_map,
    sum_of_parts,
)
from pathjax.compile.primitives import (
    Search,
    basis,
    compute_once,
    interleaved,
    one_by_one,
    persistent_loop,
    together,
    unset,
)
from pathjax.compile.promotion import standard_promotion
from pathjax.compile.replicas import on_all_devices
from pathjax.compile.rows import Rows
from pathjax.compile.threads import calls_at_once, concurrently, devices_of_a_call
from pathjax.compile.xla import native, setup

__all__ = [
    "MANY_ITEMS",
    "SELECTED_ROWS",
    "Rows",
    "Search",
    "basis",
    "calls_at_once",
    "compiled",
    "compute_once",
    "concurrently",
    "devices_of_a_call",
    "interleaved",
    "is_symbolic_zero",
    "is_traced",
    "keep_kernels",
    "linear",
    "native",
    "native_fold",
    "native_map",
    "native_rows",
    "on_all_devices",
    "one_by_one",
    "parts_per_item",
    "persistent_loop",
    "register_dataclass",
    "setup",
    "split_map",
    "standard_promotion",
    "sum_of_parts",
    "together",
    "unset",
]

setup()
