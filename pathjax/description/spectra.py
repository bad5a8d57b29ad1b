"""Conversion of spectra given by wavelengths to linear RGB.

Mitsuba's RGB mode converts a list of wavelengths and values to a colour when it reads the file, by sums over a grid of
wavelengths. This uses the same grid, so that images agree. The grid makes a white surface a thousandth too dark, and
may miss peaks narrower than half a nanometre.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

# CIE XYZ to linear sRGB, rounded as in Mitsuba.
_TO_RGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)
# A uniform spectrum of 1 has CIE XYZ (1, 1, 1): this colour in linear sRGB. Mitsuba's RGB mode emits it for a spectrum
# used as radiance; used as reflectance, the spectrum is lit by the white point and stays (1, 1, 1).
UNIFORM_RADIANCE = _TO_RGB.sum(axis=1)

_FIRST, _LAST, _STEPS = 360.0, 830.0, 1000
# Mitsuba divides the tables by these: the integral of y, and the mean of D65 weighted by y, a ten-thousandth too large.
_Y, _WHITE = 106.75026, 98.997418


def rgb(wavelengths: Float[np.ndarray, " N"], values: Float[np.ndarray, " N"], lit: bool) -> Float[np.ndarray, "3"]:
    """Return the colour of a spectrum that is linear between its wavelengths and 0 outside; channels may be negative.

    Args:
        wavelengths: nm, ascending.
        lit: the spectrum is a reflectance seen under D65; otherwise it is light itself.
    """
    grid, observer, white = _observer()
    spectrum = np.interp(grid, wavelengths, values, left=0, right=0)
    if lit:
        spectrum = spectrum * white
    return _TO_RGB @ (spectrum @ observer * (_LAST - _FIRST) / _STEPS)


@cache
def _observer() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the grid (nm) with the observer's x, y, z and D65 on it; a spectrum of 1, or D65, has Y = 1."""
    table = np.loadtxt(Path(__file__).parent / "cie.txt")
    grid = np.linspace(_FIRST, _LAST, _STEPS)
    x, y, z, white = (np.interp(grid, np.linspace(_FIRST, _LAST, len(table)), column) for column in table.T)
    return grid, np.stack([x, y, z], -1) / _Y, white / _WHITE
