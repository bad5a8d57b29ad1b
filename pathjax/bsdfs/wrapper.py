"""What a bsdf that holds other bsdfs is."""

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
    """A kind of bsdf that holds others, of which at each point one scatters: `bsdfs.tree` finds out which.

    An `Instance` holds them under "held", a tuple.
    """

    nested: ClassVar[int] = 1  # bsdfs that stand inside it in a file
    chooses: ClassVar[bool] = False  # among these, by `share`
    nodes = PerRow()  # (2, bsdfs held, 3) int32: of its front and its back, the `tree.Node`s of what it holds

    @classmethod
    def holding(cls, name: str, *held: Instance, **values) -> Instance:
        """An object of this kind without a file, of the bsdfs that would stand inside."""
        made = cls.instance(name, **values)
        return Instance(cls, name, {**made.values, "held": held})

    @classmethod
    def read(cls, loader, fields, name):
        elements = fields.objects("bsdf", limit=cls.nested)
        if len(elements) < cls.nested:
            wanted = "a <bsdf>" if cls.nested == 1 else f"{cls.nested} <bsdf>s"
            raise fields.element.error(f"{fields.element} needs {wanted} inside, and has {len(elements)}")
        # What stands alone in it is known by its name.
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
    """Two bsdfs, of which chance takes one at each point, so that it is their mixture in the mean."""

    chooses = True

    @classmethod
    def with_free_passes(cls, instance):
        held = tuple(each.kind.with_free_passes(each) for each in instance.values["held"])
        same = all(map(operator.is_, held, instance.values["held"]))
        return instance if same else Instance(instance.kind, instance.name, {**instance.values, "held": held})

    @staticmethod
    @abstractmethod
    def share(p: Row, cos: Float[Array, ""]) -> Float[Array, ""]:
        """The probability of the second one. cos: in [0, 1], of the angle between the ray and the normal."""


class Turning(Wrapper):
    """A bsdf in another shading frame, which is detached: a derivative in what turns it is refused by name.

    Where it would show its back to who looks at the front, it is turned the other way (Schuessler et al. 2017), and
    light is dimmed where the turned frame would see it too far down (Conty Estevez et al. 2019); rows may do without.
    """

    anisotropic = True

    @staticmethod
    @abstractmethod
    def normal(
        p: Row, surface: Surface, to_local: Callable[[Float[Array, "3"]], Float[Array, "3"]]
    ) -> Float[Array, "3"]:
        """The turned normal, of any length, in the frame that the surface had before.

        to_local: of a vector in world space, its coordinates in that frame.
        """
