"""Where a parameter lives in the tables of a scene."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """Where a parameter lives: attributes and tuple places down to an array, and the entry in it."""

    path: tuple[str | int, ...]
    index: tuple[int, ...]
    shape: tuple[int, ...]
    bounds: tuple[float, float]
