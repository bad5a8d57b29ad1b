"""Derivatives in many colours, of which no more is kept than may differ from 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial

import jax
from jaxtyping import Array, Float

from pathjax.compile import Rows, register_dataclass
from pathjax.derivatives import tangents


@register_dataclass
@dataclass(frozen=True, eq=False)
class ColorSlopes(Mapping[str, Array]):
    """Derivatives by the names of colours, (*shape, 3, 3) each, which are made when they are read.

    Light keeps its channel, so a third of their numbers says all.
    """

    rows: Rows  # (N, 4), of each channel in its own; the last number is none
    places: tuple[tuple[str, int], ...] = field(metadata={"static": True})  # name -> row
    shape: tuple[int, ...] = field(metadata={"static": True})  # of the N pixels

    def __getitem__(self, name: str) -> Float[Array, "... 3 3"]:
        return _slope(self._rows, self._place[name], self.shape)

    @cached_property
    def _rows(self) -> Rows:
        return self.rows.here()

    @cached_property
    def _place(self) -> dict[str, int]:
        return dict(self.places)

    def __contains__(self, name: object) -> bool:
        return name in self._place

    def __iter__(self) -> Iterator[str]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self.places)


@partial(jax.jit, static_argnames="shape")
def _slope(rows: Rows, number, shape: tuple[int, ...]) -> Float[Array, "... 3 3"]:
    row = rows[number][..., :3]
    return tangents.by_channel(row.reshape(*row.shape[:-2], *shape, 3))
