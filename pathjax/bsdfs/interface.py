"""Base of interfaces between two media: both sides are seen, and the lobes may be tinted."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pathjax.bsdfs.bsdf import BSDF
from pathjax.kinds import Color, Row


class Interface(BSDF):
    """Glass and similar interfaces, which reflect some light and let the rest pass.

    The colour of a lobe is 1 by default. It is compiled, and is a parameter, only where a file gives one.
    """

    specular_reflectance = Color(None, absent=1.0)
    specular_transmittance = Color(None, absent=1.0)
    transmissive = sided = True

    @staticmethod
    def tinted(p: Row, value: Float[Array, ""], reflects: Bool[Array, ""]) -> Float[Array, "3"]:
        """Return a value of the reflecting lobe, or else of the transmitting one, times the colour of that lobe."""
        reflected, transmitted = p.specular_reflectance, p.specular_transmittance
        value = jnp.broadcast_to(value, (3,))
        if reflected is not None:
            value = value * jnp.where(reflects, reflected, 1)
        if transmitted is not None:
            value = value * jnp.where(reflects, 1, transmitted)
        return value
