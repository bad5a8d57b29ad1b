"""Interface of sensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Array, Float

from pathjax.core.types import Ray
from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.sensors.film import HDRFilm


@dataclass(frozen=True)
class Camera(ABC):
    """A sensor in a scene: a pytree of arrays of the scene's dtype."""

    origin: Float[Array, "3"]  # in world space

    gain: ClassVar[float] = 1  # measured quantity over the mean radiance of the rays

    @abstractmethod
    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        """Return the ray through a point of the film; it starts on no primitive.

        Args:
            position: in [0, 1]^2 over the whole film, from the upper left corner; a wide filter reaches beyond.
            u_lens: uniform in [0, 1), for sensors with an aperture.
        Differentiable in position and in the arrays.
        """


class Sensor(ABC):
    """Description of a sensor in a scene file, of NumPy arrays and scalars."""

    one_pixel: ClassVar[bool] = False  # measures one value, whatever the filter
    parts: ClassVar[int] = 1  # parts of the film, side by side
    inner: ClassVar[bool] = True  # may be such a part
    # Nothing moves while the shutter is open.
    unused: ClassVar[Mapping[str, Unused]] = {"shutter_open": Unused("float"), "shutter_close": Unused("float")}

    @classmethod
    @abstractmethod
    def read(cls, loader, fields: Fields) -> Sensor:
        """Read the fields of an element, except film and sampler, which the loader reads."""

    @staticmethod
    def read_clips(fields: Fields) -> tuple[float, float]:
        """Read the near and far clip distances."""
        near, far = fields.float("near_clip", 1e-2, above=0), fields.float("far_clip", 1e4, above=0)
        if near >= far:
            raise fields.error("near_clip", f"must be smaller than far_clip, {far:g}; is {near:g}")
        return near, far

    @abstractmethod
    def build(self, film: HDRFilm, dtype) -> Camera:
        """Return the camera; the size of `film` gives its aspect ratio."""
