"""The film: its pixels, and the positions of samples in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Real

from pathjax.compile import is_traced, register_dataclass
from pathjax.core.math import at
from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.sensors import filters
from pathjax.sensors.filters import Box, Filter, Gaussian

MAX_PIXELS = 10**9
# Samples count in at most this many pixels to either side: work and program size grow with the square. A wider filter
# is importance-sampled, for each pixel separately.
MOST_REACH = 4
# Points per pixel width at which the filter is evaluated.
_POINTS = 256
PIXEL_FORMATS = ("rgb", "rgba", "luminance", "luminance_alpha", "xyz", "xyza")


@register_dataclass
@dataclass(frozen=True)
class Film:
    filter: Filter
    width: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    crop: tuple[int, int, int, int] = field(metadata={"static": True})  # offset x, y, width, height
    reach: int = field(metadata={"static": True})  # pixels to either side of its own that the filter covers
    # Whether a sample counts in all of these pixels; else each pixel importance-samples the filter for itself.
    shared: bool = field(metadata={"static": True})
    border: bool = field(metadata={"static": True})  # whether pixels just outside the crop window are sampled too
    running: jax.Array | None  # (2 reach + 2,) integral of the filter up to the edges of pixels; None: not needed


@dataclass(frozen=True)
class HDRFilm:
    """Description of the film in a scene file."""

    width: int = 768
    height: int = 576
    crop: tuple[int, int, int, int] | None = None  # offset x, offset y, width, height; None: the whole film
    filter: Filter = Gaussian()
    sample_border: bool = False

    unused: ClassVar[Mapping[str, Unused]] = {
        "file_format": Unused("string", choices=("openexr", "exr", "rgbe", "pfm")),
        "component_format": Unused("string", choices=("float16", "float32", "uint32")),
        "compensate": Unused("boolean"),
        "banner": Unused("boolean"),
    }

    @classmethod
    def read(cls, loader, fields: Fields) -> HDRFilm:
        width, height = fields.integer("width", cls.width, at_least=1), fields.integer("height", cls.height, at_least=1)
        if width * height >= MAX_PIXELS:
            raise fields.error("width", f"times height is {width * height} pixels; it must be below {MAX_PIXELS}")
        x, y = (fields.integer(f"crop_offset_{axis}", 0, at_least=0) for axis in "xy")
        crop_width = fields.integer("crop_width", width, at_least=1)
        crop_height = fields.integer("crop_height", height, at_least=1)
        if x + crop_width > width or y + crop_height > height:
            window = f"({x}, {y}) + ({crop_width}, {crop_height})"
            raise fields.element.error(f"the crop window {window} reaches beyond the film, ({width}, {height})")
        pixel_format = fields.string("pixel_format", "rgb", choices=PIXEL_FORMATS)
        if pixel_format != "rgb":
            loader.note(fields.where("pixel_format"), f"asks for {pixel_format}; images are linear RGB here")
        nested = fields.objects("rfilter")
        filter = loader.make(nested[0], filters.KINDS) if nested else cls.filter
        return cls(width, height, (x, y, crop_width, crop_height), filter, fields.boolean("sample_border", False))

    def build(self, dtype) -> Film:
        crop = (0, 0, self.width, self.height) if self.crop is None else tuple(self.crop)
        filter, reach = self.filter.build(dtype), math.ceil(self.filter.radius - 0.5)
        running = None if self.sample_border or not reach else np.asarray(_running(filter, reach), dtype)
        shared = 0 < reach <= MOST_REACH
        return Film(filter, self.width, self.height, crop, reach, shared, self.sample_border, running)


# Kinds by their names in scene files.
KINDS = {"hdrfilm": HDRFilm}


def sample_position(
    film: Film, pixel: Int[Array, ""], u: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Sample the film position of a pixel's sample.

    Args:
        pixel: index, row by row over the crop window.
    Returns:
        position in [0, 1]^2 over the whole film (a wide filter reaches beyond), and weight, of mean 1.
    """
    x0, y0, width, _ = film.crop
    center = jnp.stack([pixel % width + x0, pixel // width + y0]).astype(u.dtype) + jnp.asarray(0.5, u.dtype)
    offset, weight = film.filter.sample(u)
    if film.running is not None:
        weight = weight * _inside(film, pixel, offset)
    return (center + offset) / jnp.array([film.width, film.height], u.dtype), weight


def pixels(film: Film) -> Int[Array | np.ndarray, " N"]:
    """Return all pixels that are sampled for an image, row by row; by NumPy if possible, which compiles nothing."""
    module = jnp if any(map(is_traced, jax.tree.leaves(film))) else np
    return module.arange(pixel_count(of_samples(film)), dtype=np.int32)


def pixel_count(film: Film) -> int:
    return film.crop[2] * film.crop[3]


def image_shape(film: Film) -> tuple[int, int]:
    """Return height and width of the image, which is the crop window."""
    return film.crop[3], film.crop[2]


def of_samples(film: Film) -> Film:
    """Return the film for drawing shared samples: box-filtered, so that each sample is uniform in its own pixel."""
    x, y, width, height = film.crop
    out = _outside(film)
    window = x - out, y - out, width + 2 * out, height + 2 * out
    return replace(film, filter=Box().build(film.filter.radius.dtype), crop=window, reach=0, shared=False, running=None)


def cropped(film: Film, image: Float[Array, "R N *rest"]) -> Float[Array, "R HW *rest"]:
    """Return the pixels of `of_samples(film)` that are in the film's own crop window."""
    _, _, width, height = of_samples(film).crop
    out = _outside(film)
    inside = image.reshape(len(image), height, width, *image.shape[2:])[:, out : height - out, out : width - out]
    return inside.reshape(len(image), pixel_count(film), *image.shape[2:])


def extended(film: Film, image: Real[Array, "R HW"]) -> Real[Array, "R N"]:
    """Extend an image from `cropped` beyond its borders, by repeating the border pixels."""
    height, width = image_shape(film)
    out = _outside(film)
    inside = image.reshape(len(image), height, width)
    return jnp.pad(inside, ((0, 0), (out, out), (out, out)), mode="edge").reshape(len(image), -1)


def correlation(film: Film) -> Float[Array | np.ndarray, "S S"]:
    """Return the correlation of the noise of pixels (y, x) with that of the middle one, due to shared samples.

    The light of a sample is assumed to be independent of its position in the pixel.
    """
    return _correlation(film) if film.shared else np.ones((1, 1), film.filter.radius.dtype)


@jax.jit
def _correlation(film: Film) -> Float[Array, "S S"]:
    heights = _heights(film.filter, film.reach)
    lags = 2 * film.reach
    padded = jnp.pad(heights, ((lags, lags), (0, 0)))
    shared = jnp.stack([(padded[lag : lag + len(heights)] * heights).sum() for lag in range(2 * lags + 1)])
    return jnp.outer(shared, shared) / shared[lags] ** 2


def _heights(filter: Filter, reach: int) -> Float[Array, "S points"]:
    """Return the filter over each pixel that it covers, at equidistant points."""
    steps = jnp.arange(-reach, reach + 1)[:, None]
    x = (jnp.arange(_POINTS) + 0.5) / _POINTS - 0.5
    return filter.evaluate((x + steps).astype(filter.radius.dtype))


@partial(jax.jit, static_argnums=1)
def _running(filter: Filter, reach: int) -> Float[Array, " edges"]:
    total = jnp.cumsum(_heights(filter, reach).sum(-1))
    return jnp.concatenate([jnp.zeros_like(total[:1]), total]) / total[-1]


def _inside(film: Film, pixel: Int[Array, ""], offset: Float[Array, "2"]) -> Float[Array, ""]:
    """Return a weight of mean 1 that restricts a pixel's filter to the crop window."""
    _, _, *size = film.crop
    weight = jnp.ones_like(offset[0])
    for place, count, distance in zip((pixel % size[0], pixel // size[0]), size, offset, strict=True):
        before, after = jnp.minimum(place, film.reach), jnp.minimum(count - 1 - place, film.reach)
        share = at(film.running, film.reach + after + 1) - at(film.running, film.reach - before)
        seen = place.astype(distance.dtype) + distance + jnp.asarray(0.5, distance.dtype)
        weight = jnp.where((seen >= 0) & (seen <= count), weight / share, 0)
    return weight


def _outside(film: Film) -> int:
    return film.reach if film.border and film.shared else 0


def with_own_samples(film: Film) -> Film:
    """Return the film whose pixels share no samples, so are independent of each other; the mean image is the same."""
    return replace(film, shared=False)
