"""From what a file says of shapes and lights to their tables."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pathjax import description as desc
from pathjax.emitters import Emitters
from pathjax.emitters.area import AreaLights
from pathjax.emitters.constant import Constant
from pathjax.kinds.parameter import Parameter
from pathjax.shapes import box, coincident, planar, sphere, triangle
from pathjax.shapes.accel import leaves
from pathjax.shapes.box import Boxes
from pathjax.shapes.geometry import Geometry
from pathjax.shapes.planar import Planar
from pathjax.shapes.sphere import Spheres
from pathjax.shapes.triangle import Triangles

# Faces of the cube [-1, 1]^3 in the order of `Boxes`: centre, directions of u and v, normal; uv as in Mitsuba's cube.
_CUBE = np.array(
    [
        [[-1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -1], [1, 0, 0]],
        [[0, -1, 0], [0, 0, 1], [1, 0, 0], [0, -1, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 0, -1]],
        [[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 1]],
    ],
    float,
)
_FLAT = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]], float)


def _planar_frames(local, to_world, flip):
    """(P, 4, 3) centre, u, v and unit normal in world space."""
    linear = to_world[:3, :3]
    points = local[:, :1] @ linear.T + to_world[:3, 3]
    directions = local[:, 1:3] @ linear.T
    normals = local[:, 3:] @ np.linalg.inv(linear)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True) * (-1 if flip else 1)
    return np.concatenate([points, directions, normals], 1)


def _mesh_arrays(mesh: desc.Mesh, flip):
    """Vertices, normals or None, uv or None, each (F, 3, ...) by triangle."""
    faces = mesh.faces[:, ::-1] if flip else mesh.faces
    normals = None if mesh.normals is None else mesh.normals[faces] * (-1 if flip else 1)
    return mesh.vertices[faces], normals, None if mesh.uv is None else mesh.uv[faces]


@dataclass
class _Kind:
    """Primitives of one kind while they are gathered: arrays by shape, and where they come from."""

    parts: list = field(default_factory=list)
    numbers: list = field(default_factory=list)  # for each part, its shape
    shape: list = field(default_factory=list)  # for each primitive, its shape
    light: list = field(default_factory=list)  # for each primitive, its light or -1


def build_shapes(description, dtype, parameters, split_rule):
    kinds = {name: _Kind() for name in ("sphere", "rectangle", "disk", "triangle")}
    radiance, lights = [], []  # lights: emitter, area, kind, first row, count

    # Faces of cubes come after the other rectangles: `Planar` finds the last of its rectangles by boxes.
    numbered = sorted(enumerate(description.shapes), key=lambda item: isinstance(item[1].geometry, desc.Cube))
    for number, shape in numbered:
        match shape.geometry:
            case desc.Sphere() as ball:
                name, part = "sphere", [(ball, shape.flip_normals)]
                areas = sphere.area(np.array([[*ball.center, ball.radius]]))
            case desc.Rectangle(to_world=m) | desc.Cube(to_world=m):
                local = _CUBE if isinstance(shape.geometry, desc.Cube) else _FLAT
                name, part = "rectangle", _planar_frames(local, m, shape.flip_normals)
                areas = planar.area(part, disk=False)
            case desc.Disk(to_world=m):
                name, part = "disk", _planar_frames(_FLAT, m, shape.flip_normals)
                areas = planar.area(part, disk=True)
            case desc.Mesh() as mesh:
                name, part = "triangle", _mesh_arrays(mesh, shape.flip_normals)
                areas = triangle.area(part[0])
        kind, count = kinds[name], len(areas)
        light = np.full(count, -1)
        if shape.radiance is not None:
            emitter = len(radiance)
            radiance.append(shape.radiance)
            index = ("emitters", "area", "radiance")
            parameters[f"{shape.emitter_name}.radiance"] = Parameter(index, (emitter,), (3,), (0, np.inf))
            first = len(kind.shape)
            if name == "triangle":
                light[:] = len(lights)
                lights.append((emitter, areas.sum(), name, first, count, areas))
            else:
                light[:] = len(lights) + np.arange(count)
                lights.extend((emitter, a, name, first + i, 1, None) for i, a in enumerate(areas))
        kind.parts.append(part)
        kind.numbers.append(number)
        kind.shape.extend([number] * count)
        kind.light.extend(light.tolist())

    margins = _part_coincident(kinds, description.shapes, dtype)
    tables, trees, names = [], {}, []
    for name, make in (("sphere", _spheres), ("rectangle", _planars), ("disk", _planars), ("triangle", _triangles)):
        if kinds[name].shape:
            table, built = make(kinds[name].parts, name, dtype, split_rule, margins.get(name))
            trees |= built
            tables.append(table)
            names.append(name)
    geometry = Geometry(
        tuple(tables),
        np.asarray([s for name in names for s in kinds[name].shape], np.int32),
        np.asarray([i for name in names for i in kinds[name].light], np.int32),
    )
    constant = None
    if description.background is not None:
        constant = Constant(np.asarray(description.background, dtype))
        index = ("emitters", "constant", "radiance")
        parameters[f"{description.background_name}.radiance"] = Parameter(index, (), (3,), (0, np.inf))
    area = _area_lights(radiance, lights, names, dtype) if lights else None
    return geometry, Emitters(area, constant), {k: tree for k, tree in trees.items() if tree is not None}


def _area_lights(radiance, lights, names, dtype) -> AreaLights:
    emitter, area, kind, first, count, areas = zip(*lights, strict=True)
    cdf, cdf_first = None, None
    if any(a is not None for a in areas):
        sizes = [0 if a is None else len(a) for a in areas]
        cdf_first = np.asarray(np.cumsum([0, *sizes[:-1]]), np.int32)
        cdf = np.asarray(np.concatenate([np.cumsum(a) / np.sum(a) for a in areas if a is not None]), dtype)
    return AreaLights(
        np.asarray(np.stack(radiance), dtype),
        np.asarray(emitter, np.int32),
        np.asarray(area, dtype),
        np.asarray([sorted(set(kind), key=names.index).index(k) for k in kind], np.int32),
        np.asarray(first, np.int32),
        np.asarray(count, np.int32),
        cdf,
        cdf_first,
        tuple(names.index(k) for k in sorted(set(kind), key=names.index)),
    )


def _part_coincident(kinds, shapes, dtype):
    """Move faces as `coincident` has it, in place, and return margins (P,) by name, where a kind has any."""
    margins = {name: [] for name, kind in kinds.items() if kind.parts}
    if "sphere" in margins:
        margins["sphere"].append(coincident.sphere_margins(_balls(kinds["sphere"].parts), dtype))
    names, points, faces = [], [], []
    for name in ("rectangle", "disk", "triangle"):
        for part, number in zip(kinds[name].parts, kinds[name].numbers, strict=True):
            glass, lamp = shapes[number].bsdf.kind.sided, shapes[number].radiance is not None
            if name == "triangle":
                faces.append(coincident.faces_of_mesh(part[0], glass, lamp, dtype))
            else:
                faces.append(coincident.faces_of_planar(part, glass, lamp))
            points.append(part[0] if name == "triangle" else part[:, 0])
            names.append(name)
    for name, place, moves, found in zip(names, points, *coincident.contacts(faces, dtype), strict=True):
        place += moves
        margins[name].append(np.broadcast_to(found, len(place)))
    margins = {name: np.concatenate(each) for name, each in margins.items()}
    return {name: np.asarray(each, dtype) for name, each in margins.items() if each.any()}


def _balls(parts):
    """(P, 4) centers and radii."""
    return np.array([[*ball.center, ball.radius] for part in parts for ball, _ in part])


def _spheres(parts, name, dtype, rule, margins):
    balls = _balls(parts)
    linear = np.stack([ball.to_world[:3, :3] for part in parts for ball, _ in part])
    rotation = linear / np.linalg.norm(linear, axis=1, keepdims=True)
    sign = np.array([-1.0 if flip else 1.0 for part in parts for _, flip in part])
    numbers, bounds = sphere.leaf_numbers(balls), sphere.bounds(balls)
    packed, tree, built = leaves.pack(numbers, *bounds, dtype, rule)
    to_local = np.swapaxes(rotation, 1, 2)
    arrays = (np.asarray(x, dtype) for x in (balls, to_local, sign))
    return Spheres(packed, tree, *arrays, margins), {name: built}


def _planars(parts, name, dtype, rule, margins):
    frames, disk = np.concatenate(parts), name == "disk"
    single = sum(len(part) for part in parts if len(part) < box.FACES)  # then come the faces of cubes
    alone, faces = frames[:single], frames[single:]
    numbers, bounds = planar.leaf_numbers(alone), planar.bounds(alone, disk)
    packed, tree, built = leaves.pack(numbers, *bounds, dtype, rule)
    boxes, trees = None, {name: built}
    if len(faces):
        numbers, bounds = box.leaf_numbers(faces), box.bounds(faces)
        place = {"first": single, "step": box.FACES}
        *found, trees["cube"] = leaves.pack(numbers, *bounds, dtype, rule, **place)
        boxes = Boxes(*found)
    return Planar(packed, tree, np.asarray(frames, dtype), boxes, margins, disk), trees


def _triangles(parts, name, dtype, rule, margins):
    vertices = np.concatenate([part[0] for part in parts])

    def optional(place, default):
        if all(part[place] is None for part in parts):
            return None
        filled = [default(part[0]) if part[place] is None else part[place] for part in parts]
        return np.asarray(np.concatenate(filled), dtype)

    normals = optional(1, triangle.face_normals)
    uv = optional(2, lambda v: np.broadcast_to(np.array([[0, 0], [1, 0], [0, 1]], float), (len(v), 3, 2)))
    bounds = triangle.bounds(vertices)
    packed, tree, built = leaves.pack(triangle.leaf_numbers(vertices), *bounds, dtype, rule)
    return Triangles(packed, tree, np.asarray(vertices, dtype), normals, uv, margins), {name: built}
