"""Where light comes from: one file per kind, the table of kinds, and the dispatch over the kinds in a scene.

An emitter is a subclass of `SurfaceEmitter`, `Background` or `DiracEmitter`, which define the methods that it
implements. Lights are numbered through all tables: first those on surfaces, to which `Geometry.light` refers, then
other near ones, then distant ones.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pathjax import textures
from pathjax.core.math import at, dot, larger
from pathjax.core.types import EmitterSample, Hit, Ray, Surface
from pathjax.emitters import light_tree
from pathjax.emitters.area import Area
from pathjax.emitters.constant import Constant
from pathjax.emitters.directional import Directional
from pathjax.emitters.emitter import Background, DiracEmitter, Emitter, SurfaceEmitter
from pathjax.emitters.envmap import Envmap
from pathjax.emitters.point import Point
from pathjax.emitters.projector import Projector
from pathjax.emitters.selection import Choice, Lights, choice, choose, probability
from pathjax.emitters.spot import Spot
from pathjax.emitters.sunsky import SunSky
from pathjax.errors import InputError
from pathjax.kinds import Instance, Mean, Parameters, Position, Table, ordered
from pathjax.kinds import register as register_kind
from pathjax.shapes import Geometry, Lamp, geometry, lamp_table
from pathjax.textures import Textures

__all__ = [
    "KINDS",
    "Area",
    "Background",
    "Choice",
    "Constant",
    "DiracEmitter",
    "Directional",
    "Emitter",
    "Envmap",
    "Lights",
    "Point",
    "Projector",
    "Spot",
    "SunSky",
    "SurfaceEmitter",
    "choice",
    "choose",
    "register",
]

# Kinds by their names in scene files.
KINDS: dict[str, type[Emitter]] = {
    "area": Area,
    "constant": Constant,
    "envmap": Envmap,
    "sunsky": SunSky,
    "point": Point,
    "spot": Spot,
    "projector": Projector,
    "directional": Directional,
}


def register(name: str):
    """Return a decorator that registers a subclass of `SurfaceEmitter`, `Background` or `DiracEmitter` as `name`."""
    return register_kind(KINDS, Emitter, name, "emitters", _fault)


def _fault(kind: type[Emitter]) -> str:
    declared = [parameter for name, parameter in kind.declared.items() if name not in Emitter.declared]
    if not declared:
        return "declares nothing; declare a Color(..., textured=False)"
    if kind.on_surfaces or not any(parameter.textured for parameter in declared):
        return ""
    return "declares a textured parameter, which lights on surfaces alone can have; declare Color(..., textured=False)"


def build(
    emitters: list[Instance | None], lamps: list[Lamp], shapes: Geometry, dtype, path: tuple, parameters: Parameters
) -> tuple[tuple[Lights, ...], Geometry]:
    """Build the lights of a scene, and its geometry with the numbers of the lights.

    Args:
        emitters: one per shape, None where it has none, followed by those outside of shapes.
        lamps: from `shapes.build`.
        path: location of the lights in the scene.
        parameters: receives the parameters of the lights.
    """
    of_shapes = dict.fromkeys(emitters[lamp.shape] for lamp in lamps)
    inside = ordered(of_shapes, KINDS)
    outside = ordered([each for each in emitters if each is not None and each not in of_shapes], KINDS)
    made, places, light, number = [], [], np.full(len(shapes.shape), -1, np.int32), 0
    for kind, instances in (*inside.items(), *sorted(outside.items(), key=lambda item: item[0].distant)):
        place = (*path, len(made))
        covers, codes = _textures(instances, dtype, (*place, "textures"), parameters)
        table = kind.build(instances, dtype, (*place, "table"), parameters, codes.get)
        for key in kind.declared if codes else ():
            table = _with_means(table, key, [instance.values[key] for instance in instances])
            means = *place, "table", "columns", kind.place(key), "values"
            for row, instance in enumerate(instances):
                _enter_mean(parameters, f"{instance.name}.{key}", instance.values[key], place, means, row)
        shining = [lamp for lamp in lamps if emitters[lamp.shape].kind is kind]  # empty for kinds outside of shapes
        for lamp in shining:
            light[lamp.primitive : lamp.primitive + lamp.count] = number
            number += 1
        rows = {instance: row for row, instance in enumerate(instances)}
        row_of = np.asarray([rows[emitters[lamp.shape]] for lamp in shining], np.int32)
        lamps_of = (lamp_table(shining, dtype), row_of) if shining else (None, None)
        made.append(Lights(table, *lamps_of, covers))
        places.append(_places(made[-1], shining))
    return _arranged(made, places, dtype), replace(shapes, light=light)


def _places(lights: Lights, lamps: list[Lamp]) -> np.ndarray | None:
    """Return `Lights.places` (R, 3, 3) of near lights; None where their positions are unknown."""
    if lights.lamps is not None:
        return np.stack([lamp.place for lamp in lamps])
    names = [key for key, declared in lights.kind.declared.items() if isinstance(declared, Position)]
    if not names:
        return None
    at = np.asarray(lights.table.column(names[0]).values)
    return np.stack([at, at, np.zeros_like(at)], 1)


def _arranged(made: list[Lights], places: list[np.ndarray | None], dtype) -> tuple[Lights, ...]:
    """Return the lights; if there are many near ones, these have places and leaves in the tree that chooses them."""
    near = [(lights, place) for lights, place in zip(made, places, strict=True) if not lights.kind.distant]
    if sum(lights.count for lights, _ in near) < light_tree.FEWEST or any(place is None for _, place in near):
        return tuple(made)
    ends = np.cumsum([lights.count for lights, _ in near])[:-1]
    leaves = np.split(light_tree.arranged(np.concatenate([place for _, place in near])), ends)
    placed = [
        replace(lights, places=np.asarray(place, dtype), leaf=leaf)
        for (lights, place), leaf in zip(near, leaves, strict=True)
    ]
    return (*placed, *made[len(near) :])


def _textures(instances: list[Instance], dtype, path: tuple, parameters: Parameters) -> tuple[Textures | None, dict]:
    """Return the textures of lights, and their codes. A named parameter may have only one place in a scene."""
    used = dict.fromkeys(v for each in instances for v in each.values.values() if isinstance(v, Instance))
    own = Parameters()
    made, codes = textures.build(list(used), dtype, path, own)
    for parameter in own.known.keys() & parameters.known.keys():
        raise InputError(f"{parameter} is of a texture of a bsdf and of a light; give each a texture of its own")
    parameters.known.update(own.known)
    for image, first in own.names.items():
        parameters.names.setdefault(image, first)
    for image in own.textures.keys() - parameters.textures.keys():
        parameters.textures[image] = own.textures[image]
    return made, codes


def _enter_mean(parameters: Parameters, name: str, texture, lights: tuple, path: tuple, row: int) -> None:
    """Enter where the mean of a texture is stored. An image that a bsdf or other lights have too is refused."""
    if not isinstance(texture, Instance):
        return
    if texture in parameters.textures and parameters.textures[texture].path[: len(lights)] != lights:
        parameters.refused[name] = f"{name} is an image that stands elsewhere, too; give the light one of its own"
        return
    parts = list(_parts(parameters, name, texture))
    known = {each: parameters.known[each] for _, each in parts if isinstance(each, str)}
    rest = sum(share * np.broadcast_to(each, 3) for share, each in parts if not isinstance(each, str))
    shares = tuple((share, known[each]) for share, each in parts if isinstance(each, str))
    mean = Mean(path, row, shares, tuple(np.broadcast_to(rest, 3).tolist()))
    for each, parameter in known.items():
        parameters.known[each] = replace(parameter, means=(*parameter.means, mean))


def _parts(parameters: Parameters, name: str, value, share: float = 1.0):
    """Yield the shares and the terms of the mean of a texture: names of parameters, and values that are none."""
    if name not in parameters.known:
        name = parameters.names.get(value, name) if isinstance(value, Instance) else name
    if name in parameters.known:
        yield share, name
    elif isinstance(value, Instance) and (keys := value.kind.parts_of_mean(value)):
        for key in keys:
            yield from _parts(parameters, f"{value.name}.{key}", value.values[key], share / len(keys))
    else:
        yield share, _mean(value) if isinstance(value, Instance) else value


def _with_means(table: Table, key: str, values: list) -> Table:
    """Return the table with the means of textures as values of a column; lights are chosen by these."""
    column = table.column(key)
    if column is None or column.texture is None:
        return table
    rows = [row if mean is None else mean for row, mean in zip(column.values, map(_mean, values), strict=True)]
    return table.with_column(key, np.asarray(rows, column.values.dtype))


def _mean(value) -> np.ndarray | None:
    return value.kind.mean(value) if isinstance(value, Instance) else None


def name(lights: Lights) -> str:
    """Return the name of a kind in scene files."""
    return next(name for name, kind in KINDS.items() if kind is lights.kind)


def chosen_by_place(emitters: tuple[Lights, ...]) -> bool:
    """Return whether the choice of a light depends on the shaded point."""
    return any(lights.places is not None for lights in emitters)


def default_name(kind: str) -> str:
    """Return the name of a light outside of shapes that has no id. kind: its name in scene files."""
    return "background" if issubclass(KINDS.get(kind, Emitter), Background) else kind


def sampled(emitters: tuple[Lights, ...]) -> bool:
    """Return whether strategy "mis" samples lights."""
    return any(not lights.left_to_bsdfs for lights in emitters)


def met_by_no_ray(emitters: tuple[Lights, ...]) -> list[str]:
    """Return the names of the kinds that only light samples find."""
    return [name(lights) for lights in emitters if issubclass(lights.kind, DiracEmitter)]


def darkness(emitters: tuple[Lights, ...], smooth: bool) -> str | None:
    """Return why every image is black, in words; None if it may not be. Values must not be traced.

    smooth: whether some bsdf is smooth; others reflect no light from Dirac emitters.
    """
    if not emitters:
        return "there is no light"
    bright = [lights for lights in emitters if not lights.dark()]
    if not bright:
        return "the radiance of every light is 0"
    if smooth or any(not lights.kind.dirac for lights in bright):
        return None
    names = " and ".join(map(name, bright))
    return f"the {names} emitters shine on smooth glass and mirrors alone, which show no light without size"


def backgrounds(emitters: tuple[Lights, ...]) -> list[int]:
    """Return the indices of the backgrounds."""
    return [place for place, lights in enumerate(emitters) if issubclass(lights.kind, Background)]


def even_lights(emitters: tuple[Lights, ...]) -> Lights | None:
    """Return the lights on surfaces that emit the same radiance in all directions; None: there is no light.

    Raises:
        InputError: there are other lights, lights with textures, or several kinds of lights.
    """
    for lights in emitters:
        if lights.lamps is None or not lights.kind.even:
            raise InputError(
                f"the scene has a {name(lights)} emitter; patches hold the light of surfaces alone, the same in all "
                "directions. Enclose it, or use pathjax.render"
            )
        if lights.textures is not None:
            raise InputError("the scene has a light with a texture; a patch has one radiance. Give it a constant one")
    if len(emitters) > 1:
        raise InputError("the scene has several kinds of emitters on surfaces; patches hold the light of one kind")
    return emitters[0] if emitters else None


def sample(
    emitters: tuple[Lights, ...],
    shapes: Geometry,
    chosen: Choice,
    ref: Float[Array, "3"],
    u: Float[Array, "2"],
    u_part: Float[Array, ""],
    backgrounds: bool = True,
) -> EmitterSample:
    """Choose a light and a direction towards it.

    Args:
        ref: the shaded point.
        u: uniform in [0, 1); the first number also chooses the light.
        u_part: uniform in [0, 1); chooses a part of the light.
        backgrounds: whether to evaluate backgrounds; if not, `with_background` completes the sample.
    Returns:
        The sample; pdf and Le are 0 where no light arrives.
    """
    number, likely, u = choose(chosen, ref, u)
    sampled = [(lights, first) for lights, first in zip(emitters, chosen.first, strict=True) if first is not None]
    some_dirac = any(lights.kind.dirac for lights, _ in sampled)

    def of(lights: Lights, first):
        def draw():
            light = number - first if first else number
            p = lights.parameters(light)
            if lights.kind.on_surfaces:
                d, distance, n, pdf, primitive = geometry.sample_lamp(shapes, lights.lamps, light, ref, u, u_part)
                front = dot(n, d) < 0
                if lights.textures is not None:
                    there = Hit(distance, primitive, jnp.int32(0))
                    p = lights.parameters(light, geometry.surface(shapes, Ray(ref, d, distance, jnp.int32(-1)), there))
                Le = jnp.where(front, lights.kind.emitted(p, d), 0)
                pdf = jnp.where(front, pdf, 0) * likely
            elif not lights.kind.dirac:
                d = lights.kind.sample(p, u, u_part)
                distance, primitive = jnp.full_like(d[0], jnp.inf), jnp.int32(-1)
                Le, pdf = background(emitters, chosen, d) if backgrounds else (jnp.zeros_like(d), jnp.zeros_like(d[0]))
            else:
                d, distance, Le = lights.kind.sample(p, ref)
                primitive, pdf = jnp.int32(-1), likely
            delta = jnp.bool_(lights.kind.dirac) if some_dirac else None
            return EmitterSample(d, distance, primitive, Le, pdf, delta)

        return draw

    return geometry.switch_by_range(number, [first for _, first in sampled], [of(*each) for each in sampled])


def samples_background(emitters: tuple[Lights, ...], chosen: Choice | None) -> bool:
    """Return whether `sample` draws directions of backgrounds."""
    return chosen is not None and any(chosen.first[place] is not None for place in backgrounds(emitters))


def with_background(drawn: EmitterSample, radiance: Float[Array, "3"], density: Float[Array, ""]) -> EmitterSample:
    """Complete a sample drawn with `backgrounds=False` by the results of `background` in the direction drawn.d."""
    from_there = jnp.isinf(drawn.distance)
    if drawn.delta is not None:
        from_there &= ~drawn.delta
    return drawn._replace(Le=jnp.where(from_there, radiance, drawn.Le), pdf=jnp.where(from_there, density, drawn.pdf))


def hit(
    emitters: tuple[Lights, ...], shapes: Geometry, chosen: Choice | None, ray: Ray, hit: Hit, surface: Surface
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return the radiance from the surface that was hit, and its density [1/sr] in `sample`; 0, 0 if dark.

    ray: from the `ref` of `sample`.
    """
    zero = jnp.zeros_like(ray.o)
    on_surfaces = [lights for lights in emitters if lights.lamps is not None]
    if not on_surfaces:
        return zero, zero[0]
    number = at(shapes.light, jnp.maximum(hit.primitive, 0))
    firsts = np.cumsum([0, *(lights.count for lights in on_surfaces)]).tolist()[:-1]

    def of(lights: Lights, first):
        def lit():
            light = number - first if first else number
            front = dot(surface.n, ray.d) < 0
            Le = jnp.where(front, lights.kind.emitted(lights.parameters(light, surface), ray.d), 0)
            pdf = geometry.lamp_density(shapes, lights.lamps, light, ray, hit, surface)
            return Le, larger(pdf, jnp.zeros_like(pdf)) * probability(chosen, ray.o, number)

        return lit

    def lit():
        return geometry.switch_by_range(number, firsts, [of(*each) for each in zip(on_surfaces, firsts, strict=True)])

    return lax.cond((number >= 0) & (hit.primitive >= 0), lit, lambda: (zero, zero[0]))


def background(
    emitters: tuple[Lights, ...], chosen: Choice | None, d: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return the radiance from direction d where nothing is hit, and its density [1/sr] in `sample`.

    Both are sums over all backgrounds: light may come from several of them, and any of them may have drawn d.
    """
    radiances, densities = [], []
    for place, lights in enumerate(emitters):
        for row in range(lights.count) if issubclass(lights.kind, Background) else ():
            p = lights.parameters(row)
            if chosen is None or chosen.first[place] is None:
                radiances.append(lights.kind.emitted(p, d))
                continue
            radiance, density = lights.kind.met(p, d)
            radiances.append(radiance)
            densities.append(chosen.pdf[chosen.first[place] + row] * density)
    radiance = reduce(jnp.add, radiances) if radiances else jnp.zeros_like(d)
    return radiance, reduce(jnp.add, densities) if densities else jnp.zeros_like(d[0])
