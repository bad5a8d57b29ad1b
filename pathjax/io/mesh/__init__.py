"""Triangle meshes from OBJ, PLY, STL, glTF and Mitsuba's serialized files, validated and in world space.

A module for each format parses its files into a `Raw`; `load` checks that, triangulates polygons and transforms the
mesh to world space.

In the uv of a `Mesh`, v points downwards: (u, v) looks up `texels[int(v * H), int(u * W)]`, the image's top row first.
glTF files store uv like that. In OBJ files v starts at the bottom of the image, so it is flipped (`flip_tex_coords`
true by default); in PLY and serialized files it is not flipped, as in Mitsuba.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pathjax.errors import InputError
from pathjax.io.mesh import gltf, obj, ply, polygons, serialized, stl
from pathjax.io.mesh.raw import Raw
from pathjax.shapes import Mesh
from pathjax.system.cores import over_cores

READERS = {
    "obj": obj.read,
    "ply": ply.read,
    "stl": stl.read,
    "glb": gltf.read,
    "gltf": gltf.read,
    "serialized": serialized.read,
}
# Faces per block of a computation: few enough that their values stay in the cache.
BLOCK = 1 << 15
# Formats whose meshes get smooth shading normals if the file has none.
SMOOTH = ("obj", "ply", "serialized")


def load(
    path: str | Path,
    kind: str,
    to_world: np.ndarray,
    face_normals: bool = False,
    flip_tex_coords: bool | None = None,
    part: int | None = None,
) -> tuple[Mesh, list[str]]:
    """Read a mesh, transform it to world space, and leave out degenerate triangles.

    Shading normals are the file's. Where OBJ, PLY and serialized files have none, vertices get the angle-weighted mean
    of the normals of the adjacent faces, as in Mitsuba; where these cancel, the faces are flat. STL and glTF meshes
    without normals are flat. A mirroring `to_world` turns faces inside out, as in Mitsuba; but if the file has normals,
    the vertex order is reversed to agree with them.

    Args:
        kind: "obj", "ply", "stl", "glb", "gltf" or "serialized".
        to_world: (4, 4), affine and invertible.
        face_normals: flat shading, even if the file has normals.
        flip_tex_coords: replace v by 1 - v; None: only for OBJ.
        part: index of the mesh in a serialized file.
    Returns:
        The mesh, without faces if all its triangles are degenerate, and notes for the user.
    Raises:
        InputError: unreadable file, no triangles, an index out of range, a coordinate that is not finite in float32.
    """
    raw = _read(Path(path), kind, () if part is None else (part,))
    flip = kind == "obj" if flip_tex_coords is None else flip_tex_coords
    return _in_world(path, raw, to_world, face_normals, kind in SMOOTH, flip)


def of_arrays(
    place: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    to_world: np.ndarray,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    face_normals: bool = False,
    **attributes: np.ndarray | None,
) -> tuple[Mesh, list[str]]:
    """Do what `load` does for arrays: vertices (V, 3), faces (F, 3) integers, normals (V, 3) and uv (V, 2).

    Without normals the mesh is flat. place: for messages. attributes: "vertex_*" (V, 3) and "face_*" (F, 3).
    """
    attributes = {name: array for name, array in attributes.items() if array is not None}
    shapes = {"vertices": (vertices, 3), "faces": (faces, 3), "normals": (normals, 3), "uv": (uv, 2)}
    shapes |= {name: (array, 3) for name, array in attributes.items()}
    for name, (array, width) in shapes.items():
        rows = "F" if name.startswith("face") else "V"
        if array is None:
            continue
        if array.ndim != 2 or array.shape[1] != width or len(array) != len(faces if rows == "F" else vertices):
            raise InputError(f"{place}: {name} must have the shape ({rows}, {width}), has {array.shape}")
        if array.dtype.kind not in ("iu" if name == "faces" else "iuf"):
            raise InputError(f"{place}: {name} must be {'integers' if name == 'faces' else 'numbers'}")
    normals, uv = (None if array is None else array.astype(np.float64) for array in (normals, uv))
    attributes = {name: array.astype(np.float64) for name, array in attributes.items()}
    corners = faces.astype(np.int64).ravel()
    raw = Raw(vertices.astype(np.float64), corners, normals=normals, uv=uv, attributes=attributes)
    _check(place, raw)
    return _in_world(place, raw, to_world, face_normals, smooth=False, flip=False)


def _in_world(
    path: str | Path, raw: Raw, to_world: np.ndarray, face_normals: bool, smooth: bool, flip: bool
) -> tuple[Mesh, list[str]]:
    """Return what `load` returns. smooth: a mesh without normals gets smooth ones; flip: replace v by 1 - v."""
    vertices = _transformed(path, raw.vertices, to_world)
    notes = list(raw.notes)
    attributes = dict(raw.attributes)
    if raw.sizes is None:
        faces = raw.corners.reshape(-1, 3)
    else:
        attributes = _by_kind(attributes, "face_", lambda of_faces: np.repeat(of_faces, raw.sizes - 2, axis=0))
        faces, crossing = polygons.triangles(raw.vertices, raw.corners, raw.sizes)
        if crossing:
            notes.append(f"{crossing} polygons cross themselves; no triangles cover such just once")
    area_vectors = _area_vectors(vertices, faces)
    # Also false for repeated indices. In both spaces, as rounding in the transform may give collinear vertices an area.
    solid = area_vectors.any(axis=0)
    if not np.array_equal(vertices, raw.vertices):
        solid &= _area_vectors(raw.vertices, faces).any(axis=0)
    dropped = int(len(solid) - np.count_nonzero(solid))
    if dropped:
        faces, area_vectors = faces[solid], area_vectors[:, solid]
        attributes = _by_kind(attributes, "face_", lambda of_faces: of_faces[solid])
        notes.append(f"{dropped} degenerate triangles left out")

    normals, uv = None, raw.uv
    if not face_normals and (raw.normals is not None or smooth):
        if raw.normals is None:
            given, lacking = np.empty_like(vertices), np.ones(len(vertices), bool)
        else:
            with np.errstate(over="ignore"):
                given = raw.normals @ np.linalg.inv(to_world[:3, :3])
                lengths = np.linalg.norm(given, axis=1)
            lacking = (lengths == 0) | ~np.isfinite(lengths)
            if np.linalg.det(to_world[:3, :3]) < 0:
                faces, area_vectors = faces[:, ::-1], -area_vectors
            if lacking[faces].any():
                notes.append(f"{np.unique(faces[lacking[faces]]).size} vertices without a normal got a smooth one")
        flat = np.zeros_like(faces, bool)  # corners that become separate vertices with the normal of their face
        if lacking.any():
            means, cancel = _smooth_normals(vertices, faces, area_vectors)
            given[lacking] = means[lacking]
            flat = (lacking & cancel)[faces]
        normals = given / np.linalg.norm(given, axis=1, keepdims=True)
        if flat.any():
            at = faces[flat]
            faces = faces.copy()
            faces[flat] = len(vertices) + np.arange(len(at))
            own = (area_vectors / _norm(area_vectors)).T[np.nonzero(flat)[0]]
            vertices, normals = np.concatenate([vertices, vertices[at]]), np.concatenate([normals, own])
            uv = None if uv is None else np.concatenate([uv, uv[at]])
            attributes = _by_kind(attributes, "vertex_", lambda values: np.concatenate([values, values[at]]))
            notes.append(f"{np.unique(at).size} vertices are flat, as the normals of the faces around them cancel")

    if uv is not None and flip:
        uv = uv * [1, -1] + [0, 1]
    made = Mesh(vertices, np.ascontiguousarray(faces), normals, uv, dropped, attributes)
    return made, [f"{path}: {note}" for note in notes]


def _by_kind(attributes: dict[str, np.ndarray], kind: str, change: Callable) -> dict[str, np.ndarray]:
    """Return the attributes, after applying `change` to those whose names begin with `kind`."""
    return {name: change(values) if name.startswith(kind) else values for name, values in attributes.items()}


def _read(path: Path, kind: str, part: tuple[int, ...]) -> Raw:
    """Parse the file, and check its indices, normals and uv."""
    try:
        raw = READERS[kind](path, *part)
    except InputError:
        raise
    except Exception as error:  # any, from the libraries or due to a malformed header
        reason = f"{type(error).__name__}: {error}"[:200]
        raise InputError(f"{path}: cannot be read as {kind.upper()} ({reason})") from None
    _check(path, raw)
    return raw


def _check(path: str | Path, raw: Raw) -> None:
    if len(raw.vertices) == 0 or len(raw.corners) == 0:
        raise InputError(f"{path}: the mesh is empty, it has no triangles")
    if raw.corners.min() < 0 or raw.corners.max() >= len(raw.vertices):
        bad = int(np.flatnonzero((raw.corners < 0) | (raw.corners >= len(raw.vertices)))[0])
        face = bad // 3 if raw.sizes is None else int(np.searchsorted(np.cumsum(raw.sizes), bad, side="right"))
        there = f"there are {len(raw.vertices)}"
        raise InputError(f"{path}: face {face} (counting from 0) has the vertex {raw.corners[bad]}, but {there}")
    for name, values in (("normal", raw.normals), ("uv", raw.uv)):
        if values is not None and not np.isfinite(values).all():
            raise InputError(f"{path}: {name} {_first_bad(values)} is not finite")


def _transformed(path: str | Path, vertices: np.ndarray, to_world: np.ndarray) -> np.ndarray:
    """Return (V, 3) float64 vertices in world space, checked to be finite after rounding to float32, as done later."""
    with np.errstate(over="ignore", invalid="ignore"):
        # Adding 0 turns -0 into 0, as the product and sum do.
        still = np.array_equal(to_world, np.eye(4))
        world = vertices + 0.0 if still else _product(vertices, to_world[:3, :3].T) + to_world[:3, 3]
        finite = np.isfinite(world.astype(np.float32)).all() and np.isfinite(vertices).all()
        if not finite:
            bad = _first_bad(world.astype(np.float32) + vertices)
            raise InputError(f"{path}: vertex {bad} (counting from 0) is not finite: {vertices[bad].tolist()}")
    return world


def _product(vertices: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return vertices @ matrix, in blocks: for many rows BLAS starts threads, which takes longer than the product."""
    product = np.empty_like(vertices)
    for begin in range(0, len(vertices), BLOCK):
        np.matmul(vertices[begin : begin + BLOCK], matrix, out=product[begin : begin + BLOCK])
    return product


def _first_bad(values: np.ndarray) -> int:
    return int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (3, F) normals of length twice the area; 0 for triangles without area after rounding to float32."""
    with np.errstate(over="ignore"):
        rounded = vertices.T.astype(np.float32).astype(np.float64, order="C")

    def of_block(block: slice) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            a, b, c = (np.take(rounded, corner, axis=1) for corner in faces[block].T)
            return polygons.cross(b - a, c - a)

    return _in_blocks(of_block, (3, len(faces)))


def _in_blocks(of_block: Callable[[slice], np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of this shape, computed in parallel by calling `of_block` on blocks of the last axis."""
    joined = np.empty(shape)

    def fill(begin: int) -> None:
        block = slice(begin, begin + BLOCK)
        joined[..., block] = of_block(block)

    with over_cores(shape[-1]) as run:
        list(run(fill, range(0, shape[-1], BLOCK)))
    return joined


def _smooth_normals(vertices: np.ndarray, faces: np.ndarray, area_vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of unit face normals weighted by the angle at the vertex (Thuermer and Wuethrich 1998).

    Returns:
        (V, 3) sums, and a (V,) mask where they cancel, as for a sheet with a face for each side, or have no terms.
    """
    columns = np.ascontiguousarray(vertices.T)

    def angles_of(block: slice) -> np.ndarray:
        corners = [np.take(columns, corner, axis=1) for corner in faces[block].T]
        cosines = []
        for k in range(3):
            one, two = corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]
            cosines.append(_dot(one, two) / (_norm(one) * _norm(two)))
        return np.arccos(np.clip(cosines, -1, 1))

    def total(weights: np.ndarray) -> np.ndarray:
        """Return (V,) sums of weights (F,) times the angles."""
        each = zip(faces.T, angles, strict=True)
        return sum(np.bincount(at, angle * weights, len(vertices)) for at, angle in each)

    angles = _in_blocks(angles_of, (3, len(faces)))
    unit = _in_blocks(lambda block: area_vectors[:, block] / _norm(area_vectors[:, block]), area_vectors.shape)
    with over_cores(len(faces)) as run:
        *sums, angles_around = run(total, [*unit, np.ones(len(faces))])
    sums = np.stack(sums, axis=1)
    cancel = _norm(sums.T) <= np.finfo(np.float32).eps * angles_around
    sums[cancel] = [1, 0, 0]
    return sums, cancel


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of columns, (3, N) each."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _norm(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))
