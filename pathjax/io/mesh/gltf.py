"""glTF 2.0, also as GLB: all triangles of the default scene, placed by its nodes.

Materials, cameras, lights and animations are not read. Features that change the triangles and are not modelled, such as
skins or compression, are refused by name. trimesh 5.2 silently leaves out sparse accessors and triangle fans.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from pathjax.errors import InputError
from pathjax.io.mesh.polygons import cross, strips
from pathjax.io.mesh.raw import Raw

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes; lower ones draw points and lines

# Extensions that files may require: they do not affect the triangles, or are modelled.
HARMLESS = re.compile(r"(KHR_materials|KHR_texture|EXT_texture)_\w+|KHR_lights_punctual|KHR_mesh_quantization")
# Node extensions that change which triangles exist; refused even where the file does not require them.
PLACING = ("EXT_mesh_gpu_instancing", "KHR_node_visibility")


@dataclass(frozen=True)
class File:
    path: Path
    header: dict
    chunk: bytes | None  # the binary part of a GLB
    buffers: dict[int, bytes] = field(default_factory=dict)
    beside: list[Path] = field(default_factory=list)  # other files that were read

    def refuse(self, what: str) -> InputError:
        return InputError(f"{self.path}: glTF with {what} is not supported; export it without")

    def entry(self, kind: str, number: int) -> dict:
        """Return entry `number` of a list of the header; negative numbers are refused."""
        there = len(self.header.get(kind, ()))
        if not 0 <= number < there:
            raise InputError(f"{self.path}: {kind} {number} does not exist; there are {there}")
        return self.header[kind][number]

    def buffer(self, number: int) -> bytes:
        if number not in self.buffers:
            uri = self.entry("buffers", number).get("uri")
            data = self.chunk if uri is None and number == 0 else self._fetch(uri)
            if data is None or len(data) < self.entry("buffers", number)["byteLength"]:
                raise InputError(f"{self.path}: buffer {number} is shorter than its byteLength says, or is not there")
            self.buffers[number] = data
        return self.buffers[number]

    def _fetch(self, uri: str | None) -> bytes | None:
        if uri is None:
            return None
        if uri[:5].lower() == "data:":
            kind, _, data = uri.partition(",")
            return base64.b64decode(unquote(data)) if kind.endswith(";base64") else unquote_to_bytes(data)
        if re.match(r"\w{2,}:", uri):  # a single letter is a Windows drive
            raise self.refuse(f"the address {uri[:60]}")
        names = [unquote(uri), uri]  # the second for programs that write names without percent-encoding
        found = next((file for name in names if (file := self.path.parent / name).is_file()), None)
        if found is None:
            raise InputError(f"{self.path}: {unquote(uri)[:200]}, which it names, is not beside it")
        self.beside.append(found)
        return found.read_bytes()

    def image(self, number: int) -> bytes | None:
        """Return the bytes of an image file."""
        this = self.entry("images", number)
        if "bufferView" not in this:
            return self._fetch(this["uri"])
        view = self.entry("bufferViews", this["bufferView"])
        start = view.get("byteOffset", 0)
        return self.buffer(view["buffer"])[start : start + view["byteLength"]]

    def accessor(self, number: int) -> np.ndarray:
        """Return (count, width) values: float64, or integers if the stored ones are not normalized."""
        this = self.entry("accessors", number)
        layout = this["componentType"], this["type"], this["count"]
        if "bufferView" in this:
            values = self._view(this, *layout)
        else:
            values = np.zeros((this["count"], WIDTHS[this["type"]]), COMPONENTS[this["componentType"]])
        if "sparse" in this:
            sparse = this["sparse"]
            places = self._view(sparse["indices"], sparse["indices"]["componentType"], "SCALAR", sparse["count"])[:, 0]
            values = values.copy()
            values[places] = self._view(sparse["values"], *layout[:2], sparse["count"])
        if this.get("normalized") and values.dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values if values.dtype.kind in "iu" else values.astype(np.float64)

    def _view(self, where: dict, component: int, kind: str, count: int) -> np.ndarray:
        """Return (count, width) stored values, beginning at `byteOffset` in a bufferView."""
        view, offset = self.entry("bufferViews", where["bufferView"]), where.get("byteOffset", 0)
        data, dtype, width = self.buffer(view["buffer"]), np.dtype(COMPONENTS[component]), WIDTHS[kind]
        start = view.get("byteOffset", 0)
        stride = view.get("byteStride", width * dtype.itemsize)
        end = offset + max(count - 1, 0) * stride + width * dtype.itemsize
        if min(offset, start, count) < 0 or stride < 1 or end > view["byteLength"] or start + end > len(data):
            raise InputError(f"{self.path}: bufferView {where['bufferView']} is shorter than its accessor")
        return np.ndarray((count, width), dtype, data, start + offset, (stride, dtype.itemsize))


def read(path: Path) -> Raw:
    file = opened(path)
    header = file.header
    parts = []
    for node, matrix in placed(file):
        for primitive in file.entry("meshes", node["mesh"])["primitives"] if "mesh" in node else ():
            if primitive.get("mode", TRIANGLES) >= TRIANGLES:
                parts.append(triangles_of(file, primitive, matrix))
    notes = ["its materials, cameras and lights are not read"]
    if "KHR_texture_transform" in header.get("extensionsUsed", []):
        notes.append("transforms of its materials' textures are not applied to uv")
    if len(header.get("scenes", [])) > 1:
        notes.append(f"scene {header.get('scene', 0)} of its {len(header['scenes'])} is read")
    lacking = sum(len(part.vertices) for part in parts if part.uv is None)
    if lacking and any(part.uv is not None for part in parts):
        notes.append(f"{lacking} vertices without texture coordinates got (0, 0)")
    if any(part.normals is not None for part in parts):  # glTF: primitives without normals are flat
        parts = [part if part.normals is not None else _flat(part) for part in parts]
    return _joined(parts, tuple(notes))


def opened(path: Path, known: re.Pattern = HARMLESS) -> File:
    """Open a glTF file.

    known: extensions that it may require.

    Raises:
        InputError: it requires others, or has features that change its triangles and are not modelled.
    """
    file = _parsed(path, path.read_bytes())
    header = file.header
    refused = [name for name in header.get("extensionsRequired", []) if not known.fullmatch(name)]
    refused += sorted({name for node in header.get("nodes", []) for name in node.get("extensions", {})} & set(PLACING))
    refused += ["skins"] if header.get("skins") else []
    if any(not {"bufferView", "sparse"} & accessor.keys() for accessor in header.get("accessors", [])):
        refused.append("accessors without data")
    if any(primitive.get("targets") for mesh in header.get("meshes", []) for primitive in mesh["primitives"]):
        refused.append("morph targets")
    if refused:
        raise file.refuse(", ".join(refused))
    return file


def _parsed(path: Path, data: bytes) -> File:
    chunk = None
    if data[:4] == b"glTF":
        _, version, total = struct.unpack_from("<4s2I", data)
        if version != 2:
            raise InputError(f"{path}: glTF of version {version} is not supported; export glTF 2.0")
        chunks, at = {}, 12
        while at + 8 <= total:
            size, kind = struct.unpack_from("<I4s", data, at)
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        if at > len(data):
            raise InputError(f"{path}: the file ends within a chunk")
        data, chunk = chunks[b"JSON"], chunks.get(b"BIN\0")
    header = json.loads(data)
    version = header.get("asset", {}).get("version", "2.0")
    if not version.startswith("2."):
        raise InputError(f"{path}: glTF of version {version[:20]} is not supported; export glTF 2.0")
    return File(path, header, chunk)


def placed(file: File) -> Iterator[tuple[dict, np.ndarray]]:
    """Yield the nodes of the default scene, or all nodes if there are no scenes, with their matrices to world space."""
    nodes = file.header.get("nodes", [])
    if file.header.get("scenes"):
        roots = file.entry("scenes", file.header.get("scene", 0)).get("nodes", [])
    else:
        roots = set(range(len(nodes))).difference(*(node.get("children", []) for node in nodes))
    waiting = [(number, np.eye(4)) for number in reversed(list(roots))]
    seen = set()
    while waiting:
        number, above = waiting.pop()
        if number in seen:
            raise InputError(f"{file.path}: node {number} has two parents")
        seen.add(number)
        node = file.entry("nodes", number)
        matrix = above @ _local(node)
        yield node, matrix
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _local(node: dict) -> np.ndarray:
    if "matrix" in node:
        return np.reshape(np.array(node["matrix"], np.float64), (4, 4)).T
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1])) / np.linalg.norm(node.get("rotation", 1))
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]), np.float64)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def triangles_of(file: File, primitive: dict, matrix: np.ndarray, uv: int = 0) -> Raw:
    """Return a primitive of a mesh, in world space. uv: index of the texture coordinates."""
    attributes, mode = primitive["attributes"], primitive.get("mode", TRIANGLES)
    vertices = file.accessor(attributes["POSITION"]).astype(np.float64)
    index = file.accessor(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(vertices))
    if index.dtype.kind not in "iu":
        raise InputError(f"{file.path}: its indices are not integers")
    index = index.astype(np.int64)
    if len(index) and not 0 <= index.min() <= index.max() < len(vertices):
        raise InputError(f"{file.path}: the index {index.max()} does not exist; there are {len(vertices)} positions")
    if mode == TRIANGLES and len(index) % 3 == 0:
        faces = index.reshape(-1, 3)
    elif mode == STRIP:
        faces = strips(index, np.array([len(index)]))
    elif mode == FAN:
        faces = np.stack([index[1:-1], index[2:], np.repeat(index[:1], max(len(index) - 2, 0))], axis=1)
    else:
        raise InputError(f"{file.path}: {len(index)} corners of a primitive of mode {mode} make no triangles")

    def attribute(name: str, width: int) -> np.ndarray | None:
        if name not in attributes:
            return None
        values = file.accessor(attributes[name])
        if values.shape != (len(vertices), width):
            raise InputError(f"{file.path}: {name} has the shape {values.shape} beside {len(vertices)} positions")
        if values.dtype.kind in "iu":
            raise file.refuse(f"integer {name}")
        return values

    linear = matrix[:3, :3]
    normals = attribute("NORMAL", 3)
    if normals is not None:
        # The inverse transpose up to scale; unlike that, it exists for a singular `linear` too.
        cofactors = np.stack([np.cross(linear[k - 2], linear[k - 1]) for k in range(3)])
        normals = normals @ cofactors.T * np.copysign(1, np.linalg.det(linear))
    if np.linalg.det(linear) < 0:  # glTF: a mirroring node reverses the winding
        faces = faces[:, ::-1]
    vertices = vertices @ linear.T + matrix[:3, 3]
    return Raw(vertices, faces.ravel(), normals=normals, uv=attribute(f"TEXCOORD_{uv}", 2))


def _flat(part: Raw) -> Raw:
    """Return the triangles with separate vertices that have the normals of their triangles."""
    vertices = part.vertices[part.corners]
    a, b, c = (vertices[k::3].T for k in range(3))
    normals = np.repeat(cross(b - a, c - a).T, 3, axis=0)
    return Raw(vertices, np.arange(len(vertices)), None, normals, None if part.uv is None else part.uv[part.corners])


def _joined(parts: list[Raw], notes: tuple[str, ...]) -> Raw:
    """Join several meshes into one; uv are zeros for meshes without, if others have them."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])

    def column(name: str, width: int) -> np.ndarray | None:
        values = [getattr(part, name) for part in parts]
        if all(value is None for value in values):
            return None
        filled = (np.zeros((len(part.vertices), width)) for part in parts)
        return np.concatenate([zeros if value is None else value for value, zeros in zip(values, filled, strict=True)])

    empty = Raw(np.zeros((0, 3)), np.zeros(0, np.int64))
    return Raw(
        np.concatenate([part.vertices for part in [empty, *parts]]),
        np.concatenate([empty.corners, *(part.corners + start for part, start in zip(parts, starts, strict=False))]),
        normals=column("normals", 3),
        uv=column("uv", 2),
        notes=notes,
    )
