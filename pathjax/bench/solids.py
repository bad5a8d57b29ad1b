"""Closed meshes of any number of triangles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def icosphere(level: int) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices and faces of an icosahedron whose faces are divided into four `level` times, on the unit sphere."""
    g = (1 + 5**0.5) / 2
    corners = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0)]
    vertices = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners]) / np.hypot(1, g)
    distance = np.linalg.norm(vertices[:, None] - vertices, axis=-1)
    near = np.isclose(distance, distance[distance > 0].min())  # its edges
    a, b, c = np.nonzero(near[:, :, None] & near[:, None, :] & near[None])
    faces = np.stack([a, b, c], 1)[(a < b) & (b < c)]
    p, q, r = np.moveaxis(vertices[faces], 1, 0)
    inwards = np.sum(np.cross(q - p, r - p) * p, 1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    for _ in range(level):
        vertices, faces = _divided(vertices, faces)
    return vertices, faces


def _divided(vertices, faces):
    """Every face as four, with the middles of edges on the sphere."""
    count = len(vertices)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    # One number for each edge: sorted as pairs, they would take most of the time.
    codes, first, place = np.unique(edges[:, 0] * count + edges[:, 1], return_index=True, return_inverse=True)
    middles = vertices[edges[first]].sum(1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = (place.reshape(-1, 3) + count).T
    a, b, c = faces.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([vertices, middles]), np.concatenate([np.stack(part, 1) for part in parts])


def bump(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], waves: float = 12
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """A unit sphere with lobes that hide each other, and `waves` ridges around it."""
    x, y, z = vertices.T
    lobes = 0.3 * np.sin(3 * x + 1) * np.sin(4 * y) * np.sin(3 * z + 0.5)
    ridges = np.sin(waves * x) * np.sin(waves * y + 1) * np.sin(waves * z + 2)
    return vertices * (1 + lobes + ridges / waves)[:, None], faces
