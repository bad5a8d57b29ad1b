"""Parameters of a scene by name, `ID.field`, and the location of each in its tables."""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Shaped

from pathjax.core.math import luminance


class Fixed:
    """An integer array that is hashable and compares by content, for static parts of pytrees."""

    def __init__(self, values: np.ndarray):
        self.values = values

    @functools.cached_property
    def _content(self) -> tuple:
        return self.values.shape, hashlib.sha256(np.int64(self.values).tobytes()).digest()

    def __eq__(self, other):
        return isinstance(other, Fixed) and (self is other or self._content == other._content)

    def __hash__(self):
        return hash(self._content)


@dataclass(frozen=True)
class Mean:
    """Location of the mean of a texture, by which lights are chosen, as a row of an array; and the terms of its sum."""

    path: tuple[str | int, ...]
    row: int
    parts: tuple[tuple[float, Parameter], ...]  # factors and the parameters that they multiply
    rest: tuple[float, ...]  # (3,) the sum of all that is not a parameter


@dataclass(frozen=True)
class Parameter:
    """Location of a parameter: attributes and tuple indices that lead to an array, and the entry in it."""

    path: tuple[str | int, ...]
    index: tuple[int, ...]
    shape: tuple[int, ...]
    bounds: tuple[float, float]
    field: str = ""  # its name in its kind
    moves_paths: bool = False  # as the IOR of smooth glass does; others change the radiance that paths carry
    least: float = -math.inf  # smaller values are treated as this one, so images do not depend on them
    rows: int | None = None  # for a texture: number of array entries from the index on; None: not a texture
    means: tuple[Mean, ...] = ()  # means that it contributes to
    # (rows, 3) index of each corner's value among the values of a mesh's vertices or faces; None: not of a mesh.
    corners: Fixed | None = None
    # For a texture: names of the fields of bsdfs and lights that it sets; None: it may be any.
    stands_in: frozenset[str] | None = None
    of_numbers: bool = False  # for a texture of scalars: a last axis of 3 is three texels, not channels

    @property
    def is_texture(self) -> bool:
        return self.rows is not None

    @property
    def is_color(self) -> bool:
        """Return whether its last axis is r, g, b."""
        return self.shape[-1:] == (3,) and not self.of_numbers

    def get(self, values: Shaped[Array, "R ..."]) -> Shaped[Array, "..."]:
        """Return its value from its array; for a texture of scalars the luminance of its texels."""
        if not self.is_texture:
            return values[self.index]
        first = self.index[0]
        mine = values[first : first + self.rows]
        if self.corners is not None:
            # A value that no corner has is 0.
            corners = self.corners.values
            corner_of = np.full(self.shape[0], corners.size)
            corner_of[corners.ravel()] = np.arange(corners.size)
            return jnp.concatenate([mine.reshape(-1, 3), jnp.zeros((1, 3), mine.dtype)])[corner_of]
        if mine.size > math.prod(self.shape):
            mine = jnp.where(jnp.ptp(mine, 1) > 0, luminance(mine), mine[:, 0])
        return mine.reshape(self.shape)

    def put(self, values: Shaped[Array, "R ..."], value: Shaped[Array, "..."]) -> Shaped[Array, "R ..."]:
        """Return the array with another value of the parameter; a scalar sets all channels of a texel."""
        if not self.is_texture:
            return _with_entry(values, self.index, value)
        return with_textures(values, [(self, value)])

    def of_rows(self, values: Shaped[Array, "R ..."], value: Shaped[Array, "..."]) -> Shaped[Array, "rows ..."]:
        """Return a texture's rows of the array for a value of the parameter."""
        if self.corners is not None:
            return value[self.corners.values].astype(values.dtype)
        others = values.shape[1:]
        value = jnp.broadcast_to(value.reshape(self.rows, -1), (self.rows, math.prod(others)))
        return value.reshape(self.rows, *others).astype(values.dtype)

    def transposed(self, values: Shaped[Array, "R ..."]) -> Shaped[Array, "..."]:
        """Apply the transpose of `put` into zeros: maps derivatives in the array to derivatives in the parameter."""
        zero = jnp.zeros(self.shape, values.dtype)
        (found,) = jax.linear_transpose(lambda x: self.put(jnp.zeros_like(values), x), zero)(values)
        return found

    @property
    def table(self) -> tuple[str | int, ...] | None:
        """Return the path to its kind's table, which holds `columns[place].values`; None: it is of a mesh or a grid."""
        return self.path[:-3] if "columns" in self.path else None


def with_textures(
    values: Shaped[Array, "R ..."], textures: Sequence[tuple[Parameter, Shaped[Array, "..."]]]
) -> Shaped[Array, "R ..."]:
    """Return the array with other values of some textures. If they fill it, it is not read, as it may be large."""
    new = [(parameter.index[0], parameter.of_rows(values, value)) for parameter, value in textures]
    if sum(len(rows) for _, rows in new) == len(values):
        if len(new) == 1:
            return new[0][1]
        values = lax.empty(values.shape, values.dtype)
    for first, rows in new:
        values = values.at[first : first + len(rows)].set(rows)
    return values


@functools.partial(jax.jit, inline=True)  # one program; without jit JAX would compile one for each operation
def _with_entry(values, index, value):
    return values.at[index].set(value)


@dataclass(frozen=True, eq=False)
class Parameters:
    """Parameters that builders collect while they fill tables."""

    known: dict[str, Parameter] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  # names that look like parameters -> why they are not
    # Textures that are one parameter each, named after the first field that they set: their locations and their names.
    textures: dict[object, Parameter] = field(default_factory=dict)
    names: dict[object, str] = field(default_factory=dict)

    def enter_texture(self, name: str, texture, declared, field: str | None) -> None:
        """Enter a texture that replaces the parameter `name`, which is `declared`.

        An image that replaces several parameters is named after the first, and has the intersection of their bounds. If
        all of them are scalars, it is a parameter of scalars.

        Args:
            field: the parameter's name in its kind; None: the texture stands in another texture.
        """
        if texture not in self.textures:
            self.refused.update(texture.kind.refused(name))
            return
        first = self.names.setdefault(texture, name)
        if first != name:
            self.refused[name] = f"{name} is the same image as {first}; set that, and both change"
        if not declared.listed:
            self.known.pop(first, None)
            self.refused[first] = f"{first} is an image that stands in {name}, too, which is no parameter"
        elif first not in self.refused:
            color = self.textures[texture]
            shape = color.shape if declared.shape == (3,) else color.shape[:-1]
            bounds = declared.bounds[0], max(declared.bounds[1], texture.kind.span(texture)[1])
            now = self.known.get(first, replace(color, shape=shape, bounds=bounds, stands_in=frozenset()))
            low, high = zip(now.bounds, bounds, strict=True)
            shape, bounds = max(now.shape, shape, key=len), (max(low), min(high))
            numbers = len(shape) < len(color.shape)
            places = None if field is None or now.stands_in is None else now.stands_in | {field}
            self.known[first] = replace(now, shape=shape, bounds=bounds, stands_in=places, of_numbers=numbers)
