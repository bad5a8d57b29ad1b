"""The interface of bsdfs."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.core.types import BSDFSample
from pathjax.kinds import Instance, Kind, Row, Table


class BSDF(Kind):
    """A kind of bsdf: how one side of a surface, or an interface between two media, scatters light.

    A class declares its parameters and capabilities, samples directions and, if it is smooth, evaluates them.
    Directions are unit and local: z is the shading normal, `wi` points to the previous vertex. One-sided bsdfs always
    see `wi.z > 0`, on either side of a surface; a `sided` one keeps the frame, whose normal points to the outside.
    """

    # Capabilities, which decide what is compiled.
    smooth: ClassVar[bool] = False  # has a density, so that lights can be sampled; overrides `evaluate`
    delta: ClassVar[bool] = False  # may sample a Dirac lobe
    transmissive: ClassVar[bool] = False  # light may pass, and its radiance may scale with the IOR
    sided: ClassVar[bool] = False  # lies between two media: one bsdf for both sides of a shape
    branches: ClassVar[bool] = False  # has exactly two lobes; `sample(..., other=True)` returns the one not drawn
    anisotropic: ClassVar[bool] = False  # x of its frame points along growing u, else it is arbitrary
    lobes: ClassVar[bool] = False  # takes a third random number to choose a lobe
    passes: ClassVar[bool] = False  # light goes straight on, as if nothing were there
    along_uv: ClassVar[bool] = False  # reads `Surface.along`, the derivatives of p in u and v
    turns_back: ClassVar[bool] = False  # the bsdf on the back sees light from there as on its front

    @staticmethod
    @abstractmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Sample `wo`, as nearly in proportion to f |cos theta_o| as possible.

        Args:
            p: the parameters of one bsdf at the point.
            u: uniform in [0, 1); 2 numbers, or 3 where the kind has `lobes`.
        Returns:
            The sample; `weight` is f |cos theta_o| / pdf per channel. If no direction can be drawn, pdf and weight
            are 0, never NaN.
        Gradient: the weight carries the derivative in the parameters; `wo` and `pdf` carry none. Apply
            `lax.stop_gradient` to the parameters that they depend on, except those declared to move paths.
        """

    @staticmethod
    def evaluate(p: Row, wi: Float[Array, "3"], wo: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Return f |cos theta_o| and the density [1/sr] of `wo` in `sample`, both without Dirac lobes.

        Both are 0 where `sample` never goes. Callers ensure that wi.z > 0, unless the kind is `sided`.
        """
        return jnp.zeros_like(wi), jnp.zeros_like(wi[2])

    @classmethod
    def capable(cls, table: Table, capability: str) -> bool:
        """Return a capability of a table: the class attribute, or whether some row has the parameter of that name."""
        return table.column(capability) is not None if capability in cls.declared else getattr(cls, capability)

    @classmethod
    def sides(cls, instance: Instance) -> tuple[Instance | None, Instance | None]:
        """Return the bsdfs on the front and the back of a surface with this bsdf; None absorbs."""
        return instance, instance if cls.sided else None

    @classmethod
    def with_free_passes(cls, instance: Instance) -> Instance:
        """Return the bsdf that replaces it where going straight on through a surface is no bounce."""
        return instance

    @classmethod
    def leaves(cls, instance: Instance) -> tuple[Instance, ...]:
        """Return the bsdfs that may scatter in its place."""
        return (instance,)
