"""The contents of a scene file: plain NumPy records between a loader (`io/`) and the compiled `Scene` (`scene.py`).

A loader fills these in world space and checks the file; `scene.build` groups them by kind. Colours are linear RGB.
Matrices are float64, (4, 4), acting on column vectors. `name` is the id that parameter names begin with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from pathjax.description.elements import Document, Element, nearest
from pathjax.errors import InputError
from pathjax.kinds import Instance


@dataclass(frozen=True)
class Shape:
    name: str
    geometry: object  # a `shapes.Shape`
    bsdf: Instance
    emitter: Instance | None  # area light on it
    flip_normals: bool
    interior: Instance | None = None  # medium on the side that the normals point away from
    exterior: Instance | None = None


@dataclass(frozen=True)
class Integrator:
    max_depth: int = -1  # -1: unbounded; 1: emission only
    rr_depth: int = 5
    hide_emitters: bool = False
    free_passes: bool = False  # straight passes through a surface do not count towards max_depth
    media: bool = False  # render participating media; False: ignore them


class View(NamedTuple):
    """The settings of one sensor."""

    camera: object  # a `sensors.Sensor`
    film: object  # a `sensors.film.HDRFilm`
    spp: int
    sampler: str  # type in the file; pathjax uses its own sampler
    medium: Instance | None = None  # that the camera is in


@dataclass(frozen=True)
class Description:
    file: str
    view: View  # the one in use
    integrator: Integrator
    shapes: tuple[Shape, ...]
    emitters: tuple[Instance, ...] = ()  # not on shapes
    notes: tuple[str, ...] = field(default=())  # for `info`: dropped triangles, replaced samplers
    # The parsed file, for writing it again, and the object made from each element: an `Instance`, a `Shape`, ...
    document: Document | None = None
    made: Mapping[Element, object] = field(default_factory=dict)
    # All sensors in the order of the file, by id, or by index where they have none; an error: it cannot be used.
    views: Mapping[str, View | InputError] = field(default_factory=dict)
    seen: str = ""  # the name of `view`

    def seen_by(self, which: int | str) -> Description:
        """Return the description with the sensor of this index or name in use.

        Raises:
            InputError: there is no such sensor, or it cannot be used.
        """
        name = chosen(list(self.views), which, self.file)
        view = self.views[name]
        if isinstance(view, InputError):
            raise view
        return replace(self, view=view, seen=name)


def chosen(sensors: list[str], which: int | str, file: str) -> str:
    """Return the name of the sensor of this name or index.

    Raises:
        InputError: there is no such sensor.
    """
    if which in sensors:
        return str(which)
    if str(which).isdigit() and int(which) < len(sensors):
        return sensors[int(which)]
    ids = [name for number, name in enumerate(sensors) if name != str(number)]
    known = [f"0 to {len(sensors) - 1}" if len(sensors) > 1 else "0", *([", ".join(ids)] if ids else [])]
    raise InputError(f"{file}: there is no sensor {which!r}; use {' or '.join(known)}{nearest(str(which), ids)}")
