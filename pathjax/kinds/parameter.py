"""Parameters of a scene by name, `ID.field`, and where each lives in its tables."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Parameter:
    """Where a parameter lives: attributes and tuple places down to an array, and the entry in it."""

    path: tuple[str | int, ...]
    index: tuple[int, ...]
    shape: tuple[int, ...]
    bounds: tuple[float, float]
    field: str = ""  # what its kind calls it
    moves_paths: bool = False  # as the IOR of smooth glass does; others change what paths carry

    @property
    def table(self) -> tuple[str | int, ...]:
        """Path to the table of its kind, which holds `columns[place].values`."""
        return self.path[:-3]


@dataclass(frozen=True, eq=False)
class Parameters:
    """What builders find while they fill tables."""

    known: dict[str, Parameter] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  # names that look like parameters, and why they are none
