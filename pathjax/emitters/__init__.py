"""Where light comes from: a file a kind, and the choice among the lights of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.core.math import at, luminance
from pathjax.core.types import EmitterSample, Hit, Ray, Surface
from pathjax.emitters import area, constant
from pathjax.emitters.area import AreaLights
from pathjax.emitters.constant import Constant
from pathjax.kinds import Parameter
from pathjax.shapes import Geometry, Lamp, lamp_table


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Emitters:
    area: AreaLights | None
    constant: Constant | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Choice:
    """Probability of each light, of the area lights first and of the background last; made once per render."""

    pdf: jax.Array  # (R,)
    cdf: jax.Array  # (R,) ends at 1


def build(description, geometry: Geometry, lamps: list[Lamp], dtype, parameters) -> tuple[Emitters, Geometry]:
    """The lights of a scene, and its geometry with their numbers.

    lamps: of `shapes.build`.
    """
    shapes = description.shapes
    emitting = list(dict.fromkeys(lamp.shape for lamp in lamps))
    bounds = (0, np.inf)
    for row, shape in enumerate(shapes[number] for number in emitting):
        place = Parameter(("emitters", "area", "radiance"), (row,), (3,), bounds)
        parameters[f"{shape.emitter_name}.radiance"] = place
    area = constant = None
    if lamps:
        rows = [emitting.index(lamp.shape) for lamp in lamps]
        radiance = np.asarray(np.stack([shapes[number].radiance for number in emitting]), dtype)
        area = AreaLights(radiance, np.asarray(rows, np.int32), lamp_table(lamps, dtype))
    if description.background is not None:
        constant = Constant(np.asarray(description.background, dtype))
        place = Parameter(("emitters", "constant", "radiance"), (), (3,), bounds)
        parameters[f"{description.background_name}.radiance"] = place
    light = np.full(len(geometry.shape), -1, np.int32)
    for number, lamp in enumerate(lamps):
        light[lamp.primitive : lamp.primitive + lamp.count] = number
    return Emitters(area, constant), replace(geometry, light=light)


def darkness(emitters: Emitters) -> str | None:
    """Why every image is black, in words; None where light may come. Of known values, not of traced ones."""
    radiances = [table.radiance for table in (emitters.area, emitters.constant) if table is not None]
    if not radiances:
        return "there is no light"
    return None if any(np.asarray(radiance).any() for radiance in radiances) else "the radiance of every light is 0"


def choice(emitters: Emitters, strategy: str) -> Choice | None:
    """Lights by power, pi * area * luminance; None where there is nothing to choose from.

    The background is sampled only for strategy "light", half of the time beside other lights: what a bsdf samples
    finds a constant background at less variance.
    """
    weights = []
    if emitters.area is not None:
        lights = emitters.area
        weights.append(lights.lamps.area * luminance(lights.radiance)[lights.emitter])
    if emitters.constant is not None and strategy == "light":
        one = jnp.ones((1,), emitters.constant.radiance.dtype)
        weights = [jnp.concatenate([weights[0] / jnp.sum(weights[0]), one]) if weights else one]
    if not weights:
        return None
    # Lights of power 0 throughout: any choice will do, and 0 / 0 will not.
    power = lax.stop_gradient(weights[0])
    total = jnp.sum(power)
    pdf = jnp.where(total > 0, power / jnp.where(total > 0, total, 1), 1 / len(power))
    return Choice(pdf, jnp.cumsum(pdf))


def sample(emitters: Emitters, shapes: Geometry, chosen: Choice, ref, u, u_triangle) -> EmitterSample:
    """Choose a light and a direction towards it. u: (2,), its first number also chooses; u_triangle: ()."""
    count = chosen.pdf.shape[0]
    if count == 1:
        row, pdf = jnp.int32(0), jnp.ones_like(u[0])
    else:
        row = jnp.searchsorted(chosen.cdf, u[0], side="right").astype(jnp.int32)
        row = jnp.minimum(row, count - 1)
        pdf = at(chosen.pdf, row)
        below = at(chosen.cdf, row) - pdf
        again = jnp.clip((u[0] - below) / jnp.where(pdf > 0, pdf, 1), 0, 1 - 2**-24)
        u = jnp.stack([again, u[1]])

    def of_area():
        return area.sample(emitters.area, shapes, row, ref, u, u_triangle)

    def of_background():
        return constant.sample(emitters.constant, u)

    area_rows = 0 if emitters.area is None else emitters.area.emitter.shape[0]
    if area_rows == count:
        drawn = of_area()
    elif area_rows == 0:
        drawn = of_background()
    else:
        drawn = lax.cond(row < area_rows, of_area, of_background)
    return drawn._replace(pdf=drawn.pdf * pdf)


def hit(emitters: Emitters, shapes: Geometry, chosen: Choice | None, ray: Ray, hit: Hit, surface: Surface):
    """Radiance (3,) received from the surface that was hit and the density [1/sr] of `sample` for it; 0, 0 if dark."""
    zero = jnp.zeros_like(ray.o)
    if emitters.area is None:
        return zero, zero[0]
    row = at(shapes.light, jnp.maximum(hit.primitive, 0))

    def lit():
        Le, pdf = area.hit(emitters.area, shapes, row, ray, hit, surface)
        return Le, pdf * at(chosen.pdf, row)

    return lax.cond((row >= 0) & (hit.primitive >= 0), lit, lambda: (zero, zero[0]))


def background(emitters: Emitters, chosen: Choice | None, d):
    """Radiance (3,) from direction d (3,) where nothing is hit, and the density [1/sr] of `sample` for it."""
    if emitters.constant is None:
        return jnp.zeros_like(d), jnp.zeros_like(d[0])
    area_rows = 0 if emitters.area is None else emitters.area.emitter.shape[0]
    sampled = chosen is not None and chosen.pdf.shape[0] > area_rows
    pdf = chosen.pdf[area_rows] * constant.SPHERE_PDF if sampled else 0
    return emitters.constant.radiance, jnp.asarray(pdf, d.dtype)
