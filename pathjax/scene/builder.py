"""Build a scene from a description: each room builds its own tables."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import bsdfs, emitters, media, shapes
from pathjax import description as desc
from pathjax.compile import standard_promotion
from pathjax.errors import InputError
from pathjax.kinds import Parameters
from pathjax.scene.metadata import About
from pathjax.scene.scene import UNBOUNDED, Scene
from pathjax.shapes.accel.build import RULES


@standard_promotion
def build(description: desc.Description, dtype=jnp.float32, split_rule: str = "sah") -> Scene:
    """Compile a description into tables grouped by kind.

    Args:
        dtype: dtype of all reals; float64 needs `jax_enable_x64`.
        split_rule: split rule of the hierarchies, for experiments: "sah" (least expected cost), "equal" (equal counts)
            or "middle" (of the centroids' bounds). Hits and images are the same; only their cost differs.
    Raises:
        InputError: float64 without `jax_enable_x64`; an unknown split_rule.
    """
    if split_rule not in RULES:
        raise InputError(f"split_rule {split_rule!r} is unknown; use one of {', '.join(RULES)}")
    if jax.dtypes.canonicalize_dtype(dtype) != np.dtype(dtype):
        raise InputError('dtype = float64, which is off in JAX; call jax.config.update("jax_enable_x64", True) first')
    parameters = Parameters()
    free_passes = description.integrator.free_passes
    given = [shape.bsdf for shape in description.shapes]
    materials = bsdfs.build(given, dtype, ("materials",), parameters, free_passes)
    asked = {"tangents": bsdfs.occurs(materials, "anisotropic"), "along": bsdfs.occurs(materials, "along_uv")}
    geometry, lamps, trees = shapes.build(description.shapes, dtype, split_rule, ("geometry",), parameters, **asked)
    given = [*(shape.emitter for shape in description.shapes), *description.emitters]
    lights, geometry = emitters.build(given, lamps, geometry, dtype, ("emitters",), parameters)
    within = None
    if description.integrator.media:
        sides = [(shape.interior, shape.exterior) for shape in description.shapes]
        within = media.build(sides, description.view.medium, dtype, ("media",), parameters)
    about = About(description, parameters.known, parameters.refused, trees)
    view = seen(description, dtype)
    # All arrays are NumPy's up to here: `jnp.asarray` compiles a program for every new shape.
    free_passes = free_passes and bsdfs.occurs(materials, "passes")
    parts = {"geometry": geometry, "materials": materials, "emitters": lights, "about": about, "media": within}
    return jax.device_put(Scene(**parts, **view, free_passes=free_passes))


def seen(description: desc.Description, dtype) -> dict[str, object]:
    """Return the fields of a scene that come from the sensor and the integrator."""
    integrator = description.integrator
    return {
        "camera": description.view.camera.build(description.view.film, dtype),
        "film": description.view.film.build(dtype),
        "max_depth": np.int32(UNBOUNDED if integrator.max_depth < 0 else integrator.max_depth),
        "rr_depth": np.int32(integrator.rr_depth),
        "hide_emitters": integrator.hide_emitters,
    }
