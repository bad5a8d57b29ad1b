"""pathjax: a differentiable Monte Carlo path tracer in pure JAX."""

from typing import TYPE_CHECKING

from pathjax.system import imports as _imports  # isort: skip  before all slow imports

import pathjax.compile  # noqa: F401  first: sets XLA up before a backend starts
from pathjax.batch import render_batch
from pathjax.derivatives.jacobian import Jacobian, jacobian
from pathjax.description.transform import Transform
from pathjax.errors import InputError, InputWarning
from pathjax.io.load import load_dict, load_scene, save_scene
from pathjax.rendering.aovs import render_aovs
from pathjax.rendering.bounces import Bounces, render_bounces
from pathjax.rendering.progressive.until import RenderResult, render_until
from pathjax.rendering.query import any_hit, closest_hit
from pathjax.rendering.render import render
from pathjax.scene.parameters import parameters, with_parameters
from pathjax.scene.scene import Scene
from pathjax.version import __version__

__all__ = [
    "Bounces",
    "Fit",
    "GradientCheck",
    "InputError",
    "InputWarning",
    "Jacobian",
    "NormalEquations",
    "RenderResult",
    "Scene",
    "Target",
    "Transform",
    "__version__",
    "any_hit",
    "check_gradient",
    "closest_hit",
    "fit",
    "jacobian",
    "load_dict",
    "load_scene",
    "normal_equations",
    "parameters",
    "read_target",
    "render",
    "render_aovs",
    "render_batch",
    "render_bounces",
    "render_until",
    "save_scene",
    "with_parameters",
]


if TYPE_CHECKING:
    from pathjax.inverse import Fit, NormalEquations, Target, fit, normal_equations, read_target
    from pathjax.rendering.check import GradientCheck, check_gradient
else:

    def __getattr__(name):
        # Modules that need optimistix or scipy.stats, half a second of imports, are loaded on first access.
        if name in ("Fit", "NormalEquations", "Target", "fit", "normal_equations", "read_target"):
            from pathjax import inverse

            return getattr(inverse, name)
        if name in ("GradientCheck", "check_gradient"):
            from pathjax.rendering import check

            return getattr(check, name)
        raise AttributeError(f"module 'pathjax' has no attribute {name!r}")


_imports.done()
