"""What a scene file says: plain NumPy records between a loader (`io/`) and the compiled `Scene` (`scene.py`).

A loader fills these in world space and checks the file; `scene.build` groups them by kind. Colours are linear RGB.
Matrices are float64, (4, 4), acting on column vectors. `name` is the id that parameters are looked up by.
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
    emitter: Instance | None  # that shines from it
    flip_normals: bool
    interior: Instance | None = None  # medium on the side that the normals point away from
    exterior: Instance | None = None


@dataclass(frozen=True)
class Integrator:
    max_depth: int = -1  # -1: unbounded; 1: emission only
    rr_depth: int = 5
    hide_emitters: bool = False
    free_passes: bool = False  # straight through a surface is no bounce that counts for max_depth
    media: bool = False  # participating media are rendered; else they are left out


class View(NamedTuple):
    """What one sensor says."""

    camera: object  # a `sensors.Sensor`
    film: object  # a `sensors.film.HDRFilm`
    spp: int
    sampler: str  # the type that the file names; pathjax uses its own
    medium: Instance | None = None  # in which the camera is


@dataclass(frozen=True)
class Description:
    file: str
    view: View  # which is used
    integrator: Integrator
    shapes: tuple[Shape, ...]
    emitters: tuple[Instance, ...] = ()  # those that stand outside of shapes
    notes: tuple[str, ...] = field(default=())  # what `info` should tell: dropped triangles, replaced samplers
    # What was read, to be written again, and what each of its elements became: an `Instance`, a `Shape`, ...
    document: Document | None = None
    made: Mapping[Element, object] = field(default_factory=dict)
    # All sensors in the order of the file, by id, or by number where they have none; or why one cannot be used.
    views: Mapping[str, View | InputError] = field(default_factory=dict)
    seen: str = ""  # the name of `view`

    def seen_by(self, which: int | str) -> Description:
        """The description as the sensor of this number or name sees it.

        Raises:
            InputError: there is none, or it cannot be used.
        """
        name = chosen(list(self.views), which, self.file)
        view = self.views[name]
        if isinstance(view, InputError):
            raise view
        return replace(self, view=view, seen=name)


def chosen(sensors: list[str], which: int | str, file: str) -> str:
    """The name of the sensor of this name or number.

    Raises:
        InputError: there is none.
    """
    if which in sensors:
        return str(which)
    if str(which).isdigit() and int(which) < len(sensors):
        return sensors[int(which)]
    ids = [name for number, name in enumerate(sensors) if name != str(number)]
    known = [f"0 to {len(sensors) - 1}" if len(sensors) > 1 else "0", *([", ".join(ids)] if ids else [])]
    raise InputError(f"{file}: there is no sensor {which!r}; use {' or '.join(known)}{nearest(str(which), ids)}")
