"""Where the numbers that a vertex looks up stand in the list of `differentiated`, by slot, and the share of each."""

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

# Of one number: places in the list, and their shares where there are several.
Entries = tuple[tuple[Int[Array, ""], ...], tuple[Float[Array, "..."], ...] | None]


def of_bsdf(scene: Scene, paths: Paths, slots: Slots, slot: int, here: Vertex) -> Entries:
    """Entries of the number that the bsdf of a vertex looks up for a slot; of any, where it looks up none."""
    first, _ = firsts(scene, paths)
    found = [
        partial(_of_row, scene, first, (*BSDFS, number), columns[slot], here.row, TEXTURES, here.surface, here.entries)
        for number, columns in enumerate(slots.bsdfs)
    ]
    calls = alike(found, here.wi.dtype)
    pairs = calls[0]() if len(calls) == 1 else lax.switch(jnp.maximum(here.kind, 0), calls)
    return _entries(pairs, whole=not in_textures(scene, paths, TEXTURES))


def by_choices(slots: Slots, here: Vertex) -> Float[Array, " slots"]:
    """Derivatives of `here.weight` in the numbers of the wrappers that were chosen from."""

    def of(step, number):
        others = (each.factor for other, each in enumerate(here.chosen) if other != step)
        return math.prod(others, start=here.chosen[step].by[number])

    return jnp.stack([of(step, number) for step, _, number in slots.choices])


def of_choice(scene: Scene, paths: Paths, slots: Slots, slot: int, here: Vertex) -> Entries:
    """Entries of a number of `by_choices`."""
    first, _ = firsts(scene, paths)
    step, place, number = slots.choices[slot]
    column, row = slots.wrappers[place][number], here.chosen[step].row
    call = partial(_of_row, scene, first, (*WRAPPERS, place), column, row, TEXTURES, here.surface)
    return _entries(alike([call], here.wi.dtype)[0](), whole=not in_textures(scene, paths, TEXTURES))


def of_passed(scene: Scene, paths: Paths, slots: Slots, slot: int, passed: Passed) -> Entries:
    """Entries of a number that is looked up at a surface that a shadow ray passes."""
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
    """Entries of what is looked up in a grid for a nudge, times the length that a point stands for.

    Args:
        medium: of the flight along the ray to its end.
        shadow: on the way of the light sample.
    """
    path = path_of_grid(nudge)
    values, first, length = named.get(scene, path[:-1]), firsts(scene, paths)[0][path], 1
    if nudge == "depth":
        p, length = media.on_the_way(scene.media, medium, ray, end, u.along[0])
    elif nudge == "shadow":
        medium, p, length = shadow.medium, shadow.p, shadow.length
    else:
        p = ray.o + jnp.where(end < jnp.inf, end, 0) * ray.d  # where there is no particle, nothing changes with it
    places, shares = zip(*media.entries(values, medium, p), strict=True)
    return tuple(first + place for place in places), tuple(length * share for share in shares)


def of_hit(scene: Scene, paths: Paths, slots: Slots, slot: int, ray: Ray, hit: Hit, here: Vertex | None) -> Entries:
    """Entries of the number that the light looks up that a ray meets; of any, where it meets none."""
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
    """Entries of the number that a sampled light looks up; of any, where it looks up none."""
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
    """Whether each number that a light looks up is one entry, and not the sum of some."""
    own = {("emitters", i, "table") for i in range(len(scene.emitters))}  # else a texture's
    return all(path[:3] in own and not declared(scene, path).shared for path in paths if path[0] == "emitters")


def _lit(scene: Scene, number: int, light: Int[Array, ""], here: Vertex, drawn: EmitterSample):
    """Where a sampled light looks up its textures."""
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
    """Pairs of a column of the table at a path, and of the textures at another one, looked up on a surface.

    known: what was found of the textures already, for each of `Table.textured`.
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
    """whole: each number is one entry."""
    places, shares = zip(*pairs, strict=True)
    return places, None if whole else shares
