"""Derivatives in many colours and numbers, of which no more is kept than may differ from 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.compile import Rows, register_dataclass
from pathjax.core.math import LUMINANCE
from pathjax.derivatives import differentiated, tangents
from pathjax.derivatives.kept import of_parameter
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene


class Place(NamedTuple):
    """Where the derivatives in a parameter stand; static."""

    rows: range
    parameter: Parameter
    array: tuple[int, ...]  # shape of what it lives in
    of_colors: bool  # else it holds numbers

    @classmethod
    def of(cls, scene: Scene, rows: range, parameter: Parameter) -> Place:
        path = parameter.path
        return cls(rows, parameter, named.get(scene, path).shape, differentiated.of_colors(scene, path))


@register_dataclass
@dataclass(frozen=True, eq=False)
class RowSlopes(Mapping[str, Array]):
    """Derivatives by the names of parameters, (*shape, 3, *shape of the parameter) each, made when they are read.

    Light keeps its channel, so of a colour a third of the numbers says all.
    """

    rows: Rows  # (N, 4), of each channel in its own; the last number is none
    places: tuple[tuple[str, Place], ...] = field(metadata={"static": True})  # by name
    shape: tuple[int, ...] = field(metadata={"static": True})  # of the N pixels

    def __getitem__(self, name: str) -> Float[Array, "..."]:
        place = self._place[name]
        if place.parameter.is_texture:
            return _slopes(self._rows, place, self.shape)
        return _slope(self._rows, place.rows.start, bool(place.parameter.shape), self.shape)

    @cached_property
    def _rows(self) -> Rows:
        return self.rows.here()

    @cached_property
    def _place(self) -> dict[str, Place]:
        return dict(self.places)

    def __contains__(self, name: object) -> bool:
        return name in self._place

    def __iter__(self) -> Iterator[str]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self.places)


@partial(jax.jit, static_argnames=("of_color", "shape"))
def _slope(rows: Rows, number, of_color: bool, shape: tuple[int, ...]) -> Float[Array, "..."]:
    row = rows[number][..., :3]
    return tangents.in_parameter(row.reshape(*row.shape[:-2], *shape, 3), of_color)


@partial(jax.jit, static_argnames=("place", "shape"))
def _slopes(rows: Rows, place: Place, shape: tuple[int, ...]) -> Float[Array, "..."]:
    found = rows.all()[..., place.rows.start : place.rows.stop, :, :3]  # (..., entries, N, 3)
    found = jnp.moveaxis(found, -3, -2)
    before = *found.shape[:-3], *shape
    found = found.reshape(-1, *found.shape[-2:])
    return jax.vmap(partial(by_channel, place))(found).reshape(*before, 3, *place.parameter.shape)


def by_channel(place: Place, row: Float[Array, "entries 3"]) -> Float[Array, "3 ..."]:
    """Derivatives of the channels of a pixel in a parameter, from those of each in its own entries."""
    if place.parameter.is_color:
        of_channels = row * jnp.eye(3, dtype=row.dtype)[:, None]
    else:
        of_channels = row.T
        if place.of_colors:  # which are all as the number
            of_channels = of_channels[..., None] * jnp.asarray(LUMINANCE, row.dtype)
    return jax.vmap(partial(of_parameter, place.parameter, place.array))(of_channels)


def by_column(place: Place, row: Float[Array, "entries 3"]) -> Float[Array, "Q 3"]:
    """The same, of each channel in each number; in colours in the same channel, as all else is 0."""
    if place.parameter.is_color:
        return of_parameter(place.parameter, place.array, row).reshape(-1, 3)
    return by_channel(place, row).reshape(3, -1).T
