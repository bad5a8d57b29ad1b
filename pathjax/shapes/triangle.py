"""Meshes of triangles: watertight intersection, surface, area sampling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import at, cross, dot, larger, normalize, rescale, safe_divide
from pathjax.core.types import Surface
from pathjax.core.warp import square_to_triangle
from pathjax.description.fields import Fields
from pathjax.shapes.accel.leaves import numbers_of, pack, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.coincident import Faces, precision, unit_normal
from pathjax.shapes.shape import Primitives, Shape, Table
from pathjax.system.cores import over_cores

# File formats of meshes that `io.mesh` reads.
FORMATS = ("obj", "ply", "stl", "glb", "gltf")
# Number of triangles among which the largest is chosen; its plane is that of the mesh if the mesh is flat.
_FIRST = 100


@dataclass
class Facets(Primitives):
    vertices: np.ndarray  # (F, 3, 3)
    normals: np.ndarray | None  # (F, 3, 3)
    uv: np.ndarray | None  # (F, 3, 2)
    attributes: Mapping[str, np.ndarray]  # (F, 3, 3) at the corners
    entries: Mapping[str, np.ndarray] = field(default_factory=dict)  # (F, 3) index of each corner's attribute value

    one_lamp = True

    @property
    def count(self):
        return len(self.vertices)

    @property
    def areas(self):
        return _areas(self.vertices)

    def boxes(self):
        return bounds(self.vertices)

    def facing(self):
        a, b, c = np.moveaxis(self.vertices, 1, 0)
        return np.cross(b - a, c - a) / 2

    def faces(self, glass, lamp, dtype):
        """Return one face if all triangles lie in one plane, else all triangles as fixed faces."""
        first = self.vertices[:_FIRST]
        largest = first[np.argmax(_areas(first))]
        corner, edge, normal = largest[0], largest[1] - largest[0], unit_normal(largest)
        bent = Faces(self.vertices, None, None, glass, lamp)
        farthest = [np.abs(self.vertices[:, :, axis]).max() for axis in range(3)]
        if np.abs((first - corner) @ normal).max() > 2 * precision(dtype) * (farthest @ np.abs(normal)):
            return bent  # early out: a large mesh is not tested in full
        from_corner = self.vertices - corner
        reach = (np.abs(self.vertices) @ np.abs(normal)).max()
        if np.abs(from_corner @ normal).max() > 2 * precision(dtype) * reach:
            return bent
        axes = np.stack([edge, np.cross(normal, edge)]) / np.linalg.norm(edge)
        places = from_corner @ axes.T
        (x0, y0), (x1, y1) = places.min((0, 1)), places.max((0, 1))
        around = corner + np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) @ axes
        return Faces(around[None], normal[None], np.array([np.inf]), glass, lamp)

    def move(self, moves):
        self.vertices += moves


@register_dataclass
@dataclass(frozen=True)
class Triangles(Table):
    leaves: jax.Array  # x of the three vertices, then y, z
    tree: Tree | None
    vertices: jax.Array  # (P, 3, 3) by row: vertex, axis
    normals: jax.Array | None  # (P, 3, 3) at the vertices; None: no triangle of the scene is smooth
    uv: jax.Array | None  # (P, 3, 2)
    margins: jax.Array | None  # (P,) of `coincident`, added to their own; None: no flat shape coincides with any
    area_cdf: jax.Array | None  # (P,) cumulative share of the area of each mesh that emits; None: no mesh emits
    # (P, 3, 3) by row: vertex, channel; 0 where a mesh lacks the attribute.
    attributes: Mapping[str, jax.Array | np.ndarray] = field(default_factory=dict)

    kind = "triangle"
    polygons = triangular = True

    @classmethod
    def build(cls, parts, lit, dtype, rule, margins):
        def joined(arrays):
            return np.concatenate(list(arrays), dtype=dtype, casting="unsafe")

        def optional(name, default):
            values = [getattr(part, name) for part in parts]
            if all(value is None for value in values):
                return None
            return joined([default(p.vertices) if v is None else v for p, v in zip(parts, values, strict=True)])

        defaults = {
            "normals": lambda v: np.repeat(unit_normal(v)[:, None], 3, axis=1),
            "uv": lambda v: np.broadcast_to(np.array([[0, 0], [1, 0], [0, 1]], float), (len(v), 3, 2)),
            "vertices": None,
        }
        with over_cores(sum(part.count for part in parts)) as run:
            normals, uv, vertices = run(optional, defaults, defaults.values())
        cdf = None
        if any(lit):
            running = ((part.areas, on) for part, on in zip(parts, lit, strict=True))
            cdf = joined([np.cumsum(areas) / np.sum(areas) * on for areas, on in running])
        packed, tree, built = pack(leaf_numbers(vertices), *bounds(vertices), dtype, rule)
        names = dict.fromkeys(name for part in parts for name in part.attributes)
        attributes = {
            name: joined([part.attributes.get(name, np.zeros_like(part.vertices)) for part in parts]) for name in names
        }
        made = cls(packed, tree, vertices, normals, uv, margins, cdf, attributes)
        return made, {cls.kind: built}

    def prepare(self, o, d):
        """Return constants of a ray: the shear that maps it to the z axis (Woop, Benthin, Wald 2013, JCGT 2(1)).

        Returns:
            (3,) int32 axes x, y, z, or with a tree (3,) uint32 offsets of these axes in a leaf; and (6,) origin and
            shear in that order.
        """
        size = jnp.abs(d)
        z = jnp.where(size[0] > size[1], jnp.where(size[0] > size[2], 0, 2), jnp.where(size[1] > size[2], 1, 2))
        z = z.astype(jnp.int32)
        x = jnp.where(z == 2, 0, z + 1)
        y = jnp.where(x == 2, 0, x + 1)
        scale = 1 / at(d, z)
        shear = [at(d, x) * scale, at(d, y) * scale, scale]
        axes = jnp.stack([x, y, z])
        if self.tree is not None:
            axes = jnp.uint32(3) * axes.astype(jnp.uint32)
        return axes, jnp.stack([at(o, x), at(o, y), at(o, z), *shear])

    def intersect(self, leaf, prepared, start):
        """Watertight intersection: edges are inclusive up to the rounding error of their edge function. (Contraction to
        fused multiply-adds gives the plain edge functions of two triangles that share an edge different signs.)
        """
        axes, ray = prepared
        _, _, width = self.leaves.shape

        if self.tree is None:
            # The coordinates of an axis are selected, not gathered, from all nine, which the lanes share.
            block = numbers_of(at(self.leaves, leaf)[:9], ray.dtype).reshape(3, 3, width)

        def coordinates(axis):
            if self.tree is None:
                return list(at(block, axis))
            start = [jnp.asarray(i, jnp.uint32) for i in (leaf, axis, 0)]
            found = lax.dynamic_slice(self.leaves, start, (1, 3, width), allow_negative_indices=False)[0]
            return list(numbers_of(found, ray.dtype))

        # Vertex by vertex: XLA does not vectorise loops over (3, W).
        z = [c - ray[2] for c in coordinates(axes[2])]
        x = [c - ray[0] - ray[3] * z for c, z in zip(coordinates(axes[0]), z, strict=True)]
        y = [c - ray[1] - ray[4] * z for c, z in zip(coordinates(axes[1]), z, strict=True)]
        tolerance = 2 * np.finfo(ray.dtype).eps

        def edge(i, j):
            a, b = x[i] * y[j], y[i] * x[j]
            return a - b, tolerance * (jnp.abs(a) + jnp.abs(b))

        (u, u_error), (v, v_error), (w, w_error) = edge(2, 1), edge(0, 2), edge(1, 0)
        front = (u >= -u_error) & (v >= -v_error) & (w >= -w_error)
        back = (u <= u_error) & (v <= v_error) & (w <= w_error)
        det, error = u + v + w, u_error + v_error + w_error
        moment = u * z[0] + v * z[1] + w * z[2]
        t = moment * ray[5] / det
        reach = larger(larger(jnp.abs(z[0]), jnp.abs(z[1])), jnp.abs(z[2]))
        # If a triangle is edge-on, or tiny and far from the ray, the errors dominate and every edge is inclusive. A ray
        # that starts in its plane, or on a neighbour's edge, gets a distance of pure rounding, below half the errors.
        sound = (jnp.abs(det) > error) & (jnp.abs(moment) > reach * (error / 2))
        rows = rows_of(at(self.leaves, leaf))
        return jnp.where((front | back) & sound & (rows != start), t, jnp.inf), rows

    @property
    def count(self):
        return self.vertices.shape[0]

    def surface(self, row, o, d, t):
        """Compute the surface from the ray's barycentrics."""
        vertices = at(self.vertices, row)
        edge1, edge2 = vertices[1] - vertices[0], vertices[2] - vertices[0]
        b0, b1, b2 = compute_once(_barycentrics(vertices[0], edge1, edge2, o, d))
        n = _normal(edge1, edge2)

        def interpolate(values):
            return b0 * values[0] + b1 * values[1] + b2 * values[2]

        shading_n = n
        if self.normals is not None:
            shading_n = normalize(interpolate(at(self.normals, row)))
        uv = jnp.stack([b1, b2]) if self.uv is None else interpolate(at(self.uv, row))
        margin = dot(jnp.abs(n), _point_error(vertices))
        if self.margins is not None:
            margin = margin + at(self.margins, row)
        attributes = {name: interpolate(at(values, row)) for name, values in self.attributes.items()} or None
        return Surface(interpolate(vertices), n, margin, shading_n, uv, attributes=attributes)

    def corners(self, row, o, d):
        vertices = at(self.vertices, row)
        edge1, edge2 = vertices[1] - vertices[0], vertices[2] - vertices[0]
        return 3 * row, jnp.stack(_barycentrics(vertices[0], edge1, edge2, o, d))

    def along_u(self, row, surface):
        """Return the direction of u: 0 if the mesh collapses uv to a line; without uv the first edge, where u grows."""
        a, b, c = at(self.vertices, row)
        if self.uv is None:
            return b - a
        uv = at(self.uv, row)
        (u1, v1), (u2, v2) = uv[1] - uv[0], uv[2] - uv[0]
        return jnp.sign(u1 * v2 - u2 * v1) * (v2 * (b - a) - v1 * (c - a))

    def sample(self, row, u):
        return self.from_square(row, square_to_triangle(u))

    def row_of_lamp(self, lamps, lamp, u_part):
        """Choose a triangle of the mesh in proportion to its area."""
        first, count = at(lamps.first, lamp), at(lamps.count, lamp)

        def halve(_, between):
            low, high = between
            middle = (low + high) // 2
            above = at(self.area_cdf, first + middle) > u_part
            return jnp.where(above, low, middle + 1), jnp.where(above, middle, high)

        steps = self.count.bit_length()
        found, _ = lax.fori_loop(0, steps, halve, (jnp.int32(0), count - 1))
        return first + jnp.minimum(found, count - 1)

    def areas(self):
        return _areas(np.asarray(self.vertices, float))

    def cell_lengths(self, size):
        return np.sqrt(self.areas())[:, None].repeat(2, 1)

    def to_square(self, row, p):
        corner, *others = at(self.vertices, row)
        a, b = (other - corner for other in others)
        q = p - corner
        aa, ab, bb, qa, qb = dot(a, a), dot(a, b), dot(b, b), dot(q, a), dot(q, b)
        return jnp.stack([bb * qa - ab * qb, aa * qb - ab * qa]) / (aa * bb - ab * ab)

    def from_square(self, row, xy):
        vertices = at(self.vertices, row)
        a, b = vertices[1] - vertices[0], vertices[2] - vertices[0]
        n = _normal(a, b)
        return vertices[0] + xy[0] * a + xy[1] * b, n, dot(jnp.abs(n), _point_error(vertices))

    def edges_and_normals(self):
        v = np.asarray(self.vertices, float)
        a, b = v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]
        return np.stack([v[:, 0], a, b], 1), np.cross(a, b)


@dataclass(frozen=True)
class Mesh(Shape):
    """Triangles, none degenerate; normals follow the transform, and are unit unless an instance scales unevenly."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3) int64
    normals: np.ndarray | None  # (V, 3): smooth shading; None: face normals
    uv: np.ndarray | None  # (V, 2)
    dropped: int = 0  # degenerate triangles left out
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)  # "vertex_*" (V, 3), "face_*" (F, 3)
    table = Triangles
    triangles = True

    @classmethod
    def read(cls, loader, fields: Fields):
        file, to_world = loader.find(fields, "filename"), fields.transform("to_world")
        face_normals = fields.boolean("face_normals", False)
        return loader.read_mesh(file, fields.type, to_world, face_normals=face_normals, **cls.choices(fields))

    @staticmethod
    def choices(fields: Fields) -> dict[str, object]:
        """Return the options of this file format for `io.mesh.load`."""
        return {"flip_tex_coords": fields.boolean("flip_tex_coords", None)}

    @property
    def smooth(self):
        return self.normals is not None

    @property
    def closed(self):
        """Whether each edge has a triangle on either side, where vertices at the same place count as one."""
        _, place = np.unique(self.vertices, axis=0, return_inverse=True)
        corners = place.reshape(-1)[self.faces]
        edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        one_way, other_way = (np.unique(each, axis=0, return_counts=True) for each in (edges, edges[:, ::-1]))
        return all(map(np.array_equal, one_way, other_way))

    @property
    def empty(self):
        return not len(self.faces)

    def placed(self, to_world):
        linear, faces, normals = to_world[:3, :3], self.faces, self.normals
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = self.vertices @ linear.T + to_world[:3, 3]
            if not np.isfinite(vertices.astype(np.float32)).all():
                return None
        if np.linalg.det(linear) < 0:  # a mirroring turns faces inside out
            faces = faces[:, ::-1]
        if normals is not None:
            normals = normals @ np.linalg.inv(linear)
            # One factor for all: as in Mitsuba, normals interpolated between vertices are transformed too.
            normals = normals / np.linalg.norm(normals, axis=1).max()
        return replace(self, vertices=vertices, faces=faces, normals=normals)

    def primitives(self, flip):
        faces = self.faces[:, ::-1] if flip else self.faces
        normals = -self.normals if flip and self.normals is not None else self.normals
        own = np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
        entries = {name: faces if name.startswith("vertex_") else own for name in self.attributes}
        carried = {name: np.take(values, entries[name], axis=0) for name, values in self.attributes.items()}

        def at_corners(values):
            return None if values is None else np.take(values, faces, axis=0)

        with over_cores(len(faces)) as run:
            return Facets(*run(at_corners, (self.vertices, normals, self.uv)), carried, entries)


class SerializedMesh(Mesh):
    """One mesh of a file that holds several."""

    @staticmethod
    def choices(fields: Fields) -> dict[str, object]:
        return {"part": fields.integer("shape_index", 0, at_least=0)}


class ArrayMesh(Mesh):
    """A mesh given by arrays in a dictionary."""

    @classmethod
    def read(cls, loader, fields: Fields):
        arrays = {name: fields.array(name) for name in ("vertices", "faces")}
        arrays |= {name: fields.array(name, None) for name in ("normals", "uv", "vertex_color", "face_color")}
        to_world, face_normals = fields.transform("to_world"), fields.boolean("face_normals", False)
        return loader.mesh_of_arrays(fields, to_world=to_world, face_normals=face_normals, **arrays)


def leaf_numbers(vertices):
    """Return the scalars (P, 9) that a leaf stores of vertices (P, 3, 3): x of the three vertices, then y, z."""
    return np.swapaxes(np.asarray(vertices), 1, 2).reshape(-1, 9)


def bounds(vertices):
    """Return the bounds, two (P, 3), of vertices (P, 3, 3)."""
    a, b, c = np.moveaxis(vertices, 1, 0)  # NumPy reduces short axes slowly
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _barycentrics(vertex, edge1, edge2, o, d):
    """Return barycentrics of the point where a ray meets the plane of a triangle, clamped into the triangle."""
    s = o - vertex
    q = cross(s, edge1)
    h = cross(d, edge2)
    scale = safe_divide(1, dot(edge1, h))
    b1 = jnp.clip(dot(s, h) * scale, 0, 1)
    b2 = jnp.clip(dot(d, q) * scale, 0, 1 - b1)
    return 1 - b1 - b2, b1, b2


def _normal(edge1, edge2):
    # Rescale the edges first: the square of a product of tiny ones underflows.
    return normalize(cross(rescale(edge1), rescale(edge2)))


def _point_error(vertices):
    """Return (3,), a bound on the rounding error of a point interpolated from vertices (3, 3) or on a coplanar one."""
    return (3 * np.finfo(vertices.dtype).eps) * jnp.max(jnp.abs(vertices), 0)


def _areas(vertices):
    """Return the areas (P,) of vertices (P, 3, 3)."""
    return np.linalg.norm(np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]), axis=-1) / 2
