"""Pixels, and the reconstruction filter that each of them looks through.

Filters are sampled by importance: a pixel gathers only its own samples, with weights that average to 1, so that pixels
stay independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import description
from pathjax.core.math import at
from pathjax.core.warp import tent

# Steps of the tabulated inverse of the Gaussian's running integral; its density is sampled exactly, step by step.
_STEPS = 1024


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Gaussian:
    knots: jax.Array  # (_STEPS + 1,) offsets between which equal shares of the filter lie
    stddev: jax.Array  # ()
    radius: jax.Array  # ()
    scale: jax.Array  # () 1 over the filter's integral


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Film:
    gaussian: Gaussian | None
    radius: jax.Array  # () of a box or tent filter, in pixels
    filter: str = field(metadata={"static": True})  # "box", "tent", "gaussian"
    width: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    crop: tuple[int, int, int, int] = field(metadata={"static": True})  # offset x, y, width, height


def build(film: description.Film, dtype) -> Film:
    gaussian = None
    if film.filter == "gaussian":
        x = np.linspace(-film.filter_radius, film.filter_radius, 16 * _STEPS + 1)
        f = _gaussian(x, film.filter_stddev, film.filter_radius, np)
        running = np.concatenate([[0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(x))])
        knots = np.interp(np.linspace(0, running[-1], _STEPS + 1), running, x)
        gaussian = Gaussian(
            np.asarray(knots, dtype),
            np.asarray(film.filter_stddev, dtype),
            np.asarray(film.filter_radius, dtype),
            np.asarray(1 / running[-1], dtype),
        )
    radius = np.asarray(film.filter_radius, dtype)
    return Film(gaussian, radius, film.filter, film.width, film.height, tuple(film.crop))


def sample_position(film: Film, pixel, u):
    """Where a sample of a pixel looks.

    Args:
        pixel: () int32, row by row over the crop window.
        u: (2,).
    Returns:
        position (2,) in [0, 1]^2 over the whole film (a wide filter reaches beyond), weight () of mean 1.
    """
    x0, y0, width, _ = film.crop
    center = jnp.stack([pixel % width + x0, pixel // width + y0]).astype(u.dtype) + jnp.asarray(0.5, u.dtype)
    weight = jnp.ones_like(u[0])
    if film.filter == "box":
        offset = (2 * u - 1) * film.radius
    elif film.filter == "tent":
        offset = tent(u) * film.radius
    else:
        offset, weights = _sample_gaussian(film.gaussian, u)
        weight = weights[0] * weights[1]
    return (center + offset) / jnp.array([film.width, film.height], u.dtype), weight


def _gaussian(x, stddev, radius, xp=jnp):
    """Mitsuba's: lowered so that it ends at 0."""
    return xp.maximum(xp.exp(-(x**2) / (2 * stddev**2)) - xp.exp(-(radius**2) / (2 * stddev**2)), 0)


def _sample_gaussian(table: Gaussian, u):
    step = jnp.minimum((u * _STEPS).astype(jnp.int32), _STEPS - 1)
    low = jnp.stack([at(table.knots, step[0]), at(table.knots, step[1])])
    high = jnp.stack([at(table.knots, step[0] + 1), at(table.knots, step[1] + 1)])
    x = low + (u * _STEPS - step) * (high - low)
    density = 1 / (_STEPS * (high - low))
    return x, _gaussian(x, table.stddev, table.radius) * table.scale / density


def pixel_count(film: Film) -> int:
    return film.crop[2] * film.crop[3]


def image_shape(film: Film) -> tuple[int, int]:
    """Height and width of the image, that of the crop window."""
    return film.crop[3], film.crop[2]
