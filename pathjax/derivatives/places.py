"""Which entries of the list of `differentiated` a vertex looks up for each slot, and the weight (share) of each."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax import emitters, media
from pathjax.core.math import at
from pathjax.core.types import EmitterSample, Hit, Ray
from pathjax.derivatives.differentiated import (
    BSDFS,
    TEXTURES,
    WRAPPERS,
    Paths,
    Slots,
    declared,
    firsts,
    in_textures,
    path_of_grid,
)
from pathjax.emitters import Choice
from pathjax.integrators.random_numbers import Bounce
from pathjax.integrators.shadow import Dimmed, Passed
from pathjax.integrators.vertex import Vertex
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry
from pathjax.textures import Pairs, alike

# Of one value: indices in the list, and their shares; None: there is one index, of share 1.
Entries = tuple[tuple[Int[Array, ""], ...], tuple[Float[Array, "..."], ...] | None]


def of_bsdf(scene: Scene, paths: Paths, slots: Slots, slot: int, here: Vertex) -> Entries:
    """Return the entries that the bsdf of a vertex looks up for a slot; arbitrary ones if it looks up none."""
    first, _ = firsts(scene, paths)
    found = [
        partial(_of_row, scene, first, (*BSDFS, number), columns[slot], here.row, TEXTURES, here.surface, here.entries)
        for number, columns in enumerate(slots.bsdfs)
    ]
    calls = alike(found, here.wi.dtype)
    pairs = calls[0]() if len(calls) == 1 else lax.switch(jnp.maximum(here.kind, 0), calls)
    return _entries(pairs, whole=not in_textures(scene, paths, TEXTURES))


def by_choices(slots: Slots, here: Vertex) -> Float[Array, " slots"]:
    """Return the derivatives of `here.weight` in the slots of choices."""

    def of(step, number):
        others = (each.factor for other, each in enumerate(here.chosen) if other != step)
        return math.prod(others, start=here.chosen[step].by[number])

    return jnp.stack([of(step, number) for step, _, number in slots.choices])


def of_choice(scene: Scene, paths: Paths, slots: Slots, slot: int, here: Vertex) -> Entries:
    """Return the entries for a slot of `by_choices`."""
    first, _ = firsts(scene, paths)
    step, place, number = slots.choices[slot]
    column, row = slots.wrappers[place][number], here.chosen[step].row
    call = partial(_of_row, scene, first, (*WRAPPERS, place), column, row, TEXTURES, here.surface)
    return _entries(alike([call], here.wi.dtype)[0](), whole=not in_textures(scene, paths, TEXTURES))


def of_passed(scene: Scene, paths: Paths, slots: Slots, slot: int, passed: Passed) -> Entries:
    """Return the entries for a slot at a surface that a shadow ray passes."""
    place, number = divmod(slot, len(slots.wrappers[0]))
    kind, row = passed.held[place]
    first, _ = firsts(scene, paths)
    place = kind - len(scene.materials.tables)

    def of(i, columns):
        mine = jnp.where(place == i, row, 0)
        return lambda: _of_row(scene, first, (*WRAPPERS, i), columns[number], mine, TEXTURES, passed.surface)

    calls = alike([of(*each) for each in enumerate(slots.wrappers)], passed.surface.p.dtype)
    pairs = calls[0]() if len(calls) == 1 else lax.switch(jnp.maximum(place, 0), calls)
    return _entries(pairs, whole=not in_textures(scene, paths, TEXTURES))


def of_grid(
    scene: Scene,
    paths: Paths,
    nudge: str,
    medium: Int[Array, ""],
    ray: Ray,
    end: Float[Array, ""],
    u: Bounce,
    shadow: Dimmed,
) -> Entries:
    """Return the entries looked up in a grid for a nudge; shares are times the length that a point stands for.

    Args:
        nudge: name of a field of `media.Nudges`.
        medium: of the flight along the ray to its end.
        shadow: point on the shadow ray of the light sample.
    """
    path = path_of_grid(nudge)
    values, first, length = named.get(scene, path[:-1]), firsts(scene, paths)[0][path], 1
    if nudge == "depth":
        p, length = media.on_the_way(scene.media, medium, ray, end, u.along[0])
    elif nudge == "shadow":
        medium, p, length = shadow.medium, shadow.p, shadow.length
    else:
        p = ray.o + jnp.where(end < jnp.inf, end, 0) * ray.d  # without a particle any point will do: derivative 0
    places, shares = zip(*media.entries(values, medium, p), strict=True)
    return tuple(first + place for place in places), tuple(length * share for share in shares)


def of_hit(scene: Scene, paths: Paths, slots: Slots, slot: int, ray: Ray, hit: Hit, here: Vertex | None) -> Entries:
    """Return the entries that the light hit by a ray looks up for a slot; arbitrary ones if it hits none."""
    first, _ = firsts(scene, paths)
    found, starts, number = [partial(_of_background, scene, first, slots, slot, ray.d)], [], jnp.int32(0)
    if here is not None:
        number, start = jnp.maximum(at(scene.geometry.light, jnp.maximum(hit.primitive, 0)), 0), 0
        for i, lights in enumerate(scene.emitters):
            if lights.lamps is not None:
                starts.append(start)
                found.append(partial(_of_light, scene, first, slots, slot, i, number - start, here.surface))
                start += lights.count
    sky, *calls = alike(found, ray.d.dtype)
    if not calls:
        pairs = sky()
    else:
        pairs = lax.cond(hit.primitive < 0, sky, lambda: geometry.switch_by_range(number, starts, calls))
    return _entries(pairs, _whole(scene, paths))


def of_light_sample(
    scene: Scene, choice: Choice, paths: Paths, slots: Slots, slot: int, here: Vertex, u: Bounce
) -> Entries:
    """Return the entries that a sampled light looks up for a slot; arbitrary ones if it looks up none."""
    first, _ = firsts(scene, paths)
    number, _, _ = emitters.choose(choice, here.surface.p, u.light)
    whole, behind = _whole(scene, paths), emitters.backgrounds(scene.emitters)
    drawn = None
    if not whole:
        drawn = emitters.sample(scene.emitters, scene.geometry, choice, here.surface.p, u.light, u.triangle)
    starts, found = [], []
    for i, (lights, start) in enumerate(zip(scene.emitters, choice.first, strict=True)):
        if start is None:
            continue
        starts.append(start)
        if i in behind:
            found.append(partial(_of_background, scene, first, slots, slot, drawn and drawn.d))
        else:
            there = None if drawn is None or lights.textures is None else _lit(scene, i, number - start, here, drawn)
            found.append(partial(_of_light, scene, first, slots, slot, i, number - start, there))
    pairs = geometry.switch_by_range(number, starts, alike(found, here.wi.dtype))
    return _entries(pairs, whole)


def _whole(scene: Scene, paths: Paths) -> bool:
    """Return whether each value that a light looks up is one entry, and not a sum of several."""
    own = {("emitters", i, "table") for i in range(len(scene.emitters))}  # not the table of a texture
    return all(path[:3] in own and not declared(scene, path).shared for path in paths if path[0] == "emitters")


def _lit(scene: Scene, number: int, light: Int[Array, ""], here: Vertex, drawn: EmitterSample):
    """Return the surface point, or just its uv, at which a sampled light looks up its textures."""
    lights = scene.emitters[number]
    if not lights.kind.on_surfaces:
        return SimpleNamespace(uv=lights.kind.uv(lights.parameters(light), drawn.d))
    ray = Ray(here.surface.p, drawn.d, drawn.distance, jnp.int32(-1))
    return geometry.surface(scene.geometry, ray, Hit(drawn.distance, drawn.primitive, jnp.int32(0)))


def _of_light(scene: Scene, first: dict, slots: Slots, slot: int, number: int, light, surface) -> Pairs:
    lights, columns, path = scene.emitters[number], slots.lights[number], ("emitters", number)
    row = light if lights.row is None else at(lights.row, light)
    column = columns[slot] if slot < len(columns) else None
    return _of_row(scene, first, (*path, "table"), column, row, (*path, "textures"), surface)


def _of_background(scene: Scene, first: dict, slots: Slots, slot: int, d) -> Pairs:
    if slot >= len(slots.backgrounds):
        return ()
    number, row, column = slots.backgrounds[slot]
    path, lights = ("emitters", number, "table"), scene.emitters[number]
    name = list(lights.kind.declared)[column]
    if not lights.kind.declared[name].shared:
        return _of_row(scene, first, path, column, row, None, None)
    begins = first[(*path, "columns", column, "values")]
    parts = lights.kind.entries(lights.parameters(row), d)
    return tuple((begins + entry, share) for each, entry, share in parts if each == name)


def _of_row(scene: Scene, first: dict, path: tuple, column: int | None, row, of_textures, surface, known=None) -> Pairs:
    """Return the Pairs of a column of the table at `path`, or of its texture at `of_textures`, looked up on a surface.

    known: Pairs of the textures where the vertex has them, for each of `Table.textured`.
    """
    if column is None:
        return ()
    table = named.get(scene, path)
    values, codes = (getattr(table.columns[column], each) for each in ("values", "texture"))
    begins = first.get((*path, "columns", column, "values"))
    constant = () if begins is None else ((jnp.int32(begins + row), jnp.ones((), values.dtype)),)
    if codes is None or not (wanted := in_textures(scene, first, of_textures)):
        return constant
    code, wanted = at(codes, row), {key: first[each] for key, each in wanted.items()}

    def textured():
        if known is not None:
            return known[table.textured.index(column)]
        return named.get(scene, of_textures).entries(code, surface, wanted)

    return lax.cond(code[0] >= 0, *alike([textured, lambda: constant], values.dtype))


def _entries(pairs: Pairs, whole: bool) -> Entries:
    """Return Pairs as Entries. whole: each value is one entry."""
    places, shares = zip(*pairs, strict=True)
    return places, None if whole else shares
