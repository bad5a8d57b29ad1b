"""Thin panes of glass."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.dielectric import IndexOfRefraction
from pathjax.bsdfs.interface import Interface
from pathjax.bsdfs.ior import IOR
from pathjax.core.math import safe_divide, smaller
from pathjax.core.types import BSDFSample
from pathjax.kinds import Row


class ThinDielectric(Interface):
    """A pane with two smooth faces so near each other that light leaves where it came in, going on straight.

    No path moves with its IOR: the weights carry the derivative.
    """

    int_ior = IndexOfRefraction(IOR["bk7"])
    ext_ior = IndexOfRefraction(IOR["air"])
    delta = True

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Reflect with the probability of doing so between the faces any number of times, else pass."""
        r, _ = fresnel.dielectric(smaller(jnp.abs(wi[2]), 1), p.int_ior / p.ext_ior)
        # r + (1 - r)^2 r (1 + r^2 + r^4 + ...)
        r = 2 * r / (1 + r)
        reflects = u[0] < lax.stop_gradient(r)
        share = jnp.where(reflects, r, 1 - r)
        pdf = lax.stop_gradient(share)
        wo = jnp.where(reflects, jnp.stack([-wi[0], -wi[1], wi[2]]), -wi)
        weight = Interface.tinted(p, safe_divide(share, pdf), reflects)
        return BSDFSample(wo, weight, pdf, jnp.bool_(True), jnp.ones_like(pdf))
