"""What interfaces between two media have in common: both of their sides are seen, and their lobes may be tinted."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pathjax.bsdfs.bsdf import BSDF
from pathjax.kinds import Color, Row


class Interface(BSDF):
    """Glass and its kin, which reflect some light and let the rest pass.

    A colour of a lobe is 1 where a file gives none. It is compiled, and is a parameter, only where one is given.
    """

    specular_reflectance = Color(None, absent=1.0)
    specular_transmittance = Color(None, absent=1.0)
    transmissive = sided = True

    @staticmethod
    def tinted(p: Row, value: Float[Array, ""], reflects: Bool[Array, ""]) -> Float[Array, "3"]:
        """A value of the lobe that reflects, or else of the other one, times its colour."""
        reflected, transmitted = p.specular_reflectance, p.specular_transmittance
        value = jnp.broadcast_to(value, (3,))
        if reflected is not None:
            value = value * jnp.where(reflects, reflected, 1)
        if transmitted is not None:
            value = value * jnp.where(reflects, 1, transmitted)
        return value
