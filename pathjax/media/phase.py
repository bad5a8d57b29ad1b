"""What a phase function is."""

from __future__ import annotations

from abc import abstractmethod

from jaxtyping import Array, Float

from pathjax.kinds import Kind, Row


class Phase(Kind):
    """A kind of phase function: in what directions a medium scatters, as a density that integrates to 1.

    Directions are unit and local: z points to where light, followed backwards, came from, so what goes straight on has
    wo.z = -1. It is sampled by its own density, so that samples weigh 1 but for their derivatives.
    """

    @staticmethod
    @abstractmethod
    def evaluate(p: Row, wo: Float[Array, "3"]) -> Float[Array, ""]:
        """Density [1/sr]; differentiable in the parameters."""

    @staticmethod
    @abstractmethod
    def sample(p: Row, u: Float[Array, "2"]) -> Float[Array, "3"]:
        """Draw `wo`, detached. u: uniform in [0, 1)."""
