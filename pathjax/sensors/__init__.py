"""Sensors, one file per kind, and the film behind them with its reconstruction filter.

A sensor is two classes of `sensor`: `Sensor`, its description in a scene file, and `Camera`, the arrays from which rays
are generated. A filter is a class of `filters`. One row in a table registers a kind for scene files and kernels.
"""

from __future__ import annotations

from pathjax.sensors.batch import Batch
from pathjax.sensors.distant import Distant
from pathjax.sensors.irradiancemeter import IrradianceMeter
from pathjax.sensors.orthographic import Orthographic
from pathjax.sensors.perspective import Perspective
from pathjax.sensors.radiancemeter import RadianceMeter
from pathjax.sensors.sensor import Camera, Sensor
from pathjax.sensors.thinlens import ThinLens

__all__ = [
    "KINDS",
    "Batch",
    "Camera",
    "Distant",
    "IrradianceMeter",
    "Orthographic",
    "Perspective",
    "RadianceMeter",
    "Sensor",
    "ThinLens",
]

# Kinds by their names in scene files.
KINDS: dict[str, type[Sensor]] = {
    "perspective": Perspective,
    "thinlens": ThinLens,
    "orthographic": Orthographic,
    "radiancemeter": RadianceMeter,
    "distant": Distant,
    "irradiancemeter": IrradianceMeter,
    "batch": Batch,
}
