"""Kinds of bsdfs, textures and others: a kind is a class that declares its parameters; its table has a row per object.

    class Phong(BSDF):
        reflectance = Color(0.5)
        exponent = Number(30.0, bounds=(0, math.inf))

        @staticmethod
        def evaluate(p, wi, wo): ...  # p.reflectance (3,), p.exponent (): of this row, at this point of the surface

The declaration determines the parameters and defaults of scene files, the table of all rows, where textures may replace
constants, and the named parameters that can be set, differentiated and fitted.
"""

from pathjax.kinds.declared import (
    Angle,
    Choice,
    Color,
    Declared,
    Direction,
    Flag,
    Internal,
    Number,
    PerRow,
    Position,
    Rotation,
    Setting,
    Shared,
    Transform2,
    Unused,
)
from pathjax.kinds.kind import Instance, Kind, Stored, ordered, register
from pathjax.kinds.parameter import Fixed, Mean, Parameter, Parameters
from pathjax.kinds.table import Column, Row, Table

__all__ = [
    "Angle",
    "Choice",
    "Color",
    "Column",
    "Declared",
    "Direction",
    "Flag",
    "Instance",
    "Internal",
    "Kind",
    "Mean",
    "Number",
    "Fixed",
    "Parameter",
    "Parameters",
    "PerRow",
    "Position",
    "Rotation",
    "Row",
    "Setting",
    "Shared",
    "Stored",
    "Table",
    "Transform2",
    "Unused",
    "ordered",
    "register",
]
