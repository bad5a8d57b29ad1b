"""Wave plates of any retardance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pathjax.bsdfs.sheet import UNPOLARISED, Sheet
from pathjax.kinds import Unused


class Retarder(Sheet):
    """Passes all light straight on, since light has no polarisation here."""

    passes_of = 1.0
    unused: ClassVar[Mapping[str, Unused]] = {
        "theta": Unused("color", UNPOLARISED),
        "delta": Unused("color", UNPOLARISED),
    }
