"""From a scene file to a scene."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from pathjax import emitters
from pathjax.compile import is_traced
from pathjax.errors import InputError, InputWarning
from pathjax.io.mitsuba import loader, writer
from pathjax.scene.builder import build, seen
from pathjax.scene.parameters import parameters as parameters_of
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
        InputWarning: images will be black, as nothing in the scene emits light, or nothing reflects it.
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
    """Load a scene file of Mitsuba 3, or glTF or a bare mesh as a scene.

    Args:
        file: path of the file, whose suffix says what it is.
        sensor: which of several to use: its number, from 0, or its id.
        dtype: of all real numbers; float64 needs `jax_enable_x64`.
        split_rule: how hierarchies are split, for experiments: "sah" (least expected cost), "equal" (equal counts) or
            "middle" (in the middle of the centroids' bounds). Images are the same; only their cost differs.
        parameters: values that replace the defaults of the file's `$parameters`, by name.
        keywords: the same, as `res=128`. A `$parameter` named like an argument of this function is set by `parameters`.
    Raises:
        InputError: what is wrong and what to do; in a file, also the file and the line.
    Warns:
        InputWarning: images will be black, as nothing in the file emits light, or nothing reflects it.
    """
    parameters = dict(parameters or {})
    for name in parameters.keys() & keywords.keys():
        raise InputError(f"the parameter {name} is given twice, in parameters and as a keyword; give it once")
    return _lit(build(loader.load(file, sensor, **parameters, **keywords), dtype, split_rule), file)


def save_scene(scene: Scene, file: str | os.PathLike) -> list[Path]:
    """Write a scene that was loaded as a scene file of Mitsuba, with the present values of its parameters.

    Loaded again it is the same scene. Textures and meshes that were given as arrays, and meshes in formats that Mitsuba
    does not read, become files beside it, `NAME_*.exr`, `.png` and `.ply`; other files are named where they are. What
    exists is overwritten, but no file that the scene was loaded from.

    Args:
        file: ends in `.xml`.
    Returns:
        all files that were written, the scene file last.
    Raises:
        InputError: a file cannot be written, the scene's values are traced, or no scene file can say what has changed.
    """
    values = parameters_of(scene)
    if any(is_traced(value) for value in values.values()):
        raise InputError(f"{file}: the scene's parameters are traced; save it outside of jit and derivatives")
    known = scene.described.description
    if known.document is None:
        raise InputError(f"{file}: the scene was built from records; what load_scene and load_dict return can be saved")
    for name, value in seen(known, scene.camera.origin.dtype).items():
        if not _equal(value, getattr(scene, name)):
            raise InputError(
                f"{file}: the scene's {name} was replaced after it was loaded, which save_scene cannot write"
            )
    return writer.save(known, {name: np.asarray(value) for name, value in values.items()}, Path(file))


def _equal(one: object, other: object) -> bool:
    """Whether two pytrees have the same structure and arrays."""
    alike = jax.tree.structure(one) == jax.tree.structure(other)
    return alike and all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


def _lit(scene: Scene, file: str | os.PathLike) -> Scene:
    """Return the scene, after a warning if it is dark."""
    if dark := emitters.darkness(scene.emitters, scene.samples_lights):
        warnings.warn(f"{file}: {dark}, so images of it are black", InputWarning, stacklevel=3)
    return scene
