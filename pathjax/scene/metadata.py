"""What people ask of a scene and kernels do not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pathjax import description as desc
from pathjax.kinds.parameter import Parameter
from pathjax.shapes.accel.build import Tree


@dataclass(frozen=True, eq=False)
class About:
    """What people ask of a scene and kernels do not: names, the file, reports. Equal for scenes of one loading."""

    description: desc.Description
    parameters: Mapping[str, Parameter]
    refused: Mapping[str, str]  # what is none, though it looks like one, and why
    trees: Mapping[str, Tree]  # kind of shape -> its hierarchy, for reports

    def __eq__(self, other):
        return isinstance(other, About) and self.parameters is other.parameters

    def __hash__(self):
        return id(self.parameters)


@dataclass(frozen=True)
class Names:
    """The part of `About` that sets parameters: equal for all scenes that have these in the same places."""

    places: tuple[tuple[str, Parameter], ...]

    @property
    def parameters(self) -> dict[str, Parameter]:
        return dict(self.places)
