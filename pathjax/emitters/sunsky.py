"""A clear sky with its sun, by the model of Hosek and Wilkie.

The sky (2012, "An analytic model for full spectral sky-dome radiance", ACM TOG 31(4)) is a formula of ten numbers per
colour, which follow from turbidity, ground albedo and elevation of the sun. The sun (2013, "Adding a solar-radiance
function to the Hosek-Wilkie skylight model", IEEE CG&A 33(3)) is a disc of even radiance, as in Mitsuba without
`complex_sun`. Up is +z. Directions below the horizon are dark, and so is the sky while the sun is below it.

`sunsky.npz` holds the data in linear RGB; `sunsky.txt` states their source and licence.

Directions are drawn from the disc, or from the sky by its mean luminance in each of many cells of equal solid angle.
"""

from __future__ import annotations

import datetime
import math
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from pathjax.core.cumulated import cumulated, search
from pathjax.core.math import (
    at,
    cos_sin_turns,
    dot,
    frame_from_normal,
    larger,
    luminance,
    safe_atan2,
    safe_divide,
    safe_sqrt,
    smaller,
    to_world,
    turns,
)
from pathjax.core.warp import cone_pdf, square_to_cone
from pathjax.emitters.emitter import Background
from pathjax.kinds import Direction, Instance, Number, PerRow, Rotation, Row, Shared

# Cells of the sky in cos(polar angle) and azimuth.
ROWS, COLUMNS = 32, 64
# Diameter of the real sun in degrees; a wider or narrower sun gives the same light.
APERTURE = 0.5358
# Elevations, in degrees, in the table of the sun's radiance. As in Mitsuba, its ends apply to lower and higher suns.
ELEVATIONS = np.linspace(2, 89, 30)
# Mitsuba's default place and time: Tokyo, on a day in July. Integers: default, lower and upper bound.
DATE = {"year": (2010, 1, 9999), "month": (7, 1, 12), "day": (10, 1, 31)}
TIME = {"hour": 15.0, "minute": 0.0, "second": 0.0}
PLACE = {"latitude": 35.6894, "longitude": 139.6917, "timezone": 9.0}
# Least probability of sampling the sun, and the sky: one without light may have a derivative.
LEAST = 1 / 32


class SunSky(Background):
    """An `Instance` holds `turbidity`, `albedo` (3,), `sun_aperture` in degrees and `sun`, a local unit vector."""

    sky_scale = Number(1.0, bounds=(0, math.inf))
    sun_scale = Number(1.0, bounds=(0, math.inf))
    to_world = Rotation()
    formula = PerRow()  # (3, 10) numbers of the formula of the sky, per colour
    disc = PerRow()  # (3,) radiance of the sun
    direction = PerRow()  # (3,) of the sun, local
    one_minus_cos = PerRow()  # () 1 - cos of half the aperture
    sky_light = PerRow()  # () mean luminance of the sky over the sphere
    sun_light = PerRow()  # () the same of the sun
    cells = Shared()  # (ROWS COLUMNS + 1,) cumulative probability of the cells of the sky before each
    single = True

    @classmethod
    def read(cls, loader, fields, name):
        others = "sky_scale", "sun_scale", "to_world", "sampling_weight"
        values = {key: cls.declared[key].read(loader, fields, key, name) for key in others}
        if fields.boolean("complex_sun", False):
            raise fields.error("complex_sun", "asks for a darker limb of the sun, which is not modelled; leave it out")
        if (given := fields.point("sun_direction", None)) is None:
            sun = _sun_at(fields)
        elif not given.any():
            raise fields.error("sun_direction", "is the zero vector, which points nowhere")
        else:
            sun = Direction.of(given) @ values["to_world"]
            for key in (*PLACE, *DATE, *TIME):
                if fields.has(key):
                    raise fields.error(key, "cannot stand beside sun_direction; give either that, or place and time")
        if sun[2] < 0:
            loader.note(fields.element, "has its sun below the horizon, and is dark")
        return cls.instance(
            name,
            fields.float("turbidity", 3.0, at_least=1, at_most=10),
            fields.color("albedo", np.full(3, 0.3), at_most=1),
            fields.float("sun_aperture", APERTURE, above=0, below=90),
            sun,
            **values,
        )

    @classmethod
    def instance(cls, name="", turbidity=3.0, albedo=(0.3,), sun_aperture=APERTURE, sun=(0.0, 0.6, 0.8), **values):
        own = {"turbidity": turbidity, "albedo": albedo, "sun_aperture": sun_aperture, "sun": np.asarray(sun, float)}
        return Instance(cls, name, {**super().instance(name, **values).values, **own})

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        (values,) = (instance.values for instance in instances)
        sun, turbidity = values["sun"], values["turbidity"]
        elevation = math.asin(np.clip(sun[2], -1, 1))
        formula = _formula(turbidity, np.broadcast_to(values["albedo"], (3,)), elevation)
        aperture, usual = (2 * math.sin(math.radians(angle) / 4) ** 2 for angle in (values["sun_aperture"], APERTURE))
        disc = _radiance(turbidity, elevation) * (usual / aperture)
        mean = _means(formula, sun)
        made = {
            "formula": [formula],
            "disc": [disc],
            "direction": [sun],
            "one_minus_cos": [aperture],
            "sky_light": [mean.mean() / 2],
            "sun_light": [luminance(disc) * aperture / 2],
            "cells": cumulated(mean.ravel()),
        }
        table = super().build(instances, dtype, path, parameters, code)
        for key, value in made.items():
            table = table.with_column(key, np.asarray(value, dtype))
        return table

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        return p.sky_light * p.sky_scale + p.sun_light * p.sun_scale

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"], u_part: Float[Array, ""]) -> Float[Array, "3"]:
        cell, beside = search(p.cells, 0, ROWS * COLUMNS, u[0])
        z = ((cell // COLUMNS).astype(u.dtype) + u[1]) / ROWS
        cos, sin = cos_sin_turns(((cell % COLUMNS).astype(u.dtype) + beside) / COLUMNS)
        r = safe_sqrt((1 - z) * (1 + z))
        of_sun = to_world(frame_from_normal(p.direction), square_to_cone(u, p.one_minus_cos))
        return p.to_world @ jnp.where(u_part < _chance_of_sun(p), of_sun, jnp.stack([r * cos, r * sin, z]))

    @staticmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        v = d @ p.to_world
        half, z = _half(p, v), larger(v[2], 0)
        gamma = 2 * safe_atan2(safe_sqrt(half), safe_sqrt(1 - half))
        sky = _sky(p.formula, z, safe_sqrt(z), gamma, 1 - 2 * half, jnp.exp)
        light = p.sky_scale * sky + p.sun_scale * jnp.where(_in_sun(p, half), p.disc, 0)
        return jnp.where(v[2] >= 0, light, 0)

    @staticmethod
    def density(p: Row, d: Float[Array, "3"]) -> Float[Array, ""]:
        v = d @ p.to_world
        row, column = (v[2] * ROWS).astype(jnp.int32), (turns(v[1], v[0]) * COLUMNS).astype(jnp.int32)
        cell = jnp.clip(row, 0, ROWS - 1) * COLUMNS + jnp.clip(column, 0, COLUMNS - 1)
        of_sky = (at(p.cells, cell + 1) - at(p.cells, cell)) * (ROWS * COLUMNS / (2 * math.pi))
        chance = _chance_of_sun(p)
        of_sun = jnp.where(_in_sun(p, _half(p, v)), chance * cone_pdf(p.one_minus_cos), 0)
        return lax.stop_gradient(jnp.where(v[2] >= 0, (1 - chance) * of_sky, 0) + of_sun)


def _sky(formula, z, root, gamma, cos, exp):
    """Return the radiance of the sky (3,), never negative, by equations 7 and 8 of the paper of 2012.

    Args:
        formula: (3, 10); the factor comes last.
        z, root: cosine of the polar angle, at least 0, and its square root.
        gamma, cos: angle to the sun, and its cosine.
    """
    a, b, c, d, e, f, g, h, i, factor = formula.T
    glow = 1 + i * i - 2 * i * cos
    around = c + d * exp(e * gamma) + f * (cos * cos) + g * ((1 + cos * cos) / glow**1.5) + h * root
    radiance = factor * (1 + a * exp(b / (z + 0.01))) * around
    return (radiance + abs(radiance)) / 2


def _half(p: Row, v: Float[Array, "3"]) -> Float[Array, ""]:
    """Return (1 - cos) / 2 of the angle to the sun, by the chord, since the cosine loses digits near 1."""
    chord = v - p.direction
    return smaller(dot(chord, chord) / 4, jnp.ones_like(v[0]))


def _in_sun(p: Row, half: Float[Array, ""]) -> Bool[Array, ""]:
    return 2 * half <= p.one_minus_cos


def _chance_of_sun(p: Row) -> Float[Array, ""]:
    sun, sky = p.sun_light * p.sun_scale, p.sky_light * p.sky_scale
    return lax.stop_gradient(jnp.clip(safe_divide(sun, sun + sky), LEAST, 1 - LEAST))


# ---- from the data --------------------------------------------------------------------------------------------------


@cache
def _data() -> tuple[np.ndarray, np.ndarray]:
    """Return the sky by turbidity, albedo, control point, colour, number; the sun by turbidity, elevation, colour."""
    with np.load(Path(__file__).parent / "sunsky.npz") as data:
        return data["sky"].astype(float), data["sun"].astype(float)


def _at_turbidity(table: np.ndarray, turbidity: float) -> np.ndarray:
    low = min(int(turbidity), 9)  # turbidities are 1 to 10
    return table[low - 1] + (table[low] - table[low - 1]) * (turbidity - low)


def _formula(turbidity: float, albedo: np.ndarray, elevation: float) -> np.ndarray:
    """Return (3, 10), linear in the albedo (3,), and a Bezier curve of degree 5 in the cube root of the elevation."""
    if elevation < 0:
        return np.zeros((3, 10))
    black, white = _at_turbidity(_data()[0], turbidity)
    x = np.cbrt(elevation / (math.pi / 2))
    weights = [math.comb(5, k) * x**k * (1 - x) ** (5 - k) for k in range(6)]
    return np.einsum("k,kcn->cn", weights, black + (white - black) * albedo[:, None])


def _radiance(turbidity: float, elevation: float) -> np.ndarray:
    """Return the radiance (3,) of the sun's disc; channels out of the gamut, and suns below the horizon, are 0."""
    table = _at_turbidity(_data()[1], turbidity)
    radiance = [np.interp(math.degrees(elevation), ELEVATIONS, column) for column in table.T]
    return np.maximum(radiance, 0) * (elevation >= 0)


def _means(formula: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Return the luminance (ROWS, COLUMNS) of the sky in each cell, as the mean of four points."""
    z = (np.arange(2 * ROWS)[:, None] + 0.5) / (2 * ROWS)
    azimuth = (np.arange(2 * COLUMNS) + 0.5) * (math.pi / COLUMNS)
    cos = np.sqrt(1 - z * z) * (np.cos(azimuth) * sun[0] + np.sin(azimuth) * sun[1]) + z * sun[2]
    z, cos = (each[..., None] for each in (np.broadcast_to(z, cos.shape), np.clip(cos, -1, 1)))
    found = luminance(_sky(formula, z, np.sqrt(z), np.arccos(cos), cos, np.exp))
    return found.reshape(ROWS, 2, COLUMNS, 2).mean((1, 3))


# ---- place and time -------------------------------------------------------------------------------------------------


def _sun_at(fields) -> np.ndarray:
    """Return the local direction of the sun at a place and time; south is +x, west +y, up +z.

    This is the method of Blanco-Muriel, Alarcon-Padilla, Lopez-Moratalla and Lara-Coira 2001, "Computing the solar
    vector", Solar Energy 70(5), right to half a minute of arc.
    """
    year, month, day = (fields.integer(key, first, at_least=a, at_most=b) for key, (first, a, b) in DATE.items())
    hour, minute, second = (fields.float(key, default) for key, default in TIME.items())
    latitude, longitude, timezone = (fields.float(key, default) for key, default in PLACE.items())
    try:
        days = (datetime.date(year, month, day) - datetime.date(2000, 1, 1)).days
    except ValueError as error:
        raise fields.error("day", f"is none: {error}") from None
    hours = hour - timezone + (minute + second / 60) / 60  # universal time
    days += (hours - 12) / 24  # since noon of the first of January 2000
    omega, anomaly = 2.1429 - 0.0010394594 * days, 6.2400600 + 0.0172019699 * days
    ecliptic = 4.8950630 + 0.017202791698 * days + 0.03341607 * math.sin(anomaly) + 0.00034894 * math.sin(2 * anomaly)
    ecliptic -= 0.0001134 + 0.0000203 * math.sin(omega)
    obliquity = 0.4090928 - 6.2140e-9 * days + 0.0000396 * math.cos(omega)
    ascension = math.atan2(math.cos(obliquity) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(obliquity) * math.sin(ecliptic))
    sidereal = math.radians((6.6974243242 + 0.0657098283 * days + hours) * 15 + longitude)
    turned, phi = sidereal - ascension, math.radians(latitude)
    south = math.cos(declination) * math.cos(turned) * math.sin(phi) - math.sin(declination) * math.cos(phi)
    west = math.cos(declination) * math.sin(turned)
    up = math.cos(declination) * math.cos(turned) * math.cos(phi) + math.sin(declination) * math.sin(phi)
    # Parallax, as seen from the ground: the radius of the Earth over the distance of the sun.
    zenith = math.acos(min(max(up, -1), 1))
    zenith += 6371.01 / 149597890 * math.sin(zenith)
    flat = math.hypot(south, west)
    scale = math.sin(zenith) / flat if flat > 0 else 0.0
    return np.array([south * scale, west * scale, math.cos(zenith)])
