"""Data of a scene that users read and kernels do not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pathjax import description as desc
from pathjax.kinds.parameter import Parameter
from pathjax.shapes.accel.build import Tree


@dataclass(frozen=True, eq=False)
class About:
    """Names, the description and reports of a scene. Equal for scenes that come from one loading."""

    description: desc.Description
    parameters: Mapping[str, Parameter]
    refused: Mapping[str, str]  # names that look like parameters -> why they are not
    trees: Mapping[str, Tree]  # kind of shape -> its hierarchy, for reports

    def __eq__(self, other):
        return isinstance(other, About) and self.parameters is other.parameters

    def __hash__(self):
        return id(self.parameters)


@dataclass(frozen=True)
class Names:
    """The part of `About` that sets parameters: equal for all scenes with the same parameters in the same locations."""

    places: tuple[tuple[str, Parameter], ...]

    @property
    def parameters(self) -> dict[str, Parameter]:
        return dict(self.places)
