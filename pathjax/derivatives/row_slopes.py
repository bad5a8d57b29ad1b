"""Derivatives in many colours and scalars, stored without the entries that are always 0."""

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
    """The rows that hold the derivatives in a parameter; static."""

    rows: range
    parameter: Parameter
    array: tuple[int, ...]  # shape of the array that holds the parameter
    of_colors: bool  # whether that array holds colours; else scalars

    @classmethod
    def of(cls, scene: Scene, rows: range, parameter: Parameter) -> Place:
        path = parameter.path
        return cls(rows, parameter, named.get(scene, path).shape, differentiated.of_colors(scene, path))


@register_dataclass
@dataclass(frozen=True, eq=False)
class RowSlopes(Mapping[str, Array]):
    """Derivatives by parameter name, (*shape, 3, *shape of the parameter) each, built when they are read.

    Light keeps its channel, so only a third of the derivatives in a colour can differ from 0, and is stored.
    """

    rows: Rows  # (N, 4): derivative of each channel in the same channel; the last column is unused
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
    """Return the derivatives of a pixel's channels in a parameter, from those of each channel in its own entries."""
    if place.parameter.is_color:
        of_channels = row * jnp.eye(3, dtype=row.dtype)[:, None]
    else:
        of_channels = row.T
        if place.of_colors:  # texels whose channels all equal the scalar
            of_channels = of_channels[..., None] * jnp.asarray(LUMINANCE, row.dtype)
    return jax.vmap(partial(of_parameter, place.parameter, place.array))(of_channels)


def by_column(place: Place, row: Float[Array, "entries 3"]) -> Float[Array, "Q 3"]:
    """Return the derivative of each channel in the same channel of Q colours (others are 0), or in Q scalars."""
    if place.parameter.is_color:
        return of_parameter(place.parameter, place.array, row).reshape(-1, 3)
    return by_channel(place, row).reshape(3, -1).T
