"""Materials from images: `fit` finds parameters with which a scene looks like its `Target`, and how well it knows them.

`fitting` holds `fit` and its answer. A `problem` is moved on in its `state` by the stages `scan`, `approach` and
`refine`. They evaluate the `normal` equations of a `parameter_vector`, and `losses` that follow from these; `weights`
and `uncertainty` say what pixels tell. Textures go another way, `many`, by the `products` J v and J^T v and a `prior`.
"""

from pathjax.inverse.fitting import Fit, fit
from pathjax.inverse.normal import NormalEquations, normal_equations
from pathjax.inverse.target import Target, read_target

__all__ = ["Fit", "NormalEquations", "Target", "fit", "normal_equations", "read_target"]
