"""Surfaces without effect on light."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs.bsdf import BSDF
from pathjax.core.types import BSDFSample
from pathjax.kinds import Row


class Null(BSDF):
    """A surface that light passes as if it were not there; also the cut-outs of masks."""

    delta = passes = True

    @classmethod
    def sides(cls, instance):
        return instance, instance

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Continue straight on."""
        one = jnp.ones_like(wi[2])
        return BSDFSample(-wi, jnp.ones_like(wi), one, jnp.bool_(True), one)


# The second bsdf of masks, sheets and panes: one row for all of them.
NOTHING = Null.instance("nothing")
