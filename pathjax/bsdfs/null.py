"""Nothing at all."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs.bsdf import BSDF
from pathjax.core.types import BSDFSample
from pathjax.kinds import Row


class Null(BSDF):
    """A surface that light passes as if it were not there; of masks, what is cut out."""

    delta = passes = True

    @classmethod
    def sides(cls, instance):
        return instance, instance

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Straight on."""
        one = jnp.ones_like(wi[2])
        return BSDFSample(-wi, jnp.ones_like(wi), one, jnp.bool_(True), one)


# What masks and panes hold beside something else: one row for all of them.
NOTHING = Null.instance("nothing")
