"""What varies over a surface: one file per kind, the table of kinds, and the look-up among the kinds in a scene.

A texture is a subclass of `Texture`, which defines the methods that it implements. A scene file may put a texture
wherever a kind declares a `Color` or a `Number` that may be textured. Only kinds that occur in the scene are compiled.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import register_dataclass
from pathjax.core.math import at
from pathjax.core.types import Surface
from pathjax.errors import InputError
from pathjax.kinds import Instance, Parameters, Row, Table, ordered
from pathjax.kinds import register as register_kind
from pathjax.textures.bitmap import Bitmap
from pathjax.textures.checkerboard import Checkerboard
from pathjax.textures.mesh_attribute import MeshAttribute
from pathjax.textures.texture import Texture
from pathjax.textures.uniform import Uniform
from pathjax.textures.volume import Volume

__all__ = [
    "KINDS",
    "Bitmap",
    "Checkerboard",
    "MeshAttribute",
    "Pairs",
    "Texture",
    "Textures",
    "Uniform",
    "Volume",
    "alike",
    "build",
    "of_number",
    "register",
]

# Kinds by their names in scene files.
KINDS: dict[str, type[Texture]] = {
    "bitmap": Bitmap,
    "checkerboard": Checkerboard,
    "mesh_attribute": MeshAttribute,
    "uniform": Uniform,
    "volume": Volume,
}


def register(name: str):
    """Return a decorator that registers a subclass of `Texture` as a kind, which scene files call `name`."""
    return register_kind(KINDS, Texture, name, "textures")


# Indices in a list of derivatives, and their weights in a number or in each channel of a colour.
Pairs = tuple[tuple[Int[Array, ""], Float[Array, "..."]], ...]


@register_dataclass
@dataclass(frozen=True)
class Textures:
    tables: tuple[Table, ...]  # one for each kind present and depth of nesting; held textures come first

    def look_up(self, code: Int[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        """Return the colour of a texture at a point of a surface. code: kind and row; below 0: arbitrary."""

        def of(number, table):
            def look_up():
                p = self._row(number, table, jnp.maximum(code[1], 0), surface)
                return table.kind.look_up(p, _uv(p, surface), surface)

            return look_up

        return self._switch(code, [of(*each) for each in enumerate(self.tables)])

    def _row(self, number: int, table: Table, row: Int[Array, ""], surface: Surface) -> Row:
        return Row(table, row, surface, self._held(number)) if table.textured else Row(table, row)

    def _held(self, number: int) -> Textures:
        """Return the textures that those of a table may hold."""
        return Textures(self.tables[:number])

    def entries(
        self, code: Int[Array, "2"], surface: Surface, first: Mapping[tuple[int, int | str], int]
    ) -> Pairs:
        """Return the numbers that a colour is a weighted sum of, as indices in a list of derivatives, and the weights.

        first: (table, column or name of a mesh attribute) -> index where its entries begin; others are left out.
        """

        return self._found(code, surface, first, lambda kind, *where: (None, kind.entries(*where)))[1]

    def with_entries(
        self, code: Int[Array, "2"], surface: Surface, first: Mapping[tuple[int, int | str], int]
    ) -> tuple[Float[Array, "3"], Pairs]:
        """Return the results of `look_up` and `entries`."""
        return self._found(code, surface, first, lambda kind, *where: kind.with_entries(*where))

    def _found(self, code, surface, first, find):
        def of(number, table):
            def found():
                row = jnp.maximum(code[1], 0)
                p = self._row(number, table, row, surface)
                known = {table.kind.place(name): name for name in table.kind.declared}
                begins = {known.get(column, column): i for (each, column), i in first.items() if each == number}
                color, parts = find(table.kind, p, _uv(p, surface), surface)
                pairs = []
                for name, entry, share in parts:
                    if name in known.values() and table.kind.place(name) in table.textured:
                        held = at(table.column(name).texture, row)
                        inside = self._held(number).entries(held, surface, first)
                        pairs += [(place, jnp.where(held[0] >= 0, share * part, 0)) for place, part in inside]
                        share = jnp.where(held[0] >= 0, 0, share)
                    if name in begins:
                        pairs.append((begins[name] + (row if entry is None else entry), share))
                return color, tuple(pairs)

            return found

        calls = [of(*each) for each in enumerate(self.tables)]
        filled = _filling([lambda call=call: call()[1] for call in calls], surface.uv.dtype)

        def made_alike(call):
            color, pairs = call()
            return color, filled(pairs)

        return self._switch(code, [partial(made_alike, call) for call in calls])

    def _switch(self, code, calls):
        """Return the result of the call for the texture's kind."""
        return calls[0]() if len(calls) == 1 else lax.switch(jnp.maximum(code[0], 0), calls)


def alike(calls: Sequence[Callable], dtype) -> list[Callable]:
    """Return the calls, which return `Pairs`, padded with weights of 0 so that all return equally many."""
    filled = _filling(calls, dtype)
    return [lambda call=call: filled(call()) for call in calls]


def _filling(calls: Sequence[Callable], dtype) -> Callable:
    """Return a function that pads `Pairs` to the largest number that these calls return."""
    found = [jax.eval_shape(lambda call=call: tuple(call())) for call in calls]
    most = max(1, *map(len, found))
    shape = np.broadcast_shapes(*(share.shape for pairs in found for _, share in pairs))

    def filled(pairs):
        known = tuple((place, jnp.broadcast_to(share, shape)) for place, share in pairs)
        return known + ((jnp.int32(0), jnp.zeros(shape, dtype)),) * (most - len(known))

    return filled


def _uv(p: Row, surface: Surface) -> Float[Array, "2"]:
    m, uv = p.to_uv, surface.uv
    return uv if m is None else m[:, 0] * uv[0] + m[:, 1] * uv[1] + m[:, 2]


def of_number(texture: Instance, known: dict[Instance, Instance]) -> Instance:
    """Return the texture in the form that stands for a number. known: cache of the results."""
    if texture not in known:
        known[texture] = texture.kind.of_number(texture, partial(of_number, known=known))
    return known[texture]


def build(instances: list[Instance], dtype, path: tuple, parameters: Parameters) -> tuple[Textures | None, dict]:
    """Build textures (None: there are none); and the code (kind, row) of each instance and of those that they hold."""
    tables, codes, levels = [], {}, {}
    for instance in instances:
        _enter_level(instance, levels)
    for (_, name), count in Counter((each.kind, each.name) for each in levels).items():
        if count > 1:
            raise InputError(
                f'the texture "{name}" stands for a colour and for a number, whose squares differ in colour; '
                "give each a texture of its own"
            )
    for level in sorted(set(levels.values())):
        for kind, rows in ordered([each for each in levels if levels[each] == level], KINDS).items():
            codes |= {each: (len(tables), row) for row, each in enumerate(rows)}
            tables.append(kind.build(rows, dtype, (*path, "tables", len(tables)), parameters, codes.get))
    return (Textures(tuple(tables)) if tables else None), codes


def _enter_level(texture: Instance, levels: dict[Instance, int]) -> int:
    """Return the depth of nesting in a texture (0: it holds none); enter it and those that it holds in `levels`."""
    if texture not in levels:
        held = [_enter_level(each, levels) for each in texture.values.values() if isinstance(each, Instance)]
        levels[texture] = max(held, default=-1) + 1
    return levels[texture]
