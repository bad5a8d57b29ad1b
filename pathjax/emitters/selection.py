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
    lamps: Lamps | None  # of kinds on surfaces; None: each row is one light
    row: Int[Array, " R"] | None  # of each lamp in the table
    textures: Textures | None = None  # of textured parameters; None: there are none
    # Lower and upper corner around each light, and its mean normal; None: the choice does not depend on them.
    places: Float[Array, "R 3 3"] | None = None
    leaf: Int[Array, " R"] | None = None  # of each light in the tree that chooses them

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
        """Return the parameters of light number `light` of this kind. surface: point on it, if it has textures."""
        return Row(self.table, light if self.row is None else at(self.row, light), surface, self.textures)

    def power(self, weighted: bool = False) -> Float[Array, " R"]:
        """Return `Emitter.power`, for surfaces times their area. weighted: times the weights from files."""
        power, weights = self.kind.power(AllRows(self.table)), self.table.column("sampling_weight")
        if weighted and weights is not None:
            power = power * weights.values
        return power if self.lamps is None else self.lamps.area * power[self.row]

    def dark(self) -> bool:
        """Return whether they emit nothing. Values must not be traced."""
        colors = [key for key, d in self.kind.declared.items() if isinstance(d, Color) and d.radiance]
        if not colors:
            return not np.asarray(self.power()).any()
        return not any(np.asarray(self.table.column(key).values).any() for key in colors)  # `power` would be compiled


class AllRows:
    """Parameters of all rows, as attributes (R, *shape); a texture is replaced by its mean."""

    def __init__(self, table: Table):
        self._table = table

    def __getattr__(self, name: str):
        column = self._table.column(name)
        return None if column is None else column.values


@register_dataclass
@dataclass(frozen=True)
class Choice:
    """Probability of each light, numbered through the tables that are sampled; computed once per render."""

    pdf: Float[Array, " R"]
    cdf: Float[Array, " R"]  # ends at 1
    # Per table, the number of its first light; None: the table is not sampled.
    first: tuple[int | None, ...] = field(metadata={"static": True})
    # Tree that chooses near lights, and their total probability; None: `cdf` chooses all lights.
    tree: LightTree | None = None
    near: Float[Array, ""] | None = None


def choice(emitters: tuple[Lights, ...], strategy: str) -> Choice | None:
    """Return the probabilities of lights; None where there are none to choose from.

    Near and distant lights have half of the probability each. It is divided by power, among many near lights also by
    place.
    """
    first: list[int | None] = []
    powers: dict[bool, list] = {False: [], True: []}  # by whether lights are distant, in the order of tables
    count = 0
    for lights in emitters:
        sampled = strategy == "light" or not lights.left_to_bsdfs
        first.append(count if sampled else None)
        if sampled:
            # Strategy "light" has to find lights of weight 0 too.
            powers[lights.kind.distant].append(lights.power(weighted=strategy == "mis"))
            count += lights.count
    groups = [lax.stop_gradient(jnp.concatenate(group)) for group in powers.values() if group]
    if not groups:
        return None
    power = groups[0]
    if len(groups) > 1:
        power = jnp.concatenate([_over(group, jnp.sum(group), 0) for group in groups])
    # If all powers are 0, any choice will do, but 0 / 0 will not.
    pdf = _over(power, jnp.sum(power), 1 / len(power))
    chosen = Choice(pdf, jnp.cumsum(pdf), tuple(first))
    placed = [lights for lights in emitters if lights.places is not None]
    if not placed:
        return chosen
    places, leaf = (jnp.concatenate(each) for each in zip(*((x.places, x.leaf) for x in placed), strict=True))
    near = pdf[: len(leaf)]
    return replace(chosen, tree=light_tree.built(places, leaf, near), near=jnp.sum(near))


def _over(power, total, otherwise):
    """Return power / total, or `otherwise` where the total is 0."""
    return jnp.where(total > 0, power / jnp.where(total > 0, total, 1), otherwise)


def choose(
    chosen: Choice, ref: Float[Array, "3"], u: Float[Array, "2"]
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, "2"]]:
    """Choose a light for the point ref: return its number, its probability, and u with a fresh first number."""
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
    """Return the probability with which `choose` finds a light that is not distant."""
    if chosen.tree is None:
        return at(chosen.pdf, number)
    return light_tree.probability(chosen.tree, ref, number) * chosen.near
