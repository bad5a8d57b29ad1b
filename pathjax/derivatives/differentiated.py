"""What is differentiated: the arrays, the one list of their entries, and the slots of a vertex.

The list holds the entries of all differentiated arrays, one array after another. An entry is a constant's row or a
texel. A vertex of a path looks up a few values, each of which is one entry or the weighted sum of several (of four
texels, say). A slot is one such value: the first colour that a bsdf looks up, or the second, or the first scalar,
whatever the kind of the bsdf.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax import emitters
from pathjax.bsdfs import tree
from pathjax.kinds import Declared, Parameter
from pathjax.media import Nudges
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Paths in the scene to the differentiated arrays.
Paths = tuple[tuple, ...]
# Fields of bsdfs and lights in which differentiated textures stand; None: possibly all.
Fields = frozenset[str] | None
# The column that each slot looks up; None: none.
Columns = tuple[int | None, ...]

# Values of grids of media -> the fields of `media.Nudges` that nudge them.
GRIDS = {
    ("media", "extinctions", "values"): ("extinction", "depth", "shadow"),
    ("media", "albedos", "values"): ("albedo",),
}
BSDFS, WRAPPERS, TEXTURES = (("materials", each) for each in ("tables", "wrappers", "textures"))


@dataclass(frozen=True)
class Slots:
    """What each slot looks up. Slots of bsdfs for colours come before those for scalars."""

    bsdfs: tuple[Columns, ...]  # per table
    lights: tuple[Columns, ...]  # per table; empty for backgrounds
    backgrounds: tuple[tuple[int, int, int], ...]  # (table, row, column) of all: a ray that escapes meets all of them
    colors: int  # number of slots of bsdfs that are colours
    wrappers: tuple[Columns, ...]  # per table of bsdfs that hold others
    choices: tuple[tuple[int, int, int], ...]  # (index in `tree.steps`, wrapper there, index of the wrapper's column)
    on_the_way: int  # nodes that `tree.on_the_way` returns; each has a slot per column
    by_luminance: bool  # whether a bsdf may look up a texture as a scalar, by its luminance
    corners: bool  # whether mesh attributes are differentiated
    grids: tuple[str, ...]  # differentiated fields of `media.Nudges`

    @property
    def of_bsdfs(self) -> int:
        return max(map(len, self.bsdfs), default=0)

    @property
    def of_choices(self) -> int:
        return len(self.choices)

    @property
    def of_passed(self) -> int:
        return self.on_the_way * max(map(len, self.wrappers), default=0)

    @property
    def of_lights(self) -> int:
        return max([len(self.backgrounds), *map(len, self.lights)])

    def numbered(self) -> list[range]:
        """Index ranges of the slots of bsdfs, lights, choices among bsdfs, passed surfaces and grids, in one count."""
        counts = self.of_bsdfs, self.of_lights, self.of_choices, self.of_passed, len(self.grids)
        return [range(*each) for each in pairwise(accumulate(counts, initial=0))]


# ---- what is differentiated -----------------------------------------------------------------------------------------


def tables_of_textures(scene: Scene, path: tuple) -> list[tuple]:
    """Return the paths of the tables of the textures at a path."""
    textures = named.get(scene, path)
    return [(*path, "tables", i) for i in range(len(textures.tables))] if textures else []


def paths(scene: Scene) -> set[tuple]:
    """Return the paths of all differentiable arrays: all but those of textures and backgrounds without `entries`."""
    tables = [(*BSDFS, i) for i in range(len(scene.materials.tables))] + [(*WRAPPERS, i) for i in _choosing(scene)]
    covers = tables_of_textures(scene, TEXTURES)
    for i in range(len(scene.emitters)):
        tables.append(("emitters", i, "table"))
        covers += tables_of_textures(scene, ("emitters", i, "textures"))

    def has_entries(path):
        return named.get(scene, path).kind.has_entries()

    found = {path for table in filter(has_entries, covers) for path in _columns(scene, table)}
    for table in tables:
        found |= {p for p in _columns(scene, table) if not declared(scene, p).shared or has_entries(table)}
    shapes = enumerate(scene.geometry.tables)
    found |= {path for path in GRIDS if scene.media is not None and named.get(scene, path[:-1]) is not None}
    return found | {("geometry", "tables", i, "attributes", name) for i, each in shapes for name in each.attributes}


def _choosing(scene: Scene) -> list[int]:
    """Return the wrappers whose parameters affect the choice among the bsdfs that they hold."""
    return [i for i, table in enumerate(scene.materials.wrappers) if table.kind.chooses]


def _columns(scene: Scene, table: tuple) -> dict[tuple, int]:
    """Return, for the columns of a table, path to the values -> index of the column."""
    columns = named.get(scene, table).columns
    return {(*table, "columns", i, "values"): i for i, column in enumerate(columns) if column is not None}


def in_textures(scene: Scene, paths: Iterable[tuple], of_textures: tuple) -> dict[tuple[int, int | str], tuple]:
    """Return the paths of the arrays that textures look up, by (table, column or name of a mesh attribute)."""
    found: dict[tuple[int, int | str], tuple] = {}
    for number, path in enumerate(tables_of_textures(scene, of_textures)):
        table = named.get(scene, path)
        found |= {(number, place): column for column, place in _columns(scene, path).items() if column in paths}
        names = table.kind.attributes(dict(table.settings))
        found |= {(number, each[-1]): each for each in paths if each[0] == "geometry" and each[-1] in names}
    return found


def places_of_textures(parameters: Iterable[Parameter]) -> Fields:
    """Return the fields in which those of the parameters stand that are textures or belong to textures."""
    places = [each.stands_in for each in parameters if _is_looked_up_by_textures(each.path)]
    return None if None in places else frozenset().union(*places)


def _is_looked_up_by_textures(path: tuple) -> bool:
    of_bsdfs, of_lights = path[:2] == TEXTURES, path[2:3] == TEXTURES[1:]
    return of_bsdfs or of_lights or path[0] == "geometry"


def slots(scene: Scene, paths: Paths, fields: Fields) -> Slots:
    """Return the slots. fields: as returned by `places_of_textures`."""

    def looked_up(table, textures):
        """Return the differentiated columns of a table that hold colours, and those that hold scalars."""
        columns, by_textures = named.get(scene, table).columns, filled(table, in_textures(scene, paths, textures))
        found = [i for path, i in _columns(scene, table).items() if path in paths or i in by_textures]
        return [i for i in found if columns[i].values.ndim > 1], [i for i in found if columns[i].values.ndim == 1]

    def filled(table, textures):
        """Return the columns of a table that may look up one of these textures."""
        held = named.get(scene, table)
        may_be = [fields is None or name in fields for name in held.kind.declared]
        looks_up = [column is not None and column.texture is not None for column in held.columns]
        return [i for i in range(len(looks_up)) if textures and may_be[i] and looks_up[i]]

    def joined(found):
        """Return the columns per table, scalars after as many colours as any table has; and how many that are."""
        most, numbers = (max(map(len, each), default=0) for each in zip(*found, strict=True)) if found else (0, 0)

        def filled(columns, count):
            return (*columns, *[None] * (count - len(columns)))

        return tuple(filled(c, most) + filled(n, numbers) for c, n in found), most

    choosing, count = _choosing(scene), len(scene.materials.wrappers)
    wrappers, _ = joined([looked_up((*WRAPPERS, i), TEXTURES) if i in choosing else ([], []) for i in range(count)])
    wrappers = wrappers if any(map(len, wrappers)) else ()
    bsdfs, colors = joined([looked_up((*BSDFS, i), TEXTURES) for i in range(len(scene.materials.tables))])
    of_lights = [looked_up(("emitters", i, "table"), ("emitters", i, "textures")) for i in range(len(scene.emitters))]
    behind = emitters.backgrounds(scene.emitters)
    lights = tuple(() if i in behind else (*each[0], *each[1]) for i, each in enumerate(of_lights))
    backgrounds = [
        (i, row, column) for i in behind for column in sum(of_lights[i], []) for row in range(scene.emitters[i].count)
    ]
    choices = tuple(
        (step, place, number)
        for step, place in enumerate(tree.steps(scene.materials) if wrappers else ())
        for number, column in enumerate(wrappers[place])
        if column is not None
    )
    met = {place for level in scene.materials.passing for place in level if wrappers}
    passed = any(column is not None for place in met for column in wrappers[place])
    on_the_way = tree.most_on_the_way(scene.materials) if passed else 0
    texels = in_textures(scene, paths, TEXTURES)
    scattering = [(*BSDFS, i) for i in range(len(scene.materials.tables))] + [(*WRAPPERS, i) for i in choosing]
    by_luminance = any(
        named.get(scene, table).columns[i].values.ndim == 1 for table in scattering for i in filled(table, texels)
    )
    corners = any(path[0] == "geometry" for path in paths)
    of_scattering = () if scene.scatters else ("extinction", "albedo")
    grids = tuple(n for path, nudges in GRIDS.items() if path in paths for n in nudges if n not in of_scattering)
    backgrounds = tuple(backgrounds)
    return Slots(bsdfs, lights, backgrounds, colors, wrappers, choices, on_the_way, by_luminance, corners, grids)


def prepared(scene: Scene, paths: Paths, slots: Slots, number: Int[Array, ""]) -> Scene:
    """Return the scene set up so that vertices report what derivatives need.

    number: index of the one surface passed by a shadow ray that is differentiated.
    """
    first, _ = firsts(scene, paths)
    listed = tuple((key, first[path]) for key, path in in_textures(scene, paths, TEXTURES).items())
    materials = replace(scene.materials, recorded=slots.wrappers, listed=listed)
    if slots.on_the_way:
        none = jnp.zeros((slots.on_the_way, len(slots.wrappers[0])), scene.camera.origin.dtype)
        materials = replace(materials, nudged=(number, none))
    scene = replace(scene, materials=materials, geometry=replace(scene.geometry, corners=slots.corners))
    return _with_grids_nudged(scene, slots, [jnp.zeros_like(scene.camera.origin[0])] * len(slots.grids))


def nudged(scene: Scene, slots: Slots, nudges: Float[Array, " slots"]) -> Scene:
    """Return the scene in which each slot's value is increased by its nudge, in all channels.

    Slots of choices are left unchanged: `places.by_choices` has their derivatives.
    """
    of_bsdfs, of_lights, _, of_passed, of_grids = slots.numbered()

    def of(table, columns, nudges):
        return table.nudged({column: nudges[s] for s, column in enumerate(columns) if column is not None})

    own = [nudges[of_bsdfs.start :]] * len(slots.bsdfs)
    materials = replace(scene.materials, tables=tuple(map(of, scene.materials.tables, slots.bsdfs, own)))
    if of_passed:
        number, none = materials.nudged
        materials = replace(materials, nudged=(number, nudges[of_passed.start :].reshape(none.shape)))
    beyond = nudges[of_lights.start :]
    tables = [of(each.table, columns, beyond) for each, columns in zip(scene.emitters, slots.lights, strict=True)]
    for s, (i, row, column) in enumerate(slots.backgrounds):
        nudge = tables[i].columns[column].nudge
        nudge = jnp.zeros((scene.emitters[i].count,), beyond.dtype) if nudge is None else nudge
        tables[i] = tables[i].nudged({column: nudge.at[row].set(beyond[s])})
    lights = tuple(replace(each, table=table) for each, table in zip(scene.emitters, tables, strict=True))
    scene = replace(scene, materials=materials, emitters=lights)
    return _with_grids_nudged(scene, slots, [nudges[k] for k in of_grids])


def _with_grids_nudged(scene, slots, nudges):
    if not slots.grids:
        return scene
    return replace(scene, media=replace(scene.media, nudges=Nudges(**dict(zip(slots.grids, nudges, strict=True)))))


# ---- the list -------------------------------------------------------------------------------------------------------


def firsts(scene: Scene, paths: Paths) -> tuple[dict[tuple, int], int]:
    """Return the index in the list at which each array begins, and the length of the list."""
    ends = np.cumsum([0, *(count(scene, path) for path in paths)]).tolist()
    return dict(zip(paths, ends[:-1], strict=True)), ends[-1]


def count(scene: Scene, path: tuple) -> int:
    """Return the number of entries of an array: of its colours, or of its scalars."""
    array = named.get(scene, path)
    if not of_colors(scene, path):
        return array.size
    return array.size // (array.shape[-1] if array.ndim > 1 else 3)


def path_of_grid(nudge: str) -> tuple:
    """Return the path to the grid values that a nudge stands for."""
    return next(path for path, nudges in GRIDS.items() if nudge in nudges)


def of_colors(scene: Scene, path: tuple) -> bool:
    """Return whether an array holds colours; else it holds scalars."""
    array = named.get(scene, path)
    if array.ndim > 1:
        return array.shape[-1] == 3 or may_be_wider(scene, path)
    known = declared(scene, path)
    return known.shared and known.colors


def is_color_and_number(scene: Scene, parameter: Parameter) -> bool:
    """Return whether colours may be used as colours in one place and by their luminance in another."""
    if not parameter.is_color:
        return False
    return slots(scene, (parameter.path,), places_of_textures([parameter])).by_luminance


def may_be_wider(scene: Scene, path: tuple) -> bool:
    """Return whether the rows of an array may have further numbers after their colours."""
    if "columns" not in path:
        return False
    known = declared(scene, path)
    return known.shared and known.wider


def declared(scene: Scene, path: tuple) -> Declared:
    """Return the declaration of the parameter whose column is at a path."""
    *table, _, column, _ = path
    return list(named.get(scene, table).kind.declared.values())[column]
