"""Smooth metals and ideal mirrors."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.metals import METALS
from pathjax.core.types import BSDFSample
from pathjax.description.elements import nearest
from pathjax.kinds import Color, Row


class Conductor(BSDF):
    """Smooth one-sided metal. Without eta and k it is Mitsuba's material "none", an ideal mirror."""

    specular_reflectance = Color(1.0)
    eta = Color(None, bounds=(0, math.inf))
    k = Color(None, bounds=(0, math.inf), absent=1.0)  # absent: an ideal mirror among metals, whose eta is 0
    delta = True

    @classmethod
    def read(cls, loader, fields, name):
        material = fields.string("material", "none")
        if material != "none" and material not in METALS:
            use = f'use "none" or one of {", ".join(METALS)}{nearest(material, METALS)}'
            raise fields.error("material", f'cannot be "{material[:40]}"; {use}')
        values = super().read(loader, fields, name).values
        given = [key for key in ("eta", "k") if values[key] is not None]
        if material != "none":
            if given:
                raise fields.error(given[0], "cannot stand beside material; give either eta and k, or material")
            defaults = dict(zip(("eta", "k"), map(np.array, METALS[material]), strict=True))
        else:
            # "none" has eta = 0 and k = 1, which reflects all light.
            defaults = {"eta": np.zeros(3), "k": np.ones(3)} if given else {}
        return cls.instance(name, **{key: defaults.get(key) if v is None else v for key, v in values.items()})

    @staticmethod
    def reflectance(p: Row, cos: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the Fresnel reflectance times `specular_reflectance`. cos: in [0, 1], of the angle of incidence."""
        share = p.specular_reflectance
        if (eta := p.eta) is not None:
            share = share * fresnel.conductor(cos, eta, p.k)
        return share

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Return the mirror direction; the weight is the reflectance."""
        weight, one = Conductor.reflectance(p, wi[2]), jnp.ones_like(wi[2])
        return BSDFSample(jnp.stack([-wi[0], -wi[1], wi[2]]), weight, one, jnp.bool_(True), one)
