"""The interface of textures."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.core.types import Surface
from pathjax.kinds import Color, Instance, Kind, Row, Transform2


class Texture(Kind):
    """A kind of texture: colours over a surface.

    A class declares its parameters; its `look_up` returns the colour of a point. It may be differentiated in its
    parameters and in uv.
    """

    fills_places = True
    to_uv = Transform2()
    over_uv: ClassVar[bool] = True  # colours depend on uv, so that they have a gradient in it

    @staticmethod
    @abstractmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        """Return the colour at a point. uv: that of the surface, with `to_uv` applied."""

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        """Return the numbers that `look_up` is a weighted sum of, for derivatives in them: parameter, entry, weight ().

        The entry is an index in a `Shared` array; None: the row of the texture. A kind that returns no numbers is only
        differentiated forwards.
        """
        return []

    @classmethod
    def with_entries(cls, p: Row, uv: Float[Array, "2"], surface: Surface) -> tuple[Float[Array, "3"], list]:
        """Return `look_up` and `entries`, for kinds that compute both together at less cost."""
        return cls.look_up(p, uv, surface), cls.entries(p, uv, surface)

    @classmethod
    def has_entries(cls) -> bool:
        return cls.entries is not Texture.entries

    @classmethod
    def attributes(cls, settings: Mapping[str, str]) -> list[str]:
        """Return the names of the mesh attributes that a table looks up; `entries` may name them too."""
        return []

    @classmethod
    def span(cls, texture: Instance) -> tuple[float, float]:
        """Return the least and largest value of the texture; NaN where it contains one."""
        spans = [x.kind.span(x) if isinstance(x, Instance) else (np.min(x), np.max(x)) for x in cls.colors(texture)]
        return float(np.min(spans)), float(np.max(spans))

    @classmethod
    def mean(cls, texture: Instance) -> np.ndarray | None:
        """Return the mean colour (3,), by which a light with this texture is chosen; None: lights cannot have it."""
        means = [x.kind.mean(x) if isinstance(x, Instance) else np.broadcast_to(x, 3) for x in cls.colors(texture)]
        return None if any(mean is None for mean in means) or not means else np.mean(means, axis=0)

    @classmethod
    def parts_of_mean(cls, texture: Instance) -> list[str]:
        """Return the names of the parameters that `mean` averages."""
        return [key for key, declared in cls.declared.items() if isinstance(declared, Color)]

    @classmethod
    def colors(cls, texture: Instance) -> list:
        """Return its colours, each (3,), a number, or a texture."""
        return [texture.values[key] for key in cls.parts_of_mean(texture)]

    @classmethod
    def of_number(cls, texture: Instance, held: Callable[[Instance], Instance]) -> Instance:
        """Return the texture in the form that stands for a number. held: the same function for a texture inside it."""
        return texture

    @classmethod
    def follows_uv(cls, texture: Instance) -> bool:
        """Return whether it and all textures that it holds are `over_uv`."""
        held = [x for x in texture.values.values() if isinstance(x, Instance)]
        return cls.over_uv and all(x.kind.follows_uv(x) for x in held)

    @classmethod
    def resolution(cls, texture: Instance) -> tuple[int, int]:
        """Return height and width in texels; 1, 1 if it has none."""
        return 1, 1

    @classmethod
    def refused(cls, name: str) -> dict[str, str]:
        """Return the names that are no parameters because this texture is in their place, and why."""
        return {name: f"{name} is a texture; its parameters have names of their own (`pathjax info` lists them)"}
