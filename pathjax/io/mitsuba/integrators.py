"""Integrators of scene files: all of them select a path tracer, whose limits they set.

The `read` of a kind converts an element to the `Description.integrator`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from pathjax import description as d
from pathjax.description.fields import Fields
from pathjax.kinds import Unused


class Path:
    default_depth = -1
    unused: ClassVar[Mapping[str, Unused]] = {
        "block_size": Unused("integer"),
        "samples_per_pass": Unused("integer"),
        "timeout": Unused("float", "`pathjax render --time` limits the seconds"),
    }

    @classmethod
    def read(cls, loader, fields: Fields) -> d.Integrator:
        max_depth = fields.integer("max_depth", cls.default_depth, at_least=-1)
        if max_depth == 0:
            max_depth = cls.zero(loader, fields)
        rr_depth = fields.integer("rr_depth", 5, at_least=1)
        return d.Integrator(max_depth, rr_depth, fields.boolean("hide_emitters", False))

    @staticmethod
    def zero(loader, fields: Fields) -> int:
        """Return the depth that a `max_depth` of 0 means."""
        loader.note(fields.where("max_depth"), "renders black, as in Mitsuba; -1 means no limit, 1 emission alone")
        return 0


class VolPath(Path):
    """Path tracer with participating media. Straight passes through a surface do not count as bounces."""

    @classmethod
    def read(cls, loader, fields):
        return replace(super().read(loader, fields), free_passes=True, media=True)


class VolPathMIS(VolPath):
    unused = Path.unused | {"use_spectral_mis": Unused("boolean")}


class PRB(Path):
    """Mitsuba's differentiable path tracer, with another default depth."""

    default_depth = 6
    same = "path, which is used"

    @classmethod
    def read(cls, loader, fields):
        loader.note(fields.element, f"is for derivatives; its image is that of {cls.same}")
        return super().read(loader, fields)

    @staticmethod
    def zero(loader, fields):
        loader.note(fields.where("max_depth"), "is 1 for this integrator of Mitsuba, too, which shows emission")
        return 1


class PRBBasic(PRB):
    """Mitsuba's `prb` without light samples."""

    same = "path, which is used, and which finds lights of no size, too"


# Parameters for the sampling of boundary derivatives, at the edges of shadows and shapes.
_PROJECTIVE = (
    dict.fromkeys(("sppc", "sppp", "sppi", "guiding_rounds"), Unused("integer"))
    | {"guiding": Unused("string", choices=("none", "grid", "octree")), "guiding_proj": Unused("boolean")}
    | {"project_seed": Unused("string", choices=("both", "bsdf", "emitter"))}
)


class PRBProjective(PRB):
    """Mitsuba's `prb` with boundary derivatives."""

    unused = PRB.unused | _PROJECTIVE


class PRBVolPath(PRB, VolPath):
    """Mitsuba's differentiable path tracer for participating media."""

    same = "volpath, which is used"


class PTracer(Path):
    """Mitsuba's tracer of paths from the lights: the same image, except for what mirrors and clear glass show."""

    @classmethod
    def read(cls, loader, fields):
        meets = "what mirrors and clear glass show to the camera is in it, which paths from lights do not find"
        loader.note(fields.element, f"traces from the lights; path is used, whose image is the same, but {meets}")
        return super().read(loader, fields)


class Direct:
    unused = Path.unused | dict.fromkeys(
        ("shading_samples", "emitter_samples", "bsdf_samples"),
        Unused("integer", "one sample of each is taken, so lights of no size and mirrors are seen; spp sets the noise"),
    )

    @classmethod
    def read(cls, loader, fields: Fields) -> d.Integrator:
        return d.Integrator(max_depth=2, hide_emitters=fields.boolean("hide_emitters", False))


class DirectProjective(Direct):
    """Mitsuba's `direct` for derivatives, with boundary derivatives."""

    unused = Path.unused | _PROJECTIVE | {"rr_depth": Unused("integer")}

    @classmethod
    def read(cls, loader, fields):
        fields.integer("max_depth", None, at_least=-1)
        loader.note(fields.element, "is for derivatives; its image is that of direct, which is used")
        return super().read(loader, fields)


class Wrapper:
    """An integrator that adds channels to the image of the integrator inside."""

    unused = Path.unused | {"hide_emitters": Unused("boolean", "that of the integrator inside counts")}
    left_out: ClassVar[str]

    @classmethod
    def read(cls, loader, fields: Fields) -> d.Integrator:
        nested = fields.objects("integrator")
        if not nested:
            return cls.alone(loader, fields)
        loader.note(fields.element, f"is left out, and the integrator inside is used; {cls.left_out}")
        return loader.make(nested[0], KINDS)

    @classmethod
    def alone(cls, loader, fields: Fields) -> d.Integrator:
        """Return the integrator to use if there is none inside."""
        raise fields.element.error(f"{fields.element} needs an <integrator> inside")


class AOV(Wrapper):
    unused = Wrapper.unused | {"aovs": Unused("string", "`pathjax render --aov` writes output variables")}
    left_out = "output variables are those of render_aovs"

    @classmethod
    def alone(cls, loader, fields):
        loader.note(fields.element, f"holds no integrator, so path is used; {cls.left_out}")
        return d.Integrator()


class Moment(Wrapper):
    left_out = "second moments are not written, `pathjax render --aov error` writes standard errors"


class Stokes(Wrapper):
    left_out = "light has no polarisation here, so Stokes vectors are not written"


# Kinds by their names in scene files.
KINDS = {
    "path": Path,
    "direct": Direct,
    "volpath": VolPath,
    "volpathmis": VolPathMIS,
    "prb": PRB,
    "prb_basic": PRBBasic,
    "prb_projective": PRBProjective,
    "direct_projective": DirectProjective,
    "prbvolpath": PRBVolPath,
    "ptracer": PTracer,
    "aov": AOV,
    "moment": Moment,
    "stokes": Stokes,
}
