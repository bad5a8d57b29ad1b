"""Pixels, and where in them samples look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.sensors import filters
from pathjax.sensors.filters import Filter, Gaussian

MAX_PIXELS = 10**9
PIXEL_FORMATS = ("rgb", "rgba", "luminance", "luminance_alpha", "xyz", "xyza")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Film:
    filter: Filter
    width: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    crop: tuple[int, int, int, int] = field(metadata={"static": True})  # offset x, y, width, height


@dataclass(frozen=True)
class HDRFilm:
    """What a scene file says of the film."""

    width: int = 768
    height: int = 576
    crop: tuple[int, int, int, int] | None = None  # offset x, offset y, width, height; None: all of the film
    filter: Filter = Gaussian()

    unused: ClassVar[Mapping[str, Unused]] = {
        "file_format": Unused("string", choices=("openexr", "exr", "rgbe", "pfm")),
        "component_format": Unused("string", choices=("float16", "float32", "uint32")),
        "sample_border": Unused("boolean"),
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
        return cls(width, height, (x, y, crop_width, crop_height), filter)

    def build(self, dtype) -> Film:
        crop = (0, 0, self.width, self.height) if self.crop is None else tuple(self.crop)
        return Film(self.filter.build(dtype), self.width, self.height, crop)


# By the name that scene files give them.
KINDS = {"hdrfilm": HDRFilm}


def sample_position(
    film: Film, pixel: Int[Array, ""], u: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Where a sample of a pixel looks.

    Args:
        pixel: row by row over the crop window.
    Returns:
        position in [0, 1]^2 over the whole film (a wide filter reaches beyond), and weight, of mean 1.
    """
    x0, y0, width, _ = film.crop
    center = jnp.stack([pixel % width + x0, pixel // width + y0]).astype(u.dtype) + jnp.asarray(0.5, u.dtype)
    offset, weight = film.filter.sample(u)
    return (center + offset) / jnp.array([film.width, film.height], u.dtype), weight


def pixel_count(film: Film) -> int:
    return film.crop[2] * film.crop[3]


def image_shape(film: Film) -> tuple[int, int]:
    """Height and width of the image, that of the crop window."""
    return film.crop[3], film.crop[2]
