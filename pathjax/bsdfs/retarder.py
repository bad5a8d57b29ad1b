"""Wave plates, of whatever delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pathjax.bsdfs.sheet import UNPOLARISED, Sheet
from pathjax.kinds import Unused


class Retarder(Sheet):
    """All light goes straight on: light has no polarisation here."""

    passes_of = 1.0
    unused: ClassVar[Mapping[str, Unused]] = {
        "theta": Unused("color", UNPOLARISED),
        "delta": Unused("color", UNPOLARISED),
    }
