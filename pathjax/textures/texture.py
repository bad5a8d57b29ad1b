"""What a texture is."""

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

    A class declares its parameters, and says in `look_up` what colour a point has. It may be differentiated in its
    parameters and in uv.
    """

    fills_places = True
    to_uv = Transform2()
    over_uv: ClassVar[bool] = True  # colours follow from uv, so that they slope along it

    @staticmethod
    @abstractmethod
    def look_up(p: Row, uv: Float[Array, "2"], surface: Surface) -> Float[Array, "3"]:
        """Colour at a point, whose uv is that of the surface with `to_uv` applied."""

    @staticmethod
    def entries(p: Row, uv: Float[Array, "2"], surface: Surface) -> list[tuple[str, Int[Array, ""] | None, Array]]:
        """Return the numbers that `look_up` is a weighted sum of, for derivatives in them: parameter, entry, weight ().

        The entry is that in a `Shared` array; None: the row of the texture. A kind that returns none is differentiated
        forwards only.
        """
        return []

    @classmethod
    def with_entries(cls, p: Row, uv: Float[Array, "2"], surface: Surface) -> tuple[Float[Array, "3"], list]:
        """`look_up` and `entries`, for a kind that finds them together at less cost."""
        return cls.look_up(p, uv, surface), cls.entries(p, uv, surface)

    @classmethod
    def tells_entries(cls) -> bool:
        return cls.entries is not Texture.entries

    @classmethod
    def attributes(cls, settings: Mapping[str, str]) -> list[str]:
        """Names of what meshes carry that a table of these settings looks up; `entries` may name them, too."""
        return []

    @classmethod
    def span(cls, texture: Instance) -> tuple[float, float]:
        """Least and largest value that the texture has; NaN where it holds one."""
        spans = [x.kind.span(x) if isinstance(x, Instance) else (np.min(x), np.max(x)) for x in cls.colors(texture)]
        return float(np.min(spans)), float(np.max(spans))

    @classmethod
    def mean(cls, texture: Instance) -> np.ndarray | None:
        """(3,) colour by which a light that it covers is chosen among others; None: the texture cannot cover lights."""
        means = [x.kind.mean(x) if isinstance(x, Instance) else np.broadcast_to(x, 3) for x in cls.colors(texture)]
        return None if any(mean is None for mean in means) or not means else np.mean(means, axis=0)

    @classmethod
    def parts_of_mean(cls, texture: Instance) -> list[str]:
        """Names of what `mean` is the mean of."""
        return [key for key, declared in cls.declared.items() if isinstance(declared, Color)]

    @classmethod
    def colors(cls, texture: Instance) -> list:
        """What its colours are, (3,) or one number each, or textures."""
        return [texture.values[key] for key in cls.parts_of_mean(texture)]

    @classmethod
    def of_number(cls, texture: Instance, held: Callable[[Instance], Instance]) -> Instance:
        """The texture as it is where it stands for a number; held: the same of a texture inside it."""
        return texture

    @classmethod
    def follows_uv(cls, texture: Instance) -> bool:
        """Whether it, and all that it holds, is `over_uv`."""
        held = [x for x in texture.values.values() if isinstance(x, Instance)]
        return cls.over_uv and all(x.kind.follows_uv(x) for x in held)

    @classmethod
    def resolution(cls, texture: Instance) -> tuple[int, int]:
        """Height and width in texels; 1, 1 of what has none."""
        return 1, 1

    @classmethod
    def refused(cls, name: str) -> dict[str, str]:
        """What is no parameter because this texture stands in its place, and why."""
        return {name: f"{name} is a texture; its parameters have names of their own (`pathjax info` lists them)"}
