"""How surfaces scatter: a file a kind, the table of kinds, and the dispatch over those that a scene holds.

A bsdf is a subclass of `BSDF`, which says what it must offer and what it may be capable of. A material has a front and
a back, each a bsdf or nothing, which absorbs: a kind, which is the place of a table, and a row in that table. Where
settings of bsdfs differ, they are in tables of their own. Where bsdfs hold others, a material is a tree, and `leaf`
finds what scatters.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import textures
from pathjax.bsdfs import tree
from pathjax.bsdfs.blendbsdf import BlendBSDF
from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.bumpmap import BumpMap
from pathjax.bsdfs.circular import Circular
from pathjax.bsdfs.conductor import Conductor
from pathjax.bsdfs.dielectric import Dielectric
from pathjax.bsdfs.diffuse import Diffuse
from pathjax.bsdfs.mask import Mask
from pathjax.bsdfs.normalmap import NormalMap
from pathjax.bsdfs.null import Null
from pathjax.bsdfs.plastic import Plastic
from pathjax.bsdfs.polarizer import Polarizer
from pathjax.bsdfs.pplastic import PPlastic
from pathjax.bsdfs.principled import Principled
from pathjax.bsdfs.principledthin import PrincipledThin
from pathjax.bsdfs.retarder import Retarder
from pathjax.bsdfs.roughconductor import RoughConductor
from pathjax.bsdfs.roughdielectric import RoughDielectric
from pathjax.bsdfs.roughplastic import RoughPlastic
from pathjax.bsdfs.thindielectric import ThinDielectric
from pathjax.bsdfs.twosided import TwoSided
from pathjax.bsdfs.wrapper import Wrapper
from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import at
from pathjax.core.types import BSDFSample, Frame, Surface
from pathjax.kinds import Column, Instance, Parameters, Row, Table, ordered
from pathjax.kinds import register as register_kind
from pathjax.textures import Pairs, Textures

__all__ = [
    "KINDS",
    "BSDF",
    "BlendBSDF",
    "BumpMap",
    "Circular",
    "Conductor",
    "Dielectric",
    "Diffuse",
    "Mask",
    "Materials",
    "NormalMap",
    "Null",
    "PPlastic",
    "Plastic",
    "Polarizer",
    "Principled",
    "PrincipledThin",
    "Retarder",
    "RoughConductor",
    "RoughDielectric",
    "RoughPlastic",
    "ThinDielectric",
    "TwoSided",
    "register",
]

# By the name that scene files give them.
KINDS: dict[str, type[BSDF]] = {
    "diffuse": Diffuse,
    "conductor": Conductor,
    "roughconductor": RoughConductor,
    "dielectric": Dielectric,
    "thindielectric": ThinDielectric,
    "roughdielectric": RoughDielectric,
    "plastic": Plastic,
    "null": Null,
    "roughplastic": RoughPlastic,
    "principled": Principled,
    "principledthin": PrincipledThin,
    "pplastic": PPlastic,
    "twosided": TwoSided,
    "blendbsdf": BlendBSDF,
    "mask": Mask,
    "polarizer": Polarizer,
    "circular": Circular,
    "retarder": Retarder,
    "bumpmap": BumpMap,
    "normalmap": NormalMap,
}
# Place of the table of a kind, row in it, or place of a shape; -1: none.
Index = Int[Array, ""]
# For each of `Table.textured`, what was looked up there.
Colors = tuple[Float[Array, "3"], ...]
FRESNEL = Dielectric.fresnel.options


def register(name: str):
    """A decorator that makes a subclass of `BSDF` a kind, which scene files name by `name`."""
    return register_kind(KINDS, BSDF, name, "bsdfs")


@register_dataclass
@dataclass(frozen=True)
class Materials:
    tables: tuple[Table, ...]  # one for each kind of bsdf present
    sides: Int[Array, "S 2 code"]  # of each shape: front and back; kind (-1: absorbs), row; of trees a `tree.Node`
    textures: Textures | None  # in the place of parameters; None: there are none
    # Of kinds that hold others, and which of them, by place, may be met after so many others on the way to a leaf, and
    # on the way to what lets light pass. None of it in scenes without.
    wrappers: tuple[Table, ...] = ()
    levels: tuple[tuple[int, ...], ...] = field(default=(), metadata={"static": True})
    passing: tuple[tuple[int, ...], ...] = field(default=(), metadata={"static": True})
    # Of derivatives: where the numbers of textures that are differentiated begin in their list, of `Textures.entries`.
    listed: tuple[tuple[tuple[int, int | str], int], ...] = field(default=(), metadata={"static": True})
    # By wrapper, places of the columns in whose numbers `leaf` tells the derivative of its weight; empty: in none.
    recorded: tuple[tuple[int | None, ...], ...] = field(default=(), metadata={"static": True})
    # For derivatives: which of the surfaces that a shadow ray passes has its `passing` nudged, and by what.
    nudged: tuple[Int[Array, ""], Float[Array, "held columns"]] | None = None


def build(
    bsdfs: list[Instance], dtype, path: tuple, parameters: Parameters, free_passes: bool = False
) -> Materials:
    """Materials of the shapes whose bsdfs are given.

    path: where the materials will be in the scene; parameters: to enter those of bsdfs and textures.
    free_passes: whether going straight on through a surface is no bounce.
    """
    if free_passes:
        made = {each: each.kind.with_free_passes(each) for each in bsdfs}
        bsdfs = [made[each] for each in bsdfs]
    levels = tree.reached(bsdfs)
    present = list(dict.fromkeys(each for level in levels for each in level))
    used = dict.fromkeys(v for each in present for v in each.values.values() if isinstance(v, Instance))
    made, codes = textures.build(list(used), dtype, (*path, "textures"), parameters)
    number, tables, wrappers, held = {None: (-1, 0)}, [], [], []
    for kind, rows in sorted(ordered(present, KINDS).items(), key=lambda item: issubclass(item[0], Wrapper)):
        place, those = ("wrappers", wrappers) if issubclass(kind, Wrapper) else ("tables", tables)
        for variant in sorted({kind.variant(row) for row in rows}):
            alike = [row for row in rows if kind.variant(row) == variant]
            number |= {each: (len(tables) + len(wrappers), row) for row, each in enumerate(alike)}
            those.append(kind.build(alike, dtype, (*path, place, len(those)), parameters, codes.get))
            if those is wrappers:
                held.append(alike)
    wrappers = [
        table.with_column("nodes", np.stack([tree.nodes_of(each, number) for each in rows]))
        for table, rows in zip(wrappers, held, strict=True)
    ]

    def places(of):
        """By level, the wrappers among these."""
        found = [{number[each][0] - len(tables) for each in level if of(each)} for level in levels]
        return tuple(tuple(sorted(level)) for level in found if level)

    code = [[(*number[side], turned) for side, turned in tree.sides(bsdf)] for bsdf in bsdfs]
    width = 3 if wrappers else 2
    sides = np.asarray(np.reshape(code, (-1, 2, 3)), np.int32)[..., :width]
    walked, passing = places(tree.is_wrapper), places(lambda each: tree.is_wrapper(each) and tree.may_pass(each))
    return Materials(tuple(tables), sides, made, tuple(wrappers), walked, passing)


def occurs(materials: Materials, capability: str) -> bool:
    """Whether some kind present is capable of it: "smooth", "delta", ... of `BSDF`, or "moves_paths"."""
    return any(_is(table, capability) for table in (*materials.tables, *materials.wrappers))


def has(materials: Materials, kind: Index, capability: str) -> Bool[Array, ""]:
    """Whether this kind is capable of it, as in `occurs`; where there is no bsdf nothing is."""
    flags = [_is(table, capability) for table in materials.tables]
    if not any(flags):
        return jnp.bool_(False)
    if all(flags):
        return kind >= 0
    return at(jnp.array(flags), jnp.maximum(kind, 0)) & (kind >= 0)


def _is(table: Table, capability: str) -> bool:
    if capability == "moves_paths":
        return any(declared.moves_paths for declared in table.kind.declared.values())
    return table.kind.capable(table, capability)


def moving_bit(materials: Materials, kind: Index, row: Index) -> Index:
    """Bit row % 31 where parameters of the bsdf move paths, else 0."""
    return jnp.where(has(materials, kind, "moves_paths"), jnp.left_shift(jnp.int32(1), row % 31), 0)


def name(materials: Materials, kind: int) -> str:
    """What scene files call a kind that is present, those that hold others after the rest."""
    names = {each: name for name, each in KINDS.items()}
    # A kind that a file does not name is a form of one that it does.
    table = (*materials.tables, *materials.wrappers)[kind]
    return next(names[each] for each in table.kind.__mro__ if each in names)


def reflectances(materials: Materials) -> tuple[int, Column] | None:
    """Kind and reflectances (R, 3) of what sends the same radiance in all directions; None where nothing does."""
    found = [(i, t.column("reflectance")) for i, t in enumerate(materials.tables) if t.kind is Diffuse]
    return found[0] if found else None


def with_fresnel(materials: Materials, fresnel: str) -> Materials:
    """The same, whose kinds that have a choice of `fresnel` reflect by that of FRESNEL."""
    tables = (t.with_setting("fresnel", fresnel) if "fresnel" in dict(t.settings) else t for t in materials.tables)
    return replace(materials, tables=tuple(tables))


def select(materials: Materials, shape: Index, front: Bool[Array, ""]) -> Int[Array, " code"]:
    """Kind and row of the side of a shape, or its node; where there is none, -1, those of some shape."""
    return at(materials.sides, jnp.maximum(shape, 0), jnp.where(front, 0, 1))


def leaf(
    materials: Materials,
    shape: Index,
    surface: Surface,
    frame: Frame,
    wi: Float[Array, "3"],
    u: Float[Array, ""] | None,
    differentiated: bool = False,
) -> tree.Leaf:
    """What scatters at a point of a shape; see `tree.leaf`. u: None where no bsdf holds others."""
    code = select(materials, shape, wi[2] > 0)
    if materials.wrappers:
        return tree.leaf(materials, code, surface, frame, wi, u, differentiated)
    kind, row = code
    return tree.Leaf(kind, row, frame, wi, None, ())


def passing(
    materials: Materials,
    shape: Index,
    surface: Surface,
    cos: Float[Array, ""],
    nudges: Float[Array, "held columns"] | None = None,
) -> Float[Array, ""]:
    """Share of light that a side of a shape lets straight on. cos, nudges: of `tree.passing`."""
    passes = partial(has, materials, capability="passes")
    code = select(materials, shape, cos > 0)
    if materials.wrappers:
        return tree.passing(materials, code, cos, surface, passes, nudges)
    return passes(code[0]).astype(surface.p.dtype)


def is_tree(materials: Materials, shape: Index, front: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether a side of a shape is a bsdf that holds others."""
    return select(materials, shape, front)[0] >= len(materials.tables)


def colors(
    materials: Materials, kind: Index, row: Index, surface: Surface
) -> tuple[Colors | None, tuple[Pairs, ...] | None]:
    """Colours of the textures that a bsdf has at a point, as `Row` takes them; None where no bsdf has any.

    A path asks for them several times, and of all kinds together there are seldom more than one or two. With them, of
    each one, the `Textures.entries`; None where no texture is differentiated.
    """
    textured = [table.textured for table in materials.tables]

    def codes(table, columns):
        found = [at(table.columns[place].texture, row) for place in columns]
        return found + [jnp.full((2,), -1, jnp.int32)] * (most - len(found))

    most = max(map(len, textured), default=0)
    if not most:
        return None, None
    calls = [partial(codes, *each) for each in zip(materials.tables, textured, strict=True)]
    found = compute_once(calls[0]() if len(calls) == 1 else lax.switch(jnp.maximum(kind, 0), calls))
    if not materials.listed:
        return tuple(materials.textures.look_up(code, surface) for code in found), None
    pairs = [materials.textures.with_entries(code, surface, dict(materials.listed)) for code in found]
    return tuple(zip(*pairs, strict=True))


def evaluate(
    materials: Materials,
    kind: Index,
    row: Index,
    surface: Surface,
    wi: Float[Array, "3"],
    wo: Float[Array, "3"],
    colors: Colors | None = None,
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """f |cos theta_o| and pdf of a smooth bsdf; 0 for the others. colors: of `colors`, if they are known already."""
    smooth = [(i, table) for i, table in enumerate(materials.tables) if table.kind.smooth]

    def of(table):
        return lambda: table.kind.evaluate(Row(table, row, surface, materials.textures, colors), wi, wo)

    if not smooth:
        return jnp.zeros_like(wi), jnp.zeros_like(wi[2])
    if len(smooth) == 1:
        return of(smooth[0][1])()
    index = sum((kind >= i).astype(jnp.int32) for i, _ in smooth[1:])
    return lax.switch(index, [of(table) for _, table in smooth])


def sample(
    materials: Materials,
    kind: Index,
    row: Index,
    surface: Surface,
    wi: Float[Array, "3"],
    u: Float[Array, " numbers"],
    colors: Colors | None = None,
) -> BSDFSample:
    """Draw `wo` and its weight from the bsdf.

    u: 2 numbers, or 3 where a kind with `lobes` is present; colors: of `colors`, if they are known already.
    """

    def of(table):
        return lambda: table.kind.sample(Row(table, row, surface, materials.textures, colors), wi, _numbers(table, u))

    if len(materials.tables) == 1:
        return of(materials.tables[0])()
    return lax.switch(jnp.maximum(kind, 0), [of(table) for table in materials.tables])


def sample_other(
    materials: Materials, row: Index, surface: Surface, wi: Float[Array, "3"], u: Float[Array, " numbers"]
) -> BSDFSample:
    """The branch that `sample` leaves out, of a kind that `branches`."""
    table = next(table for table in materials.tables if table.kind.branches)
    return table.kind.sample(Row(table, row, surface, materials.textures), wi, _numbers(table, u), other=True)


def _numbers(table: Table, u: Float[Array, " numbers"]) -> Float[Array, " its_numbers"]:
    """Those that a kind takes: 2, or 3 of one that has `lobes`."""
    return u if table.kind.lobes or len(u) == 2 else u[:2]
