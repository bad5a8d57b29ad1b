"""Base of bsdfs with one rough surface: its roughness, and how its lobe is sampled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from pathjax.bsdfs.bsdf import BSDF
from pathjax.bsdfs.microfacet import DISTRIBUTIONS, MIN_ALPHA, Distribution
from pathjax.kinds import Choice, Number, Row, Unused


@dataclass(frozen=True)
class Roughness(Number):
    """A roughness in [0, 1]; values below MIN_ALPHA count as MIN_ALPHA."""

    bounds: tuple[float, float] = (0, 1)
    least: float = MIN_ALPHA


class Rough(BSDF):
    """A surface of facets, with the isotropic roughness `alpha`, or else with `alpha_u` and `alpha_v`.

    Values below `microfacet.MIN_ALPHA` count as MIN_ALPHA, as in Mitsuba.
    """

    alpha = Roughness(0.1, textured=True)  # None: alpha_u and alpha_v instead
    alpha_u = Roughness(None, textured=True)
    alpha_v = Roughness(None, textured=True)
    distribution = Choice("beckmann", options=tuple(DISTRIBUTIONS))
    smooth = True
    unused: ClassVar[Mapping[str, Unused]] = {"sample_visible": Unused("boolean", "visible normals are always drawn")}

    @classmethod
    def read(cls, loader, fields, name):
        given = [key for key in ("alpha_u", "alpha_v") if fields.has(key)]
        if given and fields.has("alpha"):
            raise fields.error("alpha", f"cannot stand beside {given[0]}; give either alpha, or alpha_u and alpha_v")
        if len(given) == 1:
            missing = "alpha_v" if given[0] == "alpha_u" else "alpha_u"
            raise fields.error(given[0], f"needs {missing} beside it; a surface as rough both ways has alpha")
        return super().read(loader, fields, name)

    @classmethod
    def instance(cls, name="", **values):
        if values.get("alpha_u") is not None:
            values["alpha"] = None
        return super().instance(name, **values)

    @classmethod
    def variant(cls, instance):
        return *super().variant(instance), instance.values["alpha"] is None

    @classmethod
    def capable(cls, table, capability):
        if capability == "anisotropic":
            return table.column("alpha") is None
        return super().capable(table, capability)

    @staticmethod
    def facets(p: Row) -> Distribution:
        """Return the facets of one row at the point."""
        made = DISTRIBUTIONS[p.distribution].of
        if (alpha := p.alpha) is not None:
            return made(alpha, alpha)
        return made(p.alpha_u, p.alpha_v)
