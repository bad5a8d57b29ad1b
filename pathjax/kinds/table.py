"""Tables of the rows of a kind, and the view of one row that the physics reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import jax
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Shaped

from pathjax.compile import register_dataclass
from pathjax.core.math import at, luminance
from pathjax.core.types import Number, Surface


@register_dataclass
@dataclass(frozen=True)
class Column:
    values: Shaped[Array, "R ..."]  # not read in rows with a texture
    texture: Int[Array, "R 2"] | None = None  # kind, -1 for none, and row of the texture; None: no row has one
    # Added to the looked-up value, in all channels, for derivatives in it; per row, or for all rows. None: nothing.
    nudge: Float[Array, ""] | Float[Array, " R"] | None = None


@register_dataclass
@dataclass(frozen=True)
class Table:
    """All rows of one kind."""

    columns: tuple[Column | None, ...]  # one for each declared parameter; None: no row has it
    kind: type = field(metadata={"static": True})
    settings: tuple[tuple[str, str], ...] = field(default=(), metadata={"static": True})

    def column(self, name: str) -> Column | None:
        return self.columns[self.kind.place(name)]

    def with_column(self, name: str, values: Shaped[Array | np.ndarray, "R ..."] | None) -> Table:
        """Return the table with other values of a parameter."""
        columns = list(self.columns)
        old = columns[self.kind.place(name)]
        texture = None if old is None else old.texture
        columns[self.kind.place(name)] = None if values is None else Column(values, texture)
        return Table(tuple(columns), self.kind, self.settings)

    def nudged(self, nudges: Mapping[int, Array]) -> Table:
        """Return the table with nudges for some columns, by the index of the column."""
        columns = list(self.columns)
        for place, nudge in nudges.items():
            columns[place] = replace(columns[place], nudge=nudge)
        return replace(self, columns=tuple(columns))

    @property
    def textured(self) -> tuple[int, ...]:
        """Return the indices of the columns in which some row has a texture."""
        return tuple(i for i, column in enumerate(self.columns) if column is not None and column.texture is not None)

    def with_setting(self, name: str, value: str) -> Table:
        return Table(self.columns, self.kind, tuple((dict(self.settings) | {name: value}).items()))


class Row:
    """Parameters of one row as attributes, looked up on access: at a point of the surface if textured."""

    def __init__(self, table: Table, row: Number, surface: Surface | None = None, textures=None, colors=None):
        """Create the view.

        Args:
            surface, textures: arguments of the textures' `look_up`; unused where no row has a texture.
            colors: colours that are looked up already at this point, one for each of `Table.textured`; None: none is.
        """
        self._table, self._row, self._surface, self._textures, self._colors = table, row, surface, textures, colors

    def on(self, uv: Float[Array, "2"]) -> Row:
        """Return the row with its textures looked up at uv."""
        return Row(self._table, self._row, SimpleNamespace(uv=uv), self._textures)

    def nudged(self, nudges: Mapping[int, Array]) -> Row:
        """Return this row of `Table.nudged`."""
        return Row(self._table.nudged(nudges), self._row, self._surface, self._textures, self._colors)

    def __getattr__(self, name: str):
        kind = self._table.kind
        if name not in kind.declared:
            raise AttributeError(f"{kind.__name__} declares no {name}; it has {', '.join(kind.declared)}")
        if name in dict(self._table.settings):
            return dict(self._table.settings)[name]
        column = self._table.column(name)
        if column is None or kind.declared[name].shared:
            return column and column.values
        value = constant = at(column.values, self._row)
        if column.texture is not None:

            def look_up():
                color = self._color(name, column)
                return color if constant.shape else luminance(color)

            value = lax.cond(at(column.texture, self._row, 0) >= 0, look_up, lambda: constant)
        nudge = self.nudge(name)
        return value if nudge is None else value + nudge

    def nudge(self, name: str) -> Float[Array, ""] | None:
        """Return the value that is added to a parameter, or to a kind's look-up in a `Shared` array; None: nothing."""
        column = self._table.column(name)
        nudge = None if column is None else column.nudge
        return nudge if nudge is None or not nudge.ndim else at(nudge, self._row)

    def _color(self, name, column):
        if self._colors is not None:
            return self._colors[self._table.textured.index(self._table.kind.place(name))]
        return self._textures.look_up(at(column.texture, self._row), self._surface)

    def gradient(self, name: str) -> Float[Array, "2"]:
        """Return the derivatives of a scalar parameter in u and v of the surface."""

        def at_uv(uv):
            return getattr(Row(self._table, self._row, self._surface._replace(uv=uv), self._textures), name)

        return jax.jacfwd(at_uv)(self._surface.uv)
