"""Circular polarisers of either handedness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pathjax.bsdfs.sheet import UNPOLARISED, Sheet
from pathjax.kinds import Unused


class Circular(Sheet):
    """Passes half of the light straight on, since light has no polarisation here."""

    passes_of = 0.5
    unused: ClassVar[Mapping[str, Unused]] = {"left_handed": Unused("boolean", UNPOLARISED)}
