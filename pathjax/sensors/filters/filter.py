"""What a reconstruction filter is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, Float

from pathjax.description.fields import Fields
from pathjax.kinds import Unused


class Filter(ABC):
    """A filter, a pytree: of numbers as a scene file has them, and once built of arrays."""

    unused: ClassVar[Mapping[str, Unused]] = {}
    radius: jax.Array | float  # () pixels, beyond which it is 0

    @classmethod
    @abstractmethod
    def read(cls, loader, fields: Fields) -> Filter:
        """Ask for what an element may hold."""

    def build(self, dtype) -> Filter:
        """What kernels take."""
        return jax.tree.map(lambda x: np.asarray(x, dtype), self)

    @abstractmethod
    def sample(self, u: Float[Array, "2"]) -> tuple[Float[Array, "2"], Float[Array, ""]]:
        """Draw where a sample of a pixel looks, from u uniform in [0, 1).

        Returns:
            offset from the middle of the pixel, in pixels, and weight of mean 1: weighted samples have the filter for
            their density.
        """

    @abstractmethod
    def evaluate(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Height at a distance in pixels along one axis, up to a factor; 0 beyond the radius."""
