"""The thin-lens camera: sharp only in the plane of focus."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.warp import square_to_disk
from pathjax.description.fields import Fields
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.perspective import Perspective, PerspectiveCamera
from pathjax.sensors.sensor import Sensor


@register_dataclass
@dataclass(frozen=True)
class ThinLensCamera(PerspectiveCamera):
    aperture_radius: Float[Array, ""]
    focus_distance: Float[Array, ""]  # along the optical axis

    def through_lens(
        self, local: Float[Array, "3"], u_lens: Float[Array, "2"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        aperture = self.aperture_radius * square_to_disk(u_lens)
        start = jnp.stack([aperture[0], aperture[1], jnp.zeros_like(local[0])])
        return compute_once((start, local * self.focus_distance - start))


@dataclass(frozen=True)
class ThinLens(Perspective):
    aperture_radius: float = 0.0
    focus_distance: float = 1.0

    unused = Sensor.unused

    @staticmethod
    def read_lens(fields: Fields, far: float) -> dict[str, float]:
        radius = fields.float("aperture_radius", at_least=0)
        return {"aperture_radius": radius, "focus_distance": fields.float("focus_distance", far, above=0)}

    def build(self, film: HDRFilm, dtype) -> ThinLensCamera:
        lens = (np.asarray(x, dtype) for x in (self.aperture_radius, self.focus_distance))
        return ThinLensCamera(*self.arrays(film, dtype), *lens)
