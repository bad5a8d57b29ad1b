"""Bump maps."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.bsdfs.turned import Heights, Mapped
from pathjax.core.math import cross, dot
from pathjax.core.types import Surface
from pathjax.kinds import Number, Row


class BumpMap(Mapped):
    """Shading as if the surface were raised by the heights of a texture times `scale` (Blinn 1978)."""

    heights = Heights()
    scale = Number(1.0, listed=False)
    along_uv = True

    @staticmethod
    def normal(p: Row, surface: Surface, to_local) -> Float[Array, "3"]:
        """Return the normal of the raised surface, without the term from the curvature of the surface below."""
        by_u, by_v = p.scale * p.gradient("heights")
        (u_x, u_y, _), (v_x, v_y, _) = (to_local(d) for d in surface.along)
        n = cross(jnp.stack([u_x, u_y, by_u]), jnp.stack([v_x, v_y, by_v]))
        return jnp.where(dot(n, to_local(surface.n)) < 0, -n, n)
