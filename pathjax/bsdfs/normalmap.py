"""Normal maps."""

from __future__ import annotations

from jaxtyping import Array, Float

from pathjax.bsdfs.turned import Mapped
from pathjax.core.types import Surface
from pathjax.kinds import Color, Row


class NormalMap(Mapped):
    """Shading by the normals of a texture, whose channels c encode 2 c - 1 along u, across u, and along the normal."""

    normalmap = Color(listed=False, required=True)

    @staticmethod
    def normal(p: Row, surface: Surface, to_local) -> Float[Array, "3"]:
        return 2 * p.normalmap - 1
