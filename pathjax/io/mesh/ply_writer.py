"""Write meshes as binary PLY, which Mitsuba reads and `ply.read` reads back unchanged."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathjax.shapes import Mesh
from pathjax.system.files import write_whole


def write(path: Path, mesh: Mesh) -> None:
    """Write a mesh with its normals, uv and attributes: as float32 if that holds all numbers exactly, else float64."""
    columns = [(("x", "y", "z"), mesh.vertices), (("nx", "ny", "nz"), mesh.normals), (("u", "v"), mesh.uv)]
    columns = [(names, array) for names, array in columns if array is not None]
    columns += [(_channels(name[7:]), a) for name, a in mesh.attributes.items() if name.startswith("vertex_")]
    of_faces = [(_channels(name[5:]), a) for name, a in mesh.attributes.items() if name.startswith("face_")]
    exact = all((array == array.astype(np.float32)).all() for _, array in columns + of_faces)
    number, word = ("<f4", "float") if exact else ("<f8", "double")

    faces = [("count", "u1"), ("vertices", "<i4", 3), *((each, number) for names, _ in of_faces for each in names)]
    rows = np.empty(len(mesh.faces), faces)
    rows["count"], rows["vertices"] = 3, mesh.faces
    for names, array in of_faces:
        for name, column in zip(names, array.T, strict=True):
            rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property {word} {each}" for names, _ in columns for each in names]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    header += [f"property {word} {each}" for names, _ in of_faces for each in names]
    data = np.concatenate([array for _, array in columns], 1).astype(number)
    parts = "\n".join([*header, "end_header", ""]).encode(), data, rows
    write_whole(path, lambda file: [file.write(part) for part in parts])


def _channels(name: str) -> tuple[str, ...]:
    """Return the properties that store an attribute: r, g, b for "color", and N_x, N_y, N_z for "N"."""
    stem, ends = (name.removesuffix("color"), "rgb") if name.endswith("color") else (f"{name}_", "xyz")
    return tuple(stem + end for end in ends)
