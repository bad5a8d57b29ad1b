"""The interface of phase functions."""

from __future__ import annotations

from abc import abstractmethod

from jaxtyping import Array, Float

from pathjax.kinds import Kind, Row


class Phase(Kind):
    """A kind of phase function: the density, with integral 1, of the directions into which a medium scatters.

    Directions are unit and local: z points to the previous vertex of the path, so wo.z = -1 is straight on. Samples are
    drawn by this density, so that their weights are 1 in value, but carry derivatives.
    """

    @staticmethod
    @abstractmethod
    def evaluate(p: Row, wo: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the density [1/sr], differentiable in the parameters."""

    @staticmethod
    @abstractmethod
    def sample(p: Row, u: Float[Array, "2"]) -> Float[Array, "3"]:
        """Sample `wo`, detached. u: uniform in [0, 1)."""
