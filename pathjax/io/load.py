"""From a scene file to a scene."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping

import jax.numpy as jnp
from jax.typing import DTypeLike

from pathjax import emitters
from pathjax.errors import InputError, InputWarning
from pathjax.io.mitsuba import loader
from pathjax.scene.builder import build
from pathjax.scene.scene import Scene


def load_dict(
    scene: Mapping[str, object], *, sensor: int | str = 0, dtype: DTypeLike = jnp.float32, split_rule: str = "sah"
) -> Scene:
    """Load a scene that a dictionary describes as Mitsuba's `load_dict` has it.

    Arrays of NumPy or JAX stand for textures, {"type": "mesh", "vertices": (V, 3), "faces": (F, 3), ...} and objects of
    trimesh for meshes, and `Transform`, Mitsuba's transforms and (4, 4) arrays for transforms. Keys at the top are ids.

    Args:
        scene: of "type": "scene".
        sensor, dtype, split_rule: as in `load_scene`.
    Raises:
        InputError: what is wrong and what to do, with the keys that lead there.
    Warns:
        InputWarning: nothing in the scene emits light.
    """
    return _lit(build(loader.load_dict(scene, sensor), dtype, split_rule), "scene")


def load_scene(
    file: str | os.PathLike,
    *,
    sensor: int | str = 0,
    dtype: DTypeLike = jnp.float32,
    split_rule: str = "sah",
    parameters: Mapping[str, object] | None = None,
    **keywords: object,
) -> Scene:
    """Load a Mitsuba 3 XML scene.

    Args:
        file: path of the scene file.
        sensor: which of several to use: its number, from 0, or its id.
        dtype: of all real numbers; float64 needs `jax_enable_x64`.
        split_rule: how hierarchies are split, for experiments: "sah" (least expected cost), "equal" (equal counts) or
            "middle" (in the middle of the centroids' bounds). Images are the same; only their cost differs.
        parameters: values that replace the defaults of the file's `$parameters`, by name.
        keywords: the same, as `res=128`. A `$parameter` named like an argument of this function is set by `parameters`.
    Raises:
        InputError: what is wrong and what to do; in a file, also the file and the line.
    Warns:
        InputWarning: nothing in the file emits light.
    """
    parameters = dict(parameters or {})
    for name in parameters.keys() & keywords.keys():
        raise InputError(f"the parameter {name} is given twice, in parameters and as a keyword; give it once")
    return _lit(build(loader.load(file, sensor, **parameters, **keywords), dtype, split_rule), file)


def _lit(scene: Scene, file: str | os.PathLike) -> Scene:
    """The scene; a warning where it is dark."""
    if dark := emitters.darkness(scene.emitters):
        warnings.warn(f"{file}: {dark}, so images of it are black", InputWarning, stacklevel=3)
    return scene
