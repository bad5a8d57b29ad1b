"""Load scenes from files and dictionaries, and save them."""

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
    """Load a scene from a dictionary in the form of Mitsuba's `load_dict`.

    A texture may be a NumPy or JAX array, a mesh {"type": "mesh", "vertices": (V, 3), "faces": (F, 3), ...} or a
    trimesh object, and a transform a `Transform`, a Mitsuba transform or a (4, 4) array. Keys at the top level are ids.

    Args:
        scene: of "type": "scene".
        sensor, dtype, split_rule: as in `load_scene`.
    Raises:
        InputError: the scene is invalid; the message has the cause, the remedy and the keys that lead there.
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
    """Load a scene from a Mitsuba 3 scene file, a glTF file or a bare mesh.

    Args:
        file: path of the file; its suffix is its format.
        sensor: which of several sensors to use: its index, from 0, or its id.
        dtype: dtype of all real arrays; float64 needs `jax_enable_x64`.
        split_rule: how hierarchies are split, for experiments: "sah" (least expected cost), "equal" (equal counts) or
            "middle" (in the middle of the centroids' bounds). Images are the same; only their cost differs.
        parameters: values that replace the defaults of the file's `$parameters`, by name.
        keywords: more of these, as in `res=128`. Use `parameters` for a `$parameter` named like an argument above.
    Raises:
        InputError: the scene is invalid; the message has the cause, the remedy and, for files, the file and line.
    Warns:
        InputWarning: images will be black, as nothing in the file emits light, or nothing reflects it.
    """
    parameters = dict(parameters or {})
    for name in parameters.keys() & keywords.keys():
        raise InputError(f"the parameter {name} is given twice, in parameters and as a keyword; give it once")
    return _lit(build(loader.load(file, sensor, **parameters, **keywords), dtype, split_rule), file)


def save_scene(scene: Scene, file: str | os.PathLike) -> list[Path]:
    """Write a loaded scene as a Mitsuba scene file, with the current values of its parameters.

    Loading that file gives the same scene. Textures and meshes that were given as arrays, and meshes in formats that
    Mitsuba does not read, are written beside it as `NAME_*.exr`, `.png` and `.ply`; other files are referenced where
    they are. Existing files are overwritten, except those that the scene was loaded from.

    Args:
        file: ends in `.xml`.
    Returns:
        All files that were written, the scene file last.
    Raises:
        InputError: a file cannot be written, the scene's values are traced, or a change cannot be stored in a file.
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
    """Return whether two pytrees have the same structure and arrays."""
    alike = jax.tree.structure(one) == jax.tree.structure(other)
    return alike and all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


def _lit(scene: Scene, file: str | os.PathLike) -> Scene:
    """Warn if images of the scene are black; return the scene."""
    if dark := emitters.darkness(scene.emitters, scene.samples_lights):
        warnings.warn(f"{file}: {dark}, so images of it are black", InputWarning, stacklevel=3)
    return scene
