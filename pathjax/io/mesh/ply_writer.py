"""Meshes as binary PLY, which Mitsuba reads and `ply.read` gives back as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathjax.system.files import write_whole


def write(path: Path, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None, uv: np.ndarray | None):
    """Write vertices (V, 3), faces (F, 3), and where there are any normals (V, 3) and uv (V, 2), v as PLY has it.

    Numbers are stored as float32 where that holds all of them, else as float64.
    """
    given = [(names, array) for names, array in ((("nx", "ny", "nz"), normals), (("u", "v"), uv)) if array is not None]
    columns = [(("x", "y", "z"), vertices), *given]
    exact = all((array == array.astype(np.float32)).all() for _, array in columns)
    number, name = ("<f4", "float") if exact else ("<f8", "double")
    rows = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
    rows["count"], rows["vertices"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {name} {each}" for names, _ in columns for each in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    data = "\n".join(header).encode(), np.concatenate([array for _, array in columns], 1).astype(number), rows
    write_whole(path, lambda file: [file.write(part) for part in data])
