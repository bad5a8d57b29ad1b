"""glTF and bare meshes as scenes; a missing camera, light or film is added."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pathjax.description.transform import Transform
from pathjax.errors import InputError
from pathjax.io import gltf, mesh
from pathjax.shapes import Shape

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
WIDTH, ASPECT, SPP = 768, 4 / 3, 64
FOV = 35.0  # degrees, of the camera that frames the object
TOWARDS = np.array([0.45, 0.35, 1.0])  # direction from the object to that camera; y up, z front, as in glTF


def scene(path: Path, parameters: Mapping[str, object]) -> tuple[dict, list[str], list[Path]]:
    """Return a scene for `load_dict`, notes for the user, and the files that were read.

    Args:
        parameters: `res`, the width of the image in pixels.
    Raises:
        InputError: the file cannot be read or has no triangles, or a parameter is unknown.
    """
    if not path.is_file():
        raise InputError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    for name in parameters:
        if name != "res":
            raise InputError(f'{path}: the scene has no parameter "{name}"; it has: res')
    objects, notes, files = gltf.scene(path) if path.suffix.lower() in (".glb", ".gltf") else _mesh(path)
    shapes = [each for each in objects.values() if each["type"] == "mesh"]
    if not shapes:
        raise InputError(f"{path}: holds no triangles")
    cameras = {name: each for name, each in objects.items() if "aspect" in each}
    if not cameras:
        framed = _around(np.concatenate([each["vertices"] for each in shapes]), path)
        cameras = {gltf.unused("camera", objects): _framing(*framed) | {"aspect": ASPECT}}
        notes.append(f"{path}: has no camera; one that frames it is used")
    width = _whole(parameters.get("res", WIDTH), path)
    cameras = {name: _with_film(camera, width) for name, camera in cameras.items()}
    lit = any("emitter" in each or each["type"] in ("point", "spot", "directional") for each in objects.values())
    if not lit:
        objects[gltf.unused("sky", objects)] = {"type": "constant"}
        notes.append(f"{path}: has no light; a sky of radiance 1 is used")
    integrator = {"type": "volpath" if any("interior" in each for each in shapes) else "path"}
    return {"type": "scene", gltf.unused("integrator", objects): integrator, **objects, **cameras}, notes, files


def _mesh(path: Path) -> tuple[dict[str, dict], list[str], list[Path]]:
    """Return objects, notes and files of a bare mesh: one two-sided diffuse object, grey or in its vertex colours."""
    made, notes = mesh.load(path, path.suffix.lower()[1:], np.eye(4))
    arrays = {"vertices": made.vertices, "faces": made.faces, "normals": made.normals, "uv": made.uv}
    if made.empty:
        raise InputError(f"{path}: holds no triangle that has an area")
    color = made.attributes.get("vertex_color")
    bsdf: dict = {"type": "diffuse"}
    if color is not None and 0 <= color.min() <= color.max() <= 1:  # false where one is NaN
        arrays["vertex_color"] = color
        bsdf["reflectance"] = {"type": "mesh_attribute", "name": "vertex_color"}
    shape = {name: array for name, array in arrays.items() if array is not None}
    return {"mesh": {"type": "mesh", **shape, "bsdf": {"type": "twosided", "bsdf": bsdf}}}, notes, [path]


def framing(geometries: Sequence[Shape], file: str) -> dict:
    """Return a camera in front and somewhat above that sees the whole bounding sphere of `around`.

    Raises:
        InputError: the shapes have no extent, or one that is not finite.
    """
    return _framing(*around(geometries, file))


def around(geometries: Sequence[Shape], file: str) -> tuple[np.ndarray, float]:
    """Return the center (3,) and radius of the sphere around the bounding box of all shapes.

    Raises:
        InputError: the shapes have no extent, or one that is not finite.
    """
    corners = [corner for geometry in geometries for corner in geometry.primitives(flip=False).boxes()]
    return _around(np.concatenate([np.reshape(corner, (-1, 3)) for corner in corners]), file)


def _around(points: np.ndarray, file: object) -> tuple[np.ndarray, float]:
    low, high = points.min(axis=0), points.max(axis=0)
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    if not 0 < radius < math.inf:
        raise InputError(f"{file}: has no extent, or one that is not finite")
    return center, radius


def _framing(center: np.ndarray, radius: float) -> dict:
    distance = radius / math.sin(math.radians(FOV / 2))
    origin = center + TOWARDS * (distance / np.linalg.norm(TOWARDS))
    to_world = Transform().look_at(origin, center, [0, 1, 0])
    clip = {"near_clip": distance / 1000, "far_clip": distance * 1000}
    return {"type": "perspective", "to_world": to_world, "fov": FOV, "fov_axis": "smaller", **clip}


def _with_film(camera: dict, width: int) -> dict:
    """Return the camera with a film of its aspect ratio in place of `aspect`, and a sampler."""
    height = max(round(width / (camera["aspect"] or ASPECT)), 1)
    camera = {key: each for key, each in camera.items() if key != "aspect"}
    camera["film"] = {"type": "hdrfilm", "width": width, "height": height}
    return camera | {"sampler": {"type": "independent", "sample_count": SPP}}


def _whole(value: object, path: Path) -> int:
    try:
        number = int(str(value))
    except ValueError:
        number = 0
    if number < 1:
        raise InputError(f"{path}: res must be a whole number of pixels, is {str(value)[:40]!r}")
    return number
