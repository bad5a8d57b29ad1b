"""Bsdfs that hold other bsdfs."""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

from jaxtyping import Array, Float

from pathjax.bsdfs.bsdf import BSDF
from pathjax.core.types import Surface
from pathjax.kinds import Instance, PerRow, Row


class Wrapper(BSDF):
    """A kind of bsdf that holds others, one of which scatters at each point: `bsdfs.tree` chooses it.

    The values of an `Instance` have them under "held", a tuple.
    """

    nested: ClassVar[int] = 1  # number of bsdfs inside its element in a file
    chooses: ClassVar[bool] = False  # chooses one of them by `share`
    nodes = PerRow()  # (2, bsdfs held, 3) int32: on its front and its back, the `tree.Node` of each bsdf held

    @classmethod
    def holding(cls, name: str, *held: Instance, **values) -> Instance:
        """Return an instance without a file, given the bsdfs that a file would nest inside."""
        made = cls.instance(name, **values)
        return Instance(cls, name, {**made.values, "held": held})

    @classmethod
    def read(cls, loader, fields, name):
        elements = fields.objects("bsdf", limit=cls.nested)
        if len(elements) < cls.nested:
            wanted = "a <bsdf>" if cls.nested == 1 else f"{cls.nested} <bsdf>s"
            raise fields.element.error(f"{fields.element} needs {wanted} inside, and has {len(elements)}")
        # A single nested bsdf takes the name of its wrapper.
        names = [name] if cls.nested == 1 else [loader.unique(f"{name}_{place}") for place in range(cls.nested)]
        held = [loader.bsdf(element, each) for element, each in zip(elements, names, strict=True)]
        return cls.holding(name, *held, **super().read(loader, fields, name).values)

    @classmethod
    def sides(cls, instance):
        return instance, instance

    @classmethod
    def leaves(cls, instance):
        return tuple(leaf for each in instance.values["held"] for leaf in each.kind.leaves(each))

    @staticmethod
    def sample(p, wi, u):
        raise NotImplementedError("one of the bsdfs that a wrapper holds scatters")


class Choosing(Wrapper):
    """Two bsdfs, one of which is chosen at random at each point: their mixture in expectation."""

    chooses = True

    @classmethod
    def with_free_passes(cls, instance):
        held = tuple(each.kind.with_free_passes(each) for each in instance.values["held"])
        same = all(map(operator.is_, held, instance.values["held"]))
        return instance if same else Instance(instance.kind, instance.name, {**instance.values, "held": held})

    @staticmethod
    @abstractmethod
    def share(p: Row, cos: Float[Array, ""]) -> Float[Array, ""]:
        """Return the probability of the second one. cos: in [0, 1], of the angle between the ray and the normal."""


class Turning(Wrapper):
    """A bsdf in a turned shading frame. The frame is detached; derivatives in its parameters are refused by name.

    Where a ray that sees the front of the surface would see the back of the turned frame, or conversely, the normal is
    tilted the other way (Schuessler et al. 2017). Light that grazes the surface below a turned frame is dimmed (Conty
    Estevez et al. 2019). Rows may switch off either.
    """

    anisotropic = True

    @staticmethod
    @abstractmethod
    def normal(
        p: Row, surface: Surface, to_local: Callable[[Float[Array, "3"]], Float[Array, "3"]]
    ) -> Float[Array, "3"]:
        """Return the turned normal, of any length, in the frame before the turn.

        to_local: maps a vector from world space to that frame.
        """
