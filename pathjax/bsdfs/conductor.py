"""Smooth metals and ideal mirrors."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pathjax.bsdfs import fresnel
from pathjax.bsdfs.bsdf import BSDF
from pathjax.core.types import BSDFSample
from pathjax.kinds import Color, Row


class Conductor(BSDF):
    """Smooth one-sided metal. Without eta and k it is Mitsuba's material "none", an ideal mirror."""

    specular_reflectance = Color(1.0, textured=False)
    eta = Color(None, bounds=(0, math.inf), textured=False)
    k = Color(None, bounds=(0, math.inf), textured=False)
    delta = True

    @classmethod
    def read(cls, loader, fields, name):
        material = fields.string("material", "none")
        if material != "none":
            raise fields.error("material", f'cannot be "{material[:40]}"; give eta and k as <rgb>')
        made = super().read(loader, fields, name)
        given = [made.values[key] is not None for key in ("eta", "k")]
        # Of "none" eta is 0 and k is 1: all is reflected.
        defaults = {"eta": np.zeros(3), "k": np.ones(3)} if any(given) else {}
        return cls.instance(name, **{key: defaults.get(key) if v is None else v for key, v in made.values.items()})

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        table = super().build(instances, dtype, path, parameters, code)
        if (k := table.column("k")) is None:
            return table
        # Ideal mirrors among metals: with eta = 0 any k > 0 reflects all.
        ideal = np.array([instance.values["k"] is None for instance in instances])[:, None]
        return table.with_column("k", np.where(ideal, np.ones(1, k.values.dtype), k.values))

    @staticmethod
    def sample(p: Row, wi: Float[Array, "3"], u: Float[Array, " numbers"]) -> BSDFSample:
        """Mirror direction; the weight is the Fresnel reflectance times `specular_reflectance`."""
        weight = p.specular_reflectance
        if (eta := p.eta) is not None:
            weight = weight * fresnel.conductor(wi[2], eta, p.k)
        one = jnp.ones_like(wi[2])
        return BSDFSample(jnp.stack([-wi[0], -wi[1], wi[2]]), weight, one, jnp.bool_(True), one)
