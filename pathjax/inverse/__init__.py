"""Materials from images: `fit` and what it says."""

from pathjax.inverse.fitting import Fit, fit

__all__ = ["Fit", "fit"]
