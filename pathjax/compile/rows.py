"""Rows of memory that items wrote, still in the parts in which they were computed."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from pathjax.compile.jax_compat import register_dataclass
from pathjax.compile.replicas import on_one_device


@register_dataclass
@dataclass(frozen=True)
class Rows:
    """M rows (N, ...) of N items, in the parts to which the items were dealt, each on its device.

    They may fill all memory, and copying data that is written once costs more than computing it: so a row is joined
    when it is read. An axis that `jax.vmap` has put in front stays there.
    """

    # (parts, M, items of a part, ...), or pieces of that along its first axis; item i is in part i % parts.
    of_parts: tuple[Array, ...]
    shape: tuple[int, ...] = field(metadata={"static": True})  # of a row

    @property
    def _axis(self) -> int:
        """Axis of the parts."""
        return self.of_parts[0].ndim - len(self.shape) - 2

    @property
    def count(self) -> int:
        """M, the number of rows."""
        return self.of_parts[0].shape[self._axis + 1]

    def __getitem__(self, row) -> Array:
        """Return one row (N, ...)."""
        axis = self._axis
        of_parts = [lax.dynamic_index_in_dim(x, row, axis + 1, keepdims=False) for x in self.of_parts]
        return self._joined(jnp.concatenate(of_parts, axis), axis)

    def all(self) -> Array:
        """Return all rows (M, N, ...)."""
        of_parts = jnp.concatenate(self.of_parts, self._axis)
        return self._joined(of_parts.swapaxes(self._axis, self._axis + 1), self._axis + 1)

    def here(self) -> Rows:
        """Return the rows on one device, if that needs no copy; what is read from them is then on that device alone."""
        return Rows(sum((on_one_device(x, self._axis) for x in self.of_parts), ()), self.shape)

    def like(self, rows: Array) -> Rows:
        """Return rows (M, N, ...) as `Rows` in one piece, in parts of as many items as these."""
        parts, _, items = self.of_parts[0].shape[self._axis :][:3]
        rows = jnp.pad(rows, [(0, 0), (0, parts * items - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)])
        rows = rows.reshape(len(rows), items, parts, *rows.shape[2:])
        return Rows((jnp.moveaxis(rows, 2, 0),), self.shape)

    def _joined(self, x: Array, axis: int) -> Array:
        """(..., parts, items, ...) -> (..., N, ...)"""
        x = x.swapaxes(axis, axis + 1)
        x = x.reshape(*x.shape[:axis], -1, *x.shape[axis + 2 :])
        return lax.slice_in_dim(x, 0, self.shape[0], axis=axis)
