"""Write knot.ply, the mesh of `mesh.xml`: a trefoil knot whose tube carries spiral ridges and bumps.

    python make_knot.py

NumPy alone. 10,400 vertices with smooth normals, 20,800 triangles, closed, counter-clockwise seen from outside.
"""

from pathlib import Path

import numpy as np

ALONG, AROUND = 400, 26  # vertices along the knot and around its tube
RADIUS = 0.42


def curve(t):
    """The trefoil, t in [0, 2 pi)."""
    return np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.3 * np.sin(3 * t)], -1)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def surface(t, phi):
    """Points of the bumpy tube, any broadcast shape of t and phi."""
    step = 1e-3
    tangent = unit(curve(t + step) - curve(t - step))
    outward = unit(curve(t) - tangent * np.sum(curve(t) * tangent, -1, keepdims=True))  # never along the tangent here
    side = np.cross(tangent, outward)
    ridges = 0.22 * np.sin(3 * phi + 18 * t)
    bumps = 0.08 * np.sin(36 * t) * np.cos(2 * phi)
    radius = (RADIUS * (1 + ridges + bumps))[..., None]
    return curve(t) + radius * (np.cos(phi)[..., None] * outward + np.sin(phi)[..., None] * side)


def main():
    t, phi = np.meshgrid(*(np.arange(n) * 2 * np.pi / n for n in (ALONG, AROUND)), indexing="ij")
    step = 1e-4
    across, along = surface(t, phi + step) - surface(t, phi - step), surface(t + step, phi) - surface(t - step, phi)
    normals = unit(np.cross(across, along))
    i, j = np.meshgrid(np.arange(ALONG), np.arange(AROUND), indexing="ij")
    corner = [((i + a) % ALONG) * AROUND + (j + b) % AROUND for a, b in ((0, 0), (0, 1), (1, 1), (1, 0))]
    faces = np.stack([np.stack([corner[k] for k in tri], -1) for tri in ((0, 1, 2), (0, 2, 3))], -2).reshape(-1, 3)

    table = np.concatenate([surface(t, phi), normals], -1).reshape(-1, 6).astype("<f4")
    rows = np.zeros(len(faces), [("count", "u1"), ("vertex", "<i4", 3)])
    rows["count"], rows["vertex"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    Path(__file__).with_name("knot.ply").write_bytes("\n".join(header).encode() + table.tobytes() + rows.tobytes())


if __name__ == "__main__":
    main()
