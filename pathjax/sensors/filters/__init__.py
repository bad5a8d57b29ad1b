"""Reconstruction filters, a file a kind: through one of them each pixel looks.

Samples count in all pixels under the filter by its height there, `evaluate`. Where pixels are to be independent of each
other, each draws its own by importance instead, `sample`, with weights that average to 1.
"""

from __future__ import annotations

from pathjax.sensors.filters.box import Box
from pathjax.sensors.filters.filter import Filter
from pathjax.sensors.filters.gaussian import Gaussian
from pathjax.sensors.filters.lanczos import Lanczos
from pathjax.sensors.filters.mitchell import CatmullRom, Mitchell
from pathjax.sensors.filters.tent import Tent

__all__ = ["KINDS", "Box", "CatmullRom", "Filter", "Gaussian", "Lanczos", "Mitchell", "Tent"]

# By the name that scene files give them.
KINDS: dict[str, type[Filter]] = {
    "box": Box,
    "tent": Tent,
    "gaussian": Gaussian,
    "mitchell": Mitchell,
    "catmullrom": CatmullRom,
    "lanczos": Lanczos,
}
