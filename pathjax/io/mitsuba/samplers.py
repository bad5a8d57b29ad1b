"""Samplers of scene files. pathjax uses only their sample count, and draws samples from its own sequence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pathjax.description.fields import Fields
from pathjax.kinds import Unused

DEFAULT_COUNT = 4


class Sampler:
    unused: ClassVar[Mapping[str, Unused]] = {"seed": Unused("integer")}

    @classmethod
    def read(cls, loader, fields: Fields) -> int:
        loader.note(fields.element, "sets sample_count alone; pathjax draws its samples from its own sequence")
        return fields.integer("sample_count", DEFAULT_COUNT, at_least=1)


class Stratified(Sampler):
    unused = Sampler.unused | {"jitter": Unused("boolean")}


class Orthogonal(Stratified):
    unused = Stratified.unused | {"strength": Unused("integer")}


# Kinds by their names in scene files.
KINDS = {
    "independent": Sampler,
    "stratified": Stratified,
    "multijitter": Stratified,
    "orthogonal": Orthogonal,
    "ldsampler": Sampler,
}
