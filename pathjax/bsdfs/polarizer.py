"""Linear polarisers at any angle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pathjax.bsdfs.sheet import UNPOLARISED, Sheet
from pathjax.kinds import Unused


class Polarizer(Sheet):
    """Passes half of the light straight on, since light has no polarisation here."""

    passes_of = 0.5
    unused: ClassVar[Mapping[str, Unused]] = {
        "theta": Unused("color", UNPOLARISED),
        "polarizing": Unused("boolean", UNPOLARISED),
    }
