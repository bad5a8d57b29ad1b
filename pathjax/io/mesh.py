"""Triangle meshes from OBJ, PLY, STL and glTF files, in world space and fit to be traced.

uv of a `Mesh` points v downwards: (u, v) looks up `texels[int(v * H), int(u * W)]`, the top row of the image first.
glTF files store it like that. OBJ files count v from the bottom of the image, so it is flipped (`flip_tex_coords`
true by default); of PLY, Mitsuba assumes that nothing is to be flipped, and so does this loader.

OBJ is read here: trimesh 5.2 takes negative indices from the end of the file rather than from the current line, reads
index 0 as 1, and leaves out without a word the normals and uv of a file in which one index is wrong.
"""

from __future__ import annotations

import json
import signal
import struct
import threading
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from pathjax.description import Mesh
from pathjax.errors import InputError


@dataclass(frozen=True)
class _Raw:
    """What a file says, in its own space."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    normals: np.ndarray | None = None  # (V, 3); a row of zeros: this vertex has none
    uv: np.ndarray | None = None  # (V, 2), v as the file has it


@contextmanager
def _interrupts_wait():
    """Hold Ctrl-C back: trimesh catches every exception around its optional imports, and so would lose it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = []
    before = signal.signal(signal.SIGINT, lambda *call: heard.append(call))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if heard and callable(before):
        before(*heard[0])


def load(
    path: str | Path,
    kind: str,
    to_world: np.ndarray,
    face_normals: bool = False,
    flip_tex_coords: bool | None = None,
) -> tuple[Mesh, list[str]]:
    """Read a mesh, carry it to world space, and leave out degenerate triangles.

    Shading normals are the file's; where OBJ and PLY have none they are means of the faces around, weighted by angle,
    as Mitsuba makes them. STL and glTF without normals are flat. A mirroring `to_world` turns faces inside out, as in
    Mitsuba; where the file has normals those decide, and the order of vertices is reversed to agree with them.

    Args:
        kind: "obj", "ply", "stl", "glb" or "gltf".
        to_world: (4, 4), affine and invertible.
        face_normals: flat shading whatever the file has.
        flip_tex_coords: v to 1 - v; None: what the format needs.
    Returns:
        the mesh, and notes worth telling the user.
    Raises:
        InputError: unreadable file, no triangles, an index out of range, a coordinate that is not finite in float32.
    """
    raw = _read(Path(path), kind)
    vertices = _transformed(path, raw.vertices, to_world)
    faces, normals, uv = raw.faces, None, raw.uv
    area_vectors = _area_vectors(vertices, faces)
    # Also false where an index is repeated. Both spaces: a transform rounds a line of three vertices to a sliver.
    solid = _area_vectors(raw.vertices, faces).any(axis=1) & area_vectors.any(axis=1)
    if not solid.any():
        raise InputError(f"{path}: no triangles with an area above 0")
    faces, area_vectors = faces[solid], area_vectors[solid]
    dropped = int(len(solid) - len(faces))
    notes = [f"{path}: {dropped} degenerate triangles left out"] if dropped else []
    if kind in ("glb", "gltf"):
        notes.append(f"{path}: its materials, cameras and lights are not read")

    if not face_normals and (raw.normals is not None or kind in ("obj", "ply")):
        given = np.zeros_like(vertices) if raw.normals is None else raw.normals @ np.linalg.inv(to_world[:3, :3])
        if raw.normals is not None and np.linalg.det(to_world[:3, :3]) < 0:
            faces, area_vectors = faces[:, ::-1], -area_vectors
        lacking = ~given.any(axis=1)
        given[lacking] = _smooth_normals(vertices, faces, area_vectors)[lacking]
        normals = given / np.linalg.norm(given, axis=1, keepdims=True)
        if raw.normals is not None and lacking[faces].any():
            notes.append(f"{path}: {np.unique(faces[lacking[faces]]).size} vertices without a normal got a smooth one")

    if uv is not None and (kind == "obj" if flip_tex_coords is None else flip_tex_coords):
        uv = uv * [1, -1] + [0, 1]
    return Mesh(vertices, np.ascontiguousarray(faces), normals, uv, dropped), notes


def _read(path: Path, kind: str) -> _Raw:
    try:
        with warnings.catch_warnings():  # NumPy warns of text that is no number; what comes of it is checked below
            warnings.simplefilter("ignore")
            raw = READERS[kind](path)
    except InputError:
        raise
    except Exception as error:  # the libraries raise whatever the file's bytes bring about
        reason = f"{type(error).__name__}: {error}"[:200]
        raise InputError(f"{path}: cannot be read as {kind.upper()} ({reason})") from None
    if raw is None or len(raw.vertices) == 0 or len(raw.faces) == 0:
        raise InputError(f"{path}: the mesh is empty, it has no triangles")
    if raw.faces.min() < 0 or raw.faces.max() >= len(raw.vertices):
        bad = int(np.flatnonzero(((raw.faces < 0) | (raw.faces >= len(raw.vertices))).any(axis=1))[0])
        raise InputError(
            f"{path}: triangle {bad} has the vertices {raw.faces[bad].tolist()}, but there are {len(raw.vertices)}"
        )
    for name, values in (("normal", raw.normals), ("uv", raw.uv)):
        if values is not None and (len(values) != len(raw.vertices) or not np.isfinite(values).all()):
            bad = "is not one per vertex" if len(values) != len(raw.vertices) else f"{_first_bad(values)} is not finite"
            raise InputError(f"{path}: {name} {bad}")
    return raw


def _transformed(path: str | Path, vertices: np.ndarray, to_world: np.ndarray) -> np.ndarray:
    """(V, 3) float64; finite also when rounded to float32, as everything downstream does."""
    with np.errstate(over="ignore", invalid="ignore"):
        world = vertices @ to_world[:3, :3].T + to_world[:3, 3]
        finite = np.isfinite(world.astype(np.float32)) & np.isfinite(vertices)
    if not finite.all():
        bad = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise InputError(f"{path}: vertex {bad} (counting from 0) is not finite: {vertices[bad].tolist()}")
    return world


def _first_bad(values: np.ndarray) -> int:
    return int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) twice the area along the normal; 0 for what has no area once rounded to float32."""
    with np.errstate(over="ignore", invalid="ignore"):
        a, b, c = (vertices.astype(np.float32).astype(np.float64)[faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)


def _smooth_normals(vertices: np.ndarray, faces: np.ndarray, area_vectors: np.ndarray) -> np.ndarray:
    """(V, 3) sums of unit face normals weighted by the angle at the vertex (Thuermer and Wuethrich 1998)."""
    unit = area_vectors / np.linalg.norm(area_vectors, axis=1, keepdims=True)
    sums = np.zeros_like(vertices)
    corners = vertices[faces]
    for k in range(3):
        one, two = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        cosine = np.sum(one * two, axis=1) / (np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1))
        angle = np.arccos(np.clip(cosine, -1, 1))
        for axis in range(3):
            sums[:, axis] += np.bincount(faces[:, k], angle * unit[:, axis], len(vertices))
    sums[~sums.any(axis=1)] = [1, 0, 0]  # vertices of no face
    return sums


def _read_obj(path: Path) -> _Raw:
    """Corners that share position, uv and normal become one vertex; polygons become fans. Materials are not read."""
    tables: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    corners: dict[tuple[int, ...], int] = {}
    lines: list[int] = []  # where each corner was met first
    faces: list[tuple[int, int, int]] = []
    continued = ""
    for line, current in enumerate(path.read_text(encoding="utf-8", errors="replace").split("\n"), start=1):
        if current.endswith("\\"):
            continued += current[:-1] + " "
            continue
        key, *words = (continued + current).split("#", 1)[0].split() or [""]
        continued = ""
        try:
            if key in tables:
                tables[key].append(_obj_row(key, words))
            elif key == "f":
                polygon = []
                for word in words:
                    corner = _obj_corner(word, tables)
                    if corner not in corners:
                        corners[corner] = len(corners)
                        lines.append(line)
                    polygon.append(corners[corner])
                if len(polygon) < 3:
                    raise ValueError(f"a face of {len(polygon)} vertices")
                faces += [(polygon[0], b, c) for b, c in zip(polygon[1:], polygon[2:], strict=False)]
            elif key not in OBJ_WITHOUT_SURFACE:
                raise ValueError(f'"{key[:20]}" is not supported')
        except ValueError as error:
            raise InputError(f"{path}:{line}: {error}") from None

    index = np.array(list(corners), dtype=np.int64).reshape(-1, 3)
    columns = []
    for k, key in enumerate(tables):
        beyond = np.flatnonzero(index[:, k] >= len(tables[key]))
        if beyond.size:
            wanted = index[beyond[0], k] + 1
            raise InputError(f"{path}:{lines[beyond[0]]}: {key} {wanted} does not exist; there are {len(tables[key])}")
        # the extra last row of zeros is what -1, "not given", picks
        table = np.array([*tables[key], [0.0] * (2 if key == "vt" else 3)])
        columns.append(table[index[:, k]] if (index[:, k] >= 0).any() else None)
    vertices, uv, normals = columns
    return _Raw(np.zeros((0, 3)) if vertices is None else vertices, np.array(faces).reshape(-1, 3), normals, uv)


def _obj_row(key: str, words: list[str]) -> list[float]:
    """The numbers of a v, vt or vn line; v may have a weight or a colour behind, vt may lack its second number."""
    row = [float(word) for word in words[: 2 if key == "vt" else 3]]
    if key == "vt" and len(row) == 1:
        row.append(0.0)
    if len(row) < (2 if key == "vt" else 3):
        raise ValueError(f"{key} has too few numbers")
    return row


def _obj_corner(word: str, tables: dict[str, list[list[float]]]) -> tuple[int, ...]:
    """`v`, `v/vt`, `v//vn` or `v/vt/vn` as three indices from 0; -1: not given."""
    parts = word.split("/")
    if len(parts) > 3 or not parts[0]:
        raise ValueError(f'"{word[:40]}" is no corner of a face')
    corner = [-1, -1, -1]
    for k, (part, table) in enumerate(zip(parts, tables.values(), strict=False)):
        if part:
            number = int(part)
            corner[k] = number - 1 if number > 0 else len(table) + number  # negative: back from the last one so far
            if number == 0 or corner[k] < 0:
                raise ValueError(f'"{word[:40]}" names a vertex that does not exist')
    return tuple(corner)


def _read_ply(path: Path) -> _Raw:
    with _interrupts_wait():
        from trimesh.exchange.ply import load_ply

    with open(path, "rb") as file:
        # fix_texture would reorder vertices and leave their normals behind
        loaded = load_ply(file, fix_texture=False, skip_materials=True)
    elements = loaded["metadata"]["_ply_raw"]
    if "texcoord" in elements.get("face", {}).get("properties", {}):
        raise InputError(f"{path}: texture coordinates per face are not supported; save them per vertex, as u and v")
    for name in ("vertex", "face"):
        rows = elements.get(name, {}).get("data", ())
        found = len(next(iter(rows.values()), ())) if isinstance(rows, dict) else len(rows)
        if found < elements.get(name, {}).get("length", 0):
            raise InputError(f"{path}: the file ends after {found} of {elements[name]['length']} {name} rows")
    return _from_trimesh(loaded)


def _read_stl(path: Path) -> _Raw:
    with _interrupts_wait():
        from trimesh.exchange.stl import load_stl

    with open(path, "rb") as file:
        loaded = load_stl(file)
    solids = loaded["geometry"].values() if "geometry" in loaded else [loaded]
    return _joined([_from_trimesh(solid) for solid in solids])


def _read_gltf(path: Path) -> _Raw:
    """All triangles of the default scene, its nodes' transforms applied; materials, cameras, lights are not read."""
    with _interrupts_wait():
        import trimesh
        from trimesh.exchange.gltf import load_glb, load_gltf

    data = path.read_bytes()
    resolver = trimesh.resolvers.FilePathResolver(path)
    if data[:4] == b"glTF":
        magic, version, total, length, chunk = struct.unpack("<5I", data[:20])
        text = _bare_gltf(path, json.loads(data[20 : 20 + length]))
        start = struct.pack("<5I", magic, version, total - length + len(text), len(text), chunk)
        loaded = load_glb(BytesIO(start + text + data[20 + length :]), resolver=resolver)
    else:
        loaded = load_gltf(BytesIO(_bare_gltf(path, json.loads(data))), resolver=resolver)

    graph = trimesh.scene.transforms.SceneGraph()
    for edge in loaded["graph"]:
        graph.update(**edge)
    parts = []
    for node in graph.nodes_geometry:
        matrix, name = graph.get(node)
        part = _from_trimesh(loaded["geometry"][name])
        if part is None:
            continue
        normals = None if part.normals is None else part.normals @ np.linalg.inv(matrix[:3, :3])
        # the format says that a mirroring node reverses the winding
        faces = part.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else part.faces
        uv = None if part.uv is None else part.uv * [1, -1] + [0, 1]  # trimesh has turned v upwards
        parts.append(_Raw(part.vertices @ matrix[:3, :3].T + matrix[:3, 3], faces, normals, uv))
    return _joined(parts)


def _bare_gltf(path: Path, header: dict) -> bytes:
    """The JSON of a glTF file with one blank material for all: trimesh reads uv only beside a material, and would
    decode textures that nobody looks at. What trimesh would misread is refused."""
    refused = [name for name in header.get("extensionsRequired", []) if not name.startswith("KHR_materials_")]
    refused += ["skins"] if header.get("skins") else []
    if any("bufferView" not in accessor for accessor in header.get("accessors", [])):
        refused.append("accessors without data")  # trimesh makes as many zeros as they claim
    for primitive in (primitive for mesh in header.get("meshes", []) for primitive in mesh["primitives"]):
        primitive["material"] = 0
        uv = primitive["attributes"].get("TEXCOORD_0")
        if uv is not None and header["accessors"][uv]["componentType"] != GLTF_FLOAT:
            refused.append("integer texture coordinates")
        if primitive.get("mode") == GLTF_FAN:
            refused.append("triangle fans")
        if primitive.get("targets"):
            refused.append("morph targets")
    if refused:
        raise InputError(f"{path}: glTF with {', '.join(refused)} is not supported; export plain triangles")
    return json.dumps({**header, "materials": [{}]}).encode()


def _from_trimesh(loaded: dict) -> _Raw | None:
    """From the keyword arguments that trimesh's readers return; None where they hold no triangles."""
    faces = loaded.get("faces")
    if faces is None or loaded.get("vertices") is None:
        return None
    faces = np.asarray(faces)
    if faces.dtype.kind not in "iu":
        raise ValueError("indices are not integers")
    faces = faces.astype(np.int64)
    if faces.ndim == 2 and faces.shape[1] > 3:
        faces = np.concatenate([faces[:, [0, k, k + 1]] for k in range(1, faces.shape[1] - 1)])
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError("faces have fewer than 3 vertices")
    normals = loaded.get("vertex_normals")
    uv = getattr(loaded.get("visual"), "uv", None)
    return _Raw(
        np.asarray(loaded["vertices"], np.float64).reshape(-1, 3),
        faces,
        None if normals is None else np.asarray(normals, np.float64).reshape(-1, 3),
        None if uv is None else np.asarray(uv, np.float64).reshape(-1, 2),
    )


def _joined(parts: list[_Raw | None]) -> _Raw | None:
    """One mesh of several; normals or uv that only some have are zeros in the others."""
    parts = [part for part in parts if part]
    if len(parts) <= 1:
        return parts[0] if parts else None
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])

    def column(values: list[np.ndarray | None], width: int) -> np.ndarray | None:
        if all(value is None for value in values):
            return None
        filled = (np.zeros((len(part.vertices), width)) for part in parts)
        return np.concatenate([zeros if value is None else value for value, zeros in zip(values, filled, strict=True)])

    vertices = np.concatenate([part.vertices for part in parts])
    return _Raw(vertices, faces, column([part.normals for part in parts], 3), column([part.uv for part in parts], 2))


GLTF_FLOAT, GLTF_FAN = 5126, 6

READERS = {"obj": _read_obj, "ply": _read_ply, "stl": _read_stl, "glb": _read_gltf, "gltf": _read_gltf}

# lines of an OBJ file that say nothing about its triangles, or draw points and lines
OBJ_WITHOUT_SURFACE = frozenset(
    ["", "o", "g", "s", "mg", "usemtl", "mtllib", "usemap", "maplib", "l", "p", "bevel", "c_interp", "d_interp", "lod"]
)
