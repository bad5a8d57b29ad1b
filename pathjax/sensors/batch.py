"""Several sensors side by side on one film."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import register_dataclass
from pathjax.core.math import at
from pathjax.core.types import Ray
from pathjax.description.fields import Fields
from pathjax.sensors.film import HDRFilm
from pathjax.sensors.sensor import Camera, Sensor

MOST = 1 << 16


@register_dataclass
@dataclass(frozen=True)
class Cameras(Camera):
    alike: tuple[Camera, ...]  # each stacks several cameras of one structure, a row of every array per camera
    places: Int[Array, "N 2"]  # per sensor, from the left: index into `alike`, and the row

    def sample_ray(self, position: Float[Array, "2"], u_lens: Float[Array, "2"]) -> Ray:
        count = self.places.shape[0]
        x = position[0] * count
        number = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, count - 1)
        inside = jnp.stack([x - number.astype(x.dtype), position[1]])
        place, row = at(self.places, number)

        def of(cameras):
            return lambda: jax.tree.map(lambda rows: at(rows, row), cameras).sample_ray(inside, u_lens)

        calls = [of(cameras) for cameras in self.alike]
        return calls[0]() if len(calls) == 1 else lax.switch(place, calls)


@dataclass(frozen=True)
class Batch(Sensor):
    """Sensors that get equally many columns of the film each; films of their own have no effect."""

    inside: tuple[Sensor, ...]

    inner: ClassVar[bool] = False

    @property
    def parts(self):
        return len(self.inside)

    @classmethod
    def read(cls, loader, fields: Fields) -> Batch:
        elements = fields.objects("sensor", limit=MOST)
        if not elements:
            raise fields.element.error(f"{fields.element} needs one <sensor> or more inside")
        return cls(tuple(loader.inner_sensor(element) for element in elements))

    def build(self, film: HDRFilm, dtype) -> Cameras:
        narrow = replace(film, width=film.width // self.parts)
        rows: dict[tuple, list[Camera]] = {}
        places = []
        for sensor in self.inside:
            camera = sensor.build(narrow, dtype)
            leaves, structure = jax.tree.flatten(camera)
            those = rows.setdefault((structure, tuple(map(np.shape, leaves))), [])
            places.append((list(rows.values()).index(those), len(those)))
            those.append(camera)
        alike = tuple(jax.tree.map(lambda *x: np.stack(x), *those) for those in rows.values())
        return Cameras(alike[0].origin[0], alike, np.asarray(places, np.int32))
