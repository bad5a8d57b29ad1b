"""How surfaces scatter light: one file per kind, the table of kinds, and the dispatch over the kinds in a scene.

A bsdf is a subclass of `BSDF`, which defines the methods that it implements and the capabilities that it may have. A
material has a front and a back. Each is a bsdf, given by its kind (the index of a table) and its row in that table, or
nothing, which absorbs. Bsdfs of one class with different settings are in different tables. Where bsdfs hold others, a
material is a tree, and `leaf` walks to the bsdf that scatters.
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

# Kinds by their names in scene files.
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
# Index of the table of a kind, of a row in it, or of a shape; -1: none.
Index = Int[Array, ""]
# The colour looked up for each entry of `Table.textured`.
Colors = tuple[Float[Array, "3"], ...]
FRESNEL = Dielectric.fresnel.options


def register(name: str):
    """Return a decorator that registers a subclass of `BSDF` as a kind, which scene files call `name`."""
    return register_kind(KINDS, BSDF, name, "bsdfs")


@register_dataclass
@dataclass(frozen=True)
class Materials:
    tables: tuple[Table, ...]  # one for each kind of bsdf present
    sides: Int[Array, "S 2 code"]  # front, back per shape: kind (-1: absorbs) and row; with wrappers a `tree.Node`
    textures: Textures | None  # of textured parameters; None: there are none
    # Tables of the kinds that hold others. For each depth of the trees, the indices of the wrappers that may occur
    # there on the way to any leaf (`levels`), and to a leaf that passes light (`passing`). All empty without wrappers.
    wrappers: tuple[Table, ...] = ()
    levels: tuple[tuple[int, ...], ...] = field(default=(), metadata={"static": True})
    passing: tuple[tuple[int, ...], ...] = field(default=(), metadata={"static": True})
    # For derivatives: `first` of `Textures.entries`, as items: where the entries of differentiated textures begin.
    listed: tuple[tuple[tuple[int, int | str], int], ...] = field(default=(), metadata={"static": True})
    # For derivatives: per wrapper, the columns in which `leaf` returns the derivative of its weight; empty: none.
    recorded: tuple[tuple[int | None, ...], ...] = field(default=(), metadata={"static": True})
    # For derivatives: index of the surface along a shadow ray whose `passing` is nudged, and the nudges.
    nudged: tuple[Int[Array, ""], Float[Array, "held columns"]] | None = None


def build(
    bsdfs: list[Instance], dtype, path: tuple, parameters: Parameters, free_passes: bool = False
) -> Materials:
    """Build the materials of shapes.

    Args:
        bsdfs: one per shape.
        path: location of the materials in the scene.
        parameters: receives the parameters of bsdfs and textures.
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
        """Return the indices of the wrappers that satisfy `of`, by level; empty levels are left out."""
        found = [{number[each][0] - len(tables) for each in level if of(each)} for level in levels]
        return tuple(tuple(sorted(level)) for level in found if level)

    code = [[(*number[side], turned) for side, turned in tree.sides(bsdf)] for bsdf in bsdfs]
    width = 3 if wrappers else 2
    sides = np.asarray(np.reshape(code, (-1, 2, 3)), np.int32)[..., :width]
    walked, passing = places(tree.is_wrapper), places(lambda each: tree.is_wrapper(each) and tree.may_pass(each))
    return Materials(tuple(tables), sides, made, tuple(wrappers), walked, passing)


def occurs(materials: Materials, capability: str) -> bool:
    """Return whether some kind present has a capability: "smooth", "delta", ... of `BSDF`, or "moves_paths"."""
    return any(_capable(table, capability) for table in (*materials.tables, *materials.wrappers))


def has(materials: Materials, kind: Index, capability: str) -> Bool[Array, ""]:
    """Return whether a kind has a capability, as in `occurs`; False where there is no bsdf."""
    flags = [_capable(table, capability) for table in materials.tables]
    if not any(flags):
        return jnp.bool_(False)
    if all(flags):
        return kind >= 0
    return at(jnp.array(flags), jnp.maximum(kind, 0)) & (kind >= 0)


def _capable(table: Table, capability: str) -> bool:
    if capability == "moves_paths":
        return any(declared.moves_paths for declared in table.kind.declared.values())
    return table.kind.capable(table, capability)


def moving_bit(materials: Materials, kind: Index, row: Index) -> Index:
    """Return a mask with bit row % 31 set where parameters of the bsdf move paths, else 0."""
    return jnp.where(has(materials, kind, "moves_paths"), jnp.left_shift(jnp.int32(1), row % 31), 0)


def name(materials: Materials, kind: int) -> str:
    """Return the name in scene files of a kind present; wrappers are numbered after the other tables."""
    names = {each: name for name, each in KINDS.items()}
    # A kind without a name of its own is a subclass of one that has a name.
    table = (*materials.tables, *materials.wrappers)[kind]
    return next(names[each] for each in table.kind.__mro__ if each in names)


def reflectances(materials: Materials) -> tuple[int, Column] | None:
    """Return kind and reflectances (R, 3) of the bsdfs whose radiance is the same in all directions; None: no such."""
    found = [(i, t.column("reflectance")) for i, t in enumerate(materials.tables) if t.kind is Diffuse]
    return found[0] if found else None


def with_fresnel(materials: Materials, fresnel: str) -> Materials:
    """Return the materials with the setting `fresnel`, one of FRESNEL, in all kinds that have this setting."""
    tables = (t.with_setting("fresnel", fresnel) if "fresnel" in dict(t.settings) else t for t in materials.tables)
    return replace(materials, tables=tuple(tables))


def select(materials: Materials, shape: Index, front: Bool[Array, ""]) -> Int[Array, " code"]:
    """Return kind and row of a side of a shape, or its node; for shape -1 (none) those of an arbitrary shape."""
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
    """Return the bsdf that scatters at a point of a shape; see `tree.leaf`. u: None where no bsdf holds others."""
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
    """Return the share of light that a side of a shape lets straight on. cos, nudges: those of `tree.passing`."""
    passes = partial(has, materials, capability="passes")
    code = select(materials, shape, cos > 0)
    if materials.wrappers:
        return tree.passing(materials, code, cos, surface, passes, nudges)
    return passes(code[0]).astype(surface.p.dtype)


def is_tree(materials: Materials, shape: Index, front: Bool[Array, ""]) -> Bool[Array, ""]:
    """Return whether the bsdf on a side of a shape holds others."""
    return select(materials, shape, front)[0] >= len(materials.tables)


def colors(
    materials: Materials, kind: Index, row: Index, surface: Surface
) -> tuple[Colors | None, tuple[Pairs, ...] | None]:
    """Look up the textures of a bsdf at a point.

    A path reads the colours several times. All kinds together seldom need more than one or two.

    Returns:
        The colours, as `Row` takes them; None where no bsdf has textures.
        The `Textures.entries` of each colour; None where no texture is differentiated.
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
    """Return f |cos theta_o| and pdf of a smooth bsdf.

    For other kinds the values are arbitrary; they are 0 if no smooth kind is present.

    colors: from `colors`, if they are known already.
    """
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
    """Sample `wo` and its weight.

    Args:
        u: 2 numbers, or 3 where a kind with `lobes` is present.
        colors: from `colors`, if they are known already.
    """

    def of(table):
        return lambda: table.kind.sample(Row(table, row, surface, materials.textures, colors), wi, _numbers(table, u))

    if len(materials.tables) == 1:
        return of(materials.tables[0])()
    return lax.switch(jnp.maximum(kind, 0), [of(table) for table in materials.tables])


def sample_other(
    materials: Materials, row: Index, surface: Surface, wi: Float[Array, "3"], u: Float[Array, " numbers"]
) -> BSDFSample:
    """Return the branch that `sample` does not draw, of the kind that `branches`."""
    table = next(table for table in materials.tables if table.kind.branches)
    return table.kind.sample(Row(table, row, surface, materials.textures), wi, _numbers(table, u), other=True)


def _numbers(table: Table, u: Float[Array, " numbers"]) -> Float[Array, " its_numbers"]:
    """Return the random numbers that a kind takes: 2, or 3 if it has `lobes`."""
    return u if table.kind.lobes or len(u) == 2 else u[:2]
