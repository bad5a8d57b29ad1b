"""Fixtures shared by the tests of bsdfs: Mitsuba's values."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def mitsuba_values():
    """(kind, parameters, wi (N, 3), wo (N, 3)) -> values (N, 3) and densities (N,) of one of Mitsuba's bsdfs."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")

    def given(name, value):
        # Colours have the shape (3,) or a name with "reflectance"; other numbers stay as they are.
        if np.ndim(value):
            return {"type": "rgb", "value": list(map(float, value))}
        return {"type": "rgb", "value": float(value)} if "reflectance" in name else value

    def values(kind, parameters, wi, wo):
        made = mi.load_dict({"type": kind, **{name: given(name, value) for name, value in parameters.items()}})
        si, context, f, pdf = mi.SurfaceInteraction3f(), mi.BSDFContext(), [], []
        for one, other in zip(wi, wo, strict=True):
            si.wi = mi.Vector3f(*map(float, one))
            other = mi.Vector3f(*map(float, other))
            f.append(np.array(made.eval(context, si, other)))
            pdf.append(float(made.pdf(context, si, other)))
        return np.array(f), np.array(pdf)

    return values
