"""Thin panes of glass."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.dielectric import IndexOfRefraction
from pathjax.bsdfs.interface import Interface
from pathjax.bsdfs.ior import IOR
from pathjax.bsdfs.null import NOTHING
from pathjax.bsdfs.wrapper import Choosing
from pathjax.core.math import safe_divide, smaller
from pathjax.core.types import BSDFSample
from pathjax.kinds import Row


def reflectance(p: Row, cos: Float[Array, ""]) -> Float[Array, ""]:
    """Return the share of light that a pane reflects, with any number of reflections between its faces."""
    r, _ = fresnel.dielectric(smaller(cos, 1), p.int_ior / p.ext_ior)
    # The sum r + (1 - r)^2 r (1 + r^2 + r^4 + ...).
    return 2 * r / (1 + r)


class ThinDielectric(Interface):
    """A pane whose smooth faces are so close that transmitted light leaves where it entered and goes straight on.

    Paths do not move with its IOR: the weights carry the derivative. Where going straight on is no bounce, it becomes a
    `Pane`, which shadow rays pass too, unless it has a `specular_transmittance`.
    """

    int_ior = IndexOfRefraction(IOR["bk7"])
    ext_ior = IndexOfRefraction(IOR["air"])
    delta = True

    @classmethod
    def read(cls, loader, fields, name):
        made = super().read(loader, fields, name)
        if loader.integrator.free_passes and made.values["specular_transmittance"] is not None:
            where = fields.where("specular_transmittance")
            loader.note(where, "makes the pane a bounce that casts shadows; in Mitsuba light samples pass it")
        return made

    @classmethod
    def with_free_passes(cls, instance):
        values = dict(instance.values)
        if values["specular_transmittance"] is not None:
            return instance
        mirror = Reflection.instance(instance.name, specular_reflectance=values.pop("specular_reflectance"))
        return Pane.holding(instance.name, mirror, NOTHING, **values)

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Reflect with the probability `reflectance`, else go straight on."""
        r = reflectance(p, jnp.abs(wi[2]))
        reflects = u[0] < lax.stop_gradient(r)
        share = jnp.where(reflects, r, 1 - r)
        pdf = lax.stop_gradient(share)
        wo = jnp.where(reflects, jnp.stack([-wi[0], -wi[1], wi[2]]), -wi)
        weight = Interface.tinted(p, safe_divide(share, pdf), reflects)
        return BSDFSample(wo, weight, pdf, jnp.bool_(True), jnp.ones_like(pdf))


class Reflection(Interface):
    """The mirror inside a `Pane`, for the light that it reflects."""

    transmissive, delta = False, True

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Return the mirror direction."""
        one = jnp.ones_like(wi[2])
        weight = Interface.tinted(p, one, jnp.bool_(True))
        return BSDFSample(jnp.stack([-wi[0], -wi[1], wi[2]]), weight, one, jnp.bool_(True), one)


class Pane(Choosing, ThinDielectric):
    """A mirror or nothing, chosen by the shares of light that are reflected and go straight on."""

    transmissive = delta = False

    @staticmethod
    def share(p: Row, cos):
        return 1 - reflectance(p, cos)
