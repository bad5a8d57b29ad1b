"""Parameters of a scene by name, `ID.field`, and where each lives in its tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Shaped


@dataclass(frozen=True)
class Parameter:
    """Where a parameter lives: attributes and tuple places down to an array, and the entry in it."""

    path: tuple[str | int, ...]
    index: tuple[int, ...]
    shape: tuple[int, ...]
    bounds: tuple[float, float]
    field: str = ""  # what its kind calls it
    moves_paths: bool = False  # as the IOR of smooth glass does; others change what paths carry
    least: float = -math.inf  # smaller numbers count as this one, and images do not change with them
    rows: int | None = None  # of a texture: how many entries of the array, from the index on; None: the entry alone

    @property
    def is_texture(self) -> bool:
        return self.rows is not None

    def get(self, values: Shaped[Array, "R ..."]) -> Shaped[Array, "..."]:
        """Its value, of the array where it lives."""
        if not self.is_texture:
            return values[self.index]
        first = self.index[0]
        return values[first : first + self.rows].reshape(self.shape)

    def put(self, values: Shaped[Array, "R ..."], value: Shaped[Array, "..."]) -> Shaped[Array, "R ..."]:
        """The array with another value of the parameter."""
        if not self.is_texture:
            return values.at[self.index].set(value)
        first = self.index[0]
        return values.at[first : first + self.rows].set(value.reshape(self.rows, *values.shape[1:]))

    def transposed(self, values: Shaped[Array, "R ..."]) -> Shaped[Array, "..."]:
        """The transpose of `put` into zeros: of derivatives in the array, those in the parameter."""
        zero = jnp.zeros(self.shape, values.dtype)
        (found,) = jax.linear_transpose(lambda x: self.put(jnp.zeros_like(values), x), zero)(values)
        return found

    @property
    def table(self) -> tuple[str | int, ...]:
        """Path to the table of its kind, which holds `columns[place].values`."""
        return self.path[:-3]


@dataclass(frozen=True, eq=False)
class Parameters:
    """What builders find while they fill tables."""

    known: dict[str, Parameter] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  # names that look like parameters, and why they are none
    # Of textures that are one parameter each, named after what they stand in: where they live, and their first name.
    textures: dict[object, Parameter] = field(default_factory=dict)
    names: dict[object, str] = field(default_factory=dict)

    def enter_texture(self, name: str, texture, declared) -> None:
        """Enter a texture that stands in the place of what is `declared`, and would be the parameter `name`."""
        first, color = self.names.setdefault(texture, name), declared.listed and declared.shape == (3,)
        if texture not in self.textures:
            self.refused.update(texture.kind.refused(name))
        elif first != name:
            self.refused[name] = f"{name} is the same image as {first}; set that, and both change"
            if not color and first in self.known:
                del self.known[first]
                self.refused[first] = f"{first} is also {name}, and only images of colours are parameters"
        elif color:
            self.known[name] = replace(self.textures[texture], bounds=declared.bounds)
        else:
            self.refused[name] = f"{name} is an image, and only images of colours are parameters"
