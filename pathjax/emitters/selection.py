"""The lights of a scene, and the choice among them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import register_dataclass
from pathjax.core.math import at
from pathjax.core.types import Number, Surface
from pathjax.emitters import light_tree
from pathjax.emitters.emitter import Background, Emitter
from pathjax.emitters.light_tree import LightTree
from pathjax.kinds import Color, Row, Table
from pathjax.shapes import Lamps
from pathjax.textures import Textures


@register_dataclass
@dataclass(frozen=True)
class Lights:
    """All lights of one kind."""

    table: Table  # a row for each emitter of the file
    lamps: Lamps | None  # what shines, of kinds that stand inside shapes; None: each row is one light
    row: Int[Array, " R"] | None  # row of the table, of each lamp
    textures: Textures | None = None  # in the place of parameters; None: there are none
    # Lower and upper corner around each, and the mean normal of its area; None: nothing chooses by them.
    places: Float[Array, "R 3 3"] | None = None
    leaf: Int[Array, " R"] | None = None  # of each in the tree by which they are chosen

    @property
    def kind(self) -> type[Emitter]:
        return self.table.kind

    @property
    def count(self) -> int:
        if self.lamps is not None:
            return self.lamps.area.shape[0]
        by_row = (self.table.column(key) for key, declared in self.kind.declared.items() if not declared.shared)
        return next(column.values.shape[0] for column in by_row if column is not None)

    @property
    def left_to_bsdfs(self) -> bool:
        return issubclass(self.kind, Background) and self.kind.left_to_bsdfs

    def parameters(self, light: Number, surface: Surface | None = None) -> Row:
        """The parameters of light number `light` of this kind; surface: where it is met, if it has textures."""
        return Row(self.table, light if self.row is None else at(self.row, light), surface, self.textures)

    def power(self, weighted: bool = False) -> Float[Array, " R"]:
        """`Emitter.power`, of surfaces times their area. weighted: times the weights that files give."""
        power, weights = self.kind.power(AllRows(self.table)), self.table.column("sampling_weight")
        if weighted and weights is not None:
            power = power * weights.values
        return power if self.lamps is None else self.lamps.area * power[self.row]

    def dark(self) -> bool:
        """Whether they emit nothing; of known values, not of traced ones."""
        colors = [key for key, d in self.kind.declared.items() if isinstance(d, Color) and d.radiance]
        if not colors:
            return not np.asarray(self.power()).any()
        return not any(np.asarray(self.table.column(key).values).any() for key in colors)  # `power` would be compiled


class AllRows:
    """Parameters of all rows, as attributes (R, *shape); of a texture its mean."""

    def __init__(self, table: Table):
        self._table = table

    def __getattr__(self, name: str):
        column = self._table.column(name)
        return None if column is None else column.values


@register_dataclass
@dataclass(frozen=True)
class Choice:
    """Probability of each light, numbered through the tables that are sampled; made once per render."""

    pdf: Float[Array, " R"]
    cdf: Float[Array, " R"]  # ends at 1
    first: tuple[int | None, ...] = field(metadata={"static": True})  # by table, its first number; None: not sampled
    # By which those that are not distant are chosen, and the probability that one of them is; None: all by `cdf`.
    tree: LightTree | None = None
    near: Float[Array, ""] | None = None


def choice(emitters: tuple[Lights, ...], strategy: str) -> Choice | None:
    """Near lights and distant ones half of the time each, and among those by power, of many near ones also by place.

    None where there is nothing to choose from.
    """
    first: list[int | None] = []
    powers: dict[bool, list] = {False: [], True: []}  # by whether they are distant, as tables are ordered
    count = 0
    for lights in emitters:
        sampled = strategy == "light" or not lights.left_to_bsdfs
        first.append(count if sampled else None)
        if sampled:
            # Strategy "light" has to find what has the weight 0 too.
            powers[lights.kind.distant].append(lights.power(weighted=strategy == "mis"))
            count += lights.count
    groups = [lax.stop_gradient(jnp.concatenate(group)) for group in powers.values() if group]
    if not groups:
        return None
    power = groups[0]
    if len(groups) > 1:
        power = jnp.concatenate([_over(group, jnp.sum(group), 0) for group in groups])
    # Lights of power 0 throughout: any choice will do, and 0 / 0 will not.
    pdf = _over(power, jnp.sum(power), 1 / len(power))
    chosen = Choice(pdf, jnp.cumsum(pdf), tuple(first))
    placed = [lights for lights in emitters if lights.places is not None]
    if not placed:
        return chosen
    places, leaf = (jnp.concatenate(each) for each in zip(*((x.places, x.leaf) for x in placed), strict=True))
    near = pdf[: len(leaf)]
    return replace(chosen, tree=light_tree.built(places, leaf, near), near=jnp.sum(near))


def _over(power, total, otherwise):
    """power / total, or `otherwise` where the total is 0."""
    return jnp.where(total > 0, power / jnp.where(total > 0, total, 1), otherwise)


def choose(
    chosen: Choice, ref: Float[Array, "3"], u: Float[Array, "2"]
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, "2"]]:
    """Choose a light for the point ref: its number, the probability, and u, of which the first number is used anew."""
    count = chosen.pdf.shape[0]
    if count == 1:
        return jnp.int32(0), jnp.ones_like(u[0]), u
    if chosen.tree is None:
        return _by_power(chosen, u)

    def from_tree():
        number, probability, again = light_tree.choose(chosen.tree, ref, u[0] / chosen.near)
        return number, probability * chosen.near, jnp.stack([again, u[1]])

    if count == chosen.tree.leaf.shape[0]:
        return from_tree()
    # Distant lights have the last numbers.
    return lax.cond(u[0] < chosen.near, from_tree, lambda: _by_power(chosen, u))


def _by_power(chosen: Choice, u):
    number = jnp.searchsorted(chosen.cdf, u[0], side="right").astype(jnp.int32)
    number = jnp.minimum(number, chosen.pdf.shape[0] - 1)
    pdf = at(chosen.pdf, number)
    below = at(chosen.cdf, number) - pdf
    again = jnp.clip((u[0] - below) / jnp.where(pdf > 0, pdf, 1), 0, 1 - 2**-24)
    return number, pdf, jnp.stack([again, u[1]])


def probability(chosen: Choice, ref: Float[Array, "3"], number: Int[Array, ""]) -> Float[Array, ""]:
    """With which `choose` finds a light that is not distant."""
    if chosen.tree is None:
        return at(chosen.pdf, number)
    return light_tree.probability(chosen.tree, ref, number) * chosen.near
