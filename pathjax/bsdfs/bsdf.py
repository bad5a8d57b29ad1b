"""What a bsdf is."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.types import BSDFSample
from pathjax.kinds import Instance, Kind, Row, Table


class BSDF(Kind):
    """A kind of bsdf: how one side of a surface, or an interface between two media, scatters light.

    A class declares its parameters and what it is capable of, samples directions, and, where it is smooth, evaluates
    them. Directions are unit and local: z is the shading normal, `wi` points to the previous vertex. Reflectors see
    `wi.z > 0`, whatever side they are on; what is `sided` keeps the frame, whose normal tells inside from outside.
    """

    # What is compiled, for whom, depends on these.
    smooth: ClassVar[bool] = False  # has a density, so that light sampling makes sense: `evaluate` is its own
    delta: ClassVar[bool] = False  # may draw from a Dirac lobe
    transmissive: ClassVar[bool] = False  # light may pass, and its radiance scale with the IOR
    sided: ClassVar[bool] = False  # lies between two media: one bsdf for both sides of a shape
    branches: ClassVar[bool] = False  # has just two lobes, of which `sample(..., other=True)` gives what is not drawn
    anisotropic: ClassVar[bool] = False  # x of its frame is the way that u grows, else any
    lobes: ClassVar[bool] = False  # takes a third random number, to choose its lobe
    passes: ClassVar[bool] = False  # light goes straight on, as if nothing were there
    along_uv: ClassVar[bool] = False  # asks the surface how its point moves with u and v
    turns_back: ClassVar[bool] = False  # what lies on the back sees what comes from there as its own front does

    @staticmethod
    @abstractmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Draw `wo`, in proportion to f |cos theta_o| as well as may be.

        Args:
            p: the parameters of one bsdf at the point.
            u: uniform in [0, 1); 2 numbers, or 3 where the kind has `lobes`.
        Returns:
            The sample; `weight` is f |cos theta_o| / pdf per channel. Where nothing can be drawn pdf and weight are 0,
            never NaN.
        Gradient: the weight carries the derivative in the parameters, `wo` and `pdf` none: put `lax.stop_gradient`
            around the parameters that they depend on (but for those that are declared to move paths).
        """

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """f |cos theta_o| and the density [1/sr] with which `sample` draws `wo`, without Dirac lobes.

        Both are 0 where `sample` never goes. wi.z > 0 is the caller's to see to, unless the kind is `sided`.
        """
        return jnp.zeros_like(wi), jnp.zeros_like(wi[2])

    @classmethod
    def capable(cls, table: Table, capability: str) -> bool:
        """Whether rows of a table are: as the class says, or, of what is one of its parameters, where a row has it."""
        return table.column(capability) is not None if capability in cls.declared else getattr(cls, capability)

    @classmethod
    def sides(cls, instance: Instance) -> tuple[Instance | None, Instance | None]:
        """What the front and the back of a surface of this bsdf are; None absorbs."""
        return instance, instance if cls.sided else None

    @classmethod
    def with_free_passes(cls, instance: Instance) -> Instance:
        """What stands for it where going straight on through a surface is no bounce."""
        return instance

    @classmethod
    def leaves(cls, instance: Instance) -> tuple[Instance, ...]:
        """The bsdfs that scatter, of all that it may be."""
        return (instance,)
