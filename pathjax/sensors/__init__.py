"""What measures light: sensors, a file a kind, and the film behind them with its reconstruction filter.

A sensor is two classes of `sensor`: `Sensor`, what a scene file says of one, and `Camera`, the arrays that a ray is
made of. A filter is a class of `filters`. One row in a table makes a kind exist for scene files and in kernels.
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

# By the name that scene files give them.
KINDS: dict[str, type[Sensor]] = {
    "perspective": Perspective,
    "thinlens": ThinLens,
    "orthographic": Orthographic,
    "radiancemeter": RadianceMeter,
    "distant": Distant,
    "irradiancemeter": IrradianceMeter,
    "batch": Batch,
}
