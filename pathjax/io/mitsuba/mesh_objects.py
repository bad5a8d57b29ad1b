"""Convert mesh objects of trimesh or Mitsuba to dictionaries of arrays."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection

import numpy as np

from pathjax.errors import InputError


def is_mesh(value: object) -> bool:
    return hasattr(value, "vertices") and hasattr(value, "faces") or _is_mitsubas(value)


def arrays_of(mesh: object, place: str, array: Callable[[object], np.ndarray]) -> dict[str, object]:
    """Return the arrays of a mesh, as in a scene dictionary.

    Args:
        place: the keys that lead to the mesh.
        array: converts an array of a library to NumPy.
    Raises:
        InputError: it is not a mesh.
    """
    if not is_mesh(mesh):
        kind = type(mesh).__name__
        raise InputError(f'{place}: "mesh" must be a trimesh.Trimesh or a mitsuba.Mesh, is of type {kind}')
    return _of_mitsuba(mesh, array) if _is_mitsubas(mesh) else _of_trimesh(mesh)


def appearance_of(mesh: object, place: str, given: Collection[str]) -> dict[str, object]:
    """Return the bsdf and emitter of a Mitsuba mesh, except for those in `given`. Mitsuba exposes only parameters.

    Raises:
        InputError: one is not a diffuse bsdf or area emitter, or is textured; or the mesh has a medium.
    """
    if not _is_mitsubas(mesh):
        return {}
    known = dict(sys.modules["mitsuba"].traverse(mesh).items())
    found: dict[str, object] = {}
    for key, made, name, parameter in (
        ("bsdf", mesh.bsdf(), "diffuse", "reflectance"),
        ("emitter", mesh.emitter(), "area", "radiance"),
        ("medium", mesh.interior_medium() or mesh.exterior_medium(), "", ""),
    ):
        if made is None or key in given:
            continue
        value = f"{key}.{parameter}.value"
        if {path for path in known if path.startswith(f"{key}.") and "sampling_weight" not in path} != {value}:
            kind = made.class_name()
            remedy = 'give one beside the mesh: {"type": "mesh", "mesh": it, ...}'
            raise InputError(f"{place}: the {key} of a mesh of Mitsuba, {kind}, cannot be read back; {remedy}")
        color = np.ravel(np.asarray(known[value]))
        found[key] = {"type": name, parameter: {"type": "rgb", "value": color} if len(color) > 1 else float(color[0])}
    return found


def _is_mitsubas(value: object) -> bool:
    return hasattr(value, "vertex_positions_buffer") and hasattr(value, "faces_buffer")


def _of_trimesh(mesh) -> dict[str, object]:
    """Return its arrays, with texture coordinates, whose v points upwards in trimesh, and vertex colours."""
    arrays: dict[str, object] = {"vertices": np.asarray(mesh.vertices), "faces": np.asarray(mesh.faces)}
    visual = getattr(mesh, "visual", None)
    if getattr(visual, "kind", None) == "vertex":
        arrays["vertex_color"] = np.asarray(visual.vertex_colors)[:, :3] / 255
    if (uv := getattr(visual, "uv", None)) is not None:
        arrays["uv"] = np.asarray(uv) * [1, -1] + [0, 1]
    return arrays


def _of_mitsuba(mesh, array) -> dict[str, object]:
    """Return its arrays, in world space, with normals, texture coordinates and colours."""

    def rows(buffer, width):
        return array(buffer).reshape(-1, width)

    made: dict[str, object] = {"vertices": rows(mesh.vertex_positions_buffer(), 3)}
    made["faces"] = rows(mesh.faces_buffer(), 3)
    if mesh.has_vertex_normals():
        made["normals"] = rows(mesh.vertex_normals_buffer(), 3)
    if mesh.has_vertex_texcoords():
        made["uv"] = rows(mesh.vertex_texcoords_buffer(), 2)
    for name in ("vertex_color", "face_color"):
        if mesh.has_attribute(name):
            made[name] = rows(mesh.attribute_buffer(name), 3)
    for name, has in {"face_normals": mesh.has_face_normals, "flip_normals": mesh.has_flipped_normals}.items():
        if has():
            made[name] = True
    return made
