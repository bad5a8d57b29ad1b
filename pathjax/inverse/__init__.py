"""Materials from images: `fit` finds parameters with which a scene looks like its `Target`, and their uncertainty.

`fitting` holds `fit` and its result. The stages `scan`, `approach` and `refine` advance the `state` of a `problem`.
They evaluate the `normal` equations of a `parameter_vector`, and `losses` that follow from these; `weights` and
`uncertainty` say what pixels tell. Textures are fitted by `many` or `dense`, with the `products` J v and J^T v, or rows
of J, and a `prior`.
"""

from pathjax.inverse.fitting import Fit, fit
from pathjax.inverse.normal import NormalEquations, normal_equations
from pathjax.inverse.target import Target, read_target

__all__ = ["Fit", "NormalEquations", "Target", "fit", "normal_equations", "read_target"]
