"""Spectra given by wavelengths, as the linear RGB that they stand for.

Mitsuba's RGB mode turns a list of wavelengths and values into a colour as its file is read, by sums over a grid of
wavelengths. The same grid is used here, so that images agree. It makes a white surface a thousandth too dark, and may
find nothing of what is narrower than half a nanometre.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

# Linear sRGB of CIE XYZ, as Mitsuba rounds it.
_TO_RGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)
# A uniform spectrum of 1 has CIE XYZ (1, 1, 1): this colour in linear sRGB. Mitsuba's RGB mode emits it for a spectrum
# used as radiance; used as reflectance, the spectrum is lit by the white point and stays (1, 1, 1).
UNIFORM_RADIANCE = _TO_RGB.sum(axis=1)

_FIRST, _LAST, _STEPS = 360.0, 830.0, 1000
# By which Mitsuba divides the tables: the integral of y, and the mean of D65 weighted by y, a ten-thousandth too large.
_Y, _WHITE = 106.75026, 98.997418


def rgb(wavelengths: Float[np.ndarray, " N"], values: Float[np.ndarray, " N"], lit: bool) -> Float[np.ndarray, "3"]:
    """Colour of a spectrum, which is linear between its wavelengths and 0 outside of them. May have negative channels.

    Args:
        wavelengths: nm, ascending.
        lit: seen under D65, as what reflects light is; else it is light itself.
    """
    grid, observer, white = _observer()
    spectrum = np.interp(grid, wavelengths, values, left=0, right=0)
    if lit:
        spectrum = spectrum * white
    return _TO_RGB @ (spectrum @ observer * (_LAST - _FIRST) / _STEPS)


@cache
def _observer() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The grid (nm), and there the observer's x, y, z, and D65; both such that a spectrum of 1, or D65, has Y = 1."""
    table = np.loadtxt(Path(__file__).parent / "cie.txt")
    grid = np.linspace(_FIRST, _LAST, _STEPS)
    x, y, z, white = (np.interp(grid, np.linspace(_FIRST, _LAST, len(table)), column) for column in table.T)
    return grid, np.stack([x, y, z], -1) / _Y, white / _WHITE
