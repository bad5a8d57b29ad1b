"""Materials from images: `fit` and what it says."""

from pathjax.inverse.fitting import Fit, fit
from pathjax.inverse.target import Target, read_target

__all__ = ["Fit", "Target", "fit", "read_target"]
