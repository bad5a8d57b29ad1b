"""Materials from images: `fit` finds parameters with which a scene looks like its `Target`, and how well it knows them.

`fitting` holds `fit` and its answer. A `problem` is moved on in its `state` by the stages `scan`, `approach` and
`refine`, which evaluate `losses` of a `parameter_vector`; `weights` and `uncertainty` say what pixels tell.
"""

from pathjax.inverse.fitting import Fit, fit
from pathjax.inverse.target import Target, read_target

__all__ = ["Fit", "Target", "fit", "read_target"]
