"""Tabulated phase functions, for example from measurements or Mie theory."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pathjax.core.cumulated import cumulated, search
from pathjax.core.math import at, cos_sin_turns, safe_divide, safe_sqrt
from pathjax.description.numbers import numbers
from pathjax.kinds import PerRow, Row, Setting, Shared
from pathjax.media.phase import Phase


class TabPhase(Phase):
    """Values at equidistant cosines from -1 (backwards) to 1 (straight on), with linear interpolation.

    An `Instance` holds `values` (N,), N >= 2, whose scale has no effect.
    """

    values = Shared(by_number=True)  # all rows one after another, as densities of the cosine
    before = Shared(by_number=True)  # cumulative: the share of light that scatters at smaller cosines
    first = PerRow()  # () int32 index of the first value of a row
    parts = PerRow()  # () int32 number of linear parts
    most = Setting("")  # largest number of parts in any row

    @classmethod
    def read(cls, loader, fields, name):
        text = fields.string("values")
        values = np.array(numbers(fields.where("values"), text))
        if len(values) < 2 or values.min() < 0 or not values.any():
            raise fields.error("values", "must be two numbers or more, none negative, and not all 0")
        return cls.instance(name, values=values)

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        given = [np.asarray(instance.values["values"], np.float64) for instance in instances]
        shares = [(each[1:] + each[:-1]) / 2 for each in given]
        scaled = [each / (share.sum() * 2 / len(share)) for each, share in zip(given, shares, strict=True)]
        counts = [len(each) for each in given]
        table = super().build(instances, dtype, path, parameters, code)
        for key, values in {
            "values": np.asarray(np.concatenate(scaled), dtype),
            "before": np.asarray(np.concatenate([cumulated(share) for share in shares]), dtype),
            "first": np.cumsum([0, *counts[:-1]], dtype=np.int32),
            "parts": np.asarray(counts, np.int32) - 1,
        }.items():
            table = table.with_column(key, values)
        return table.with_setting("most", str(max(counts) - 1))

    @staticmethod
    def evaluate(p: Row, wo: Float[Array, "3"]) -> Float[Array, ""]:
        x = jnp.clip((1 - wo[2]) / 2, 0, 1) * p.parts.astype(wo.dtype)
        part = jnp.minimum(jnp.floor(x).astype(jnp.int32), p.parts - 1)
        low, high = at(p.values, p.first + part), at(p.values, p.first + part + 1)
        return (low + (high - low) * (x - part.astype(x.dtype))) * (1 / (2 * math.pi))

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"]) -> Float[Array, "3"]:
        """Choose a part by its share; x in it is distributed as (low x + (high - low) x^2 / 2) / ((low + high) / 2)."""
        part, u_part = search(p.before, p.first, p.parts, u[1], int(p.most))
        low, high = (lax.stop_gradient(at(p.values, p.first + part + k)) for k in (0, 1))
        x = safe_divide(u_part * (low + high), low + safe_sqrt(low * low + u_part * (high * high - low * low)))
        z = jnp.clip(1 - 2 * (part.astype(x.dtype) + x) / p.parts.astype(x.dtype), -1, 1)
        cos, sin = cos_sin_turns(u[0])
        r = safe_sqrt((1 - z) * (1 + z))
        return jnp.stack([r * cos, r * sin, z])
