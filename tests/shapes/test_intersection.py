"""Hits agree with float64 brute force, for every shape and scale, with trees and without."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from pathjax import description as desc
from pathjax.bsdfs import Diffuse
from pathjax.compile import native_map
from pathjax.core.math import normalize, spawn_ray
from pathjax.core.types import Ray
from pathjax.scene import build
from pathjax.sensors import Perspective
from pathjax.sensors.film import HDRFilm
from pathjax.shapes import Cube, Disk, Mesh, Rectangle, Sphere, geometry
from pathjax.shapes.accel.leaves import numbers_of, rows_of
from pathjax.shapes.disk import Disks

GREY = Diffuse.instance("grey")
# Rounding of a coordinate relative to the distances it was computed from; hits closer to a border may go either way.
ROUNDING = 2e-6


@pytest.fixture
def x64():
    context = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
    with context(True):
        yield


def scene_of(*geometries, dtype=jnp.float32, flip=False):
    shapes = tuple(desc.Shape(f"s{i}", g, GREY, None, flip) for i, g in enumerate(geometries))
    camera, film = Perspective(np.eye(4), 45.0), HDRFilm(2, 2)
    about = desc.Description("test", desc.View(camera, film, 1, "independent"), desc.Integrator(), shapes)
    return build(about, dtype).geometry


def mesh(vertices, faces=None):
    vertices = np.reshape(vertices, (-1, 3)).astype(float)
    faces = np.arange(len(vertices)).reshape(-1, 3) if faces is None else np.asarray(faces)
    return Mesh(vertices, faces, None, None)


def sphere(center, radius):
    return Sphere(np.asarray(center, float), float(radius), np.eye(4))


def affine(linear, translation):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = linear, translation
    return m


@jax.jit
def _closest(shapes, *rays):
    return native_map(lambda ray, shapes: geometry.closest_hit(shapes, Ray(*ray)), rays, shapes)


@jax.jit
def _occluded(shapes, *rays):
    *rays, targets = rays
    return native_map(lambda x, shapes: geometry.occluded(shapes, Ray(*x[0]), x[1]), (rays, targets), shapes)


# Rays per call, and least numbers of nodes, leaves, primitives and levels of a tree: with them scenes of one kind share
# a kernel, since compilation takes most of the time.
RAYS, NODES, LEAVES, PRIMITIVES, DEPTH = 4096, 512, 2048, 2048, 8


def longer(x, least):
    """Pad x (N, ...) with unreferenced rows of zeros, up to a power of 2."""
    size = max(least, 1 << (len(x) - 1).bit_length())
    return np.pad(np.asarray(x), [(0, size - len(x)), *[(0, 0)] * (x.ndim - 1)])


def roomy(shapes):
    """Return the same shapes with padded trees, and with padding behind the last primitives."""
    tables = []
    for table in shapes.tables:
        if getattr(table, "tree", None) is not None:
            tree = replace(table.tree, nodes=longer(table.tree.nodes, NODES), depth=max(DEPTH, table.tree.depth))
            table = replace(table, tree=tree, leaves=longer(table.leaves, LEAVES))
        tables.append(table)
    if not tables or not hasattr(tables[-1], "tree") or tables[-1].tree is None:
        return replace(shapes, tables=tuple(tables))
    rows = jax.tree.map(lambda x: longer(x, PRIMITIVES), tables[-1].by_row())
    tables[-1] = replace(tables[-1], **rows)
    first = sum(table.count for table in tables[:-1])
    behind = {name: getattr(shapes, name) for name in ("shape", "light")}
    behind = {name: x if x is None else np.r_[x[:first], longer(x[first:], PRIMITIVES)] for name, x in behind.items()}
    return replace(shapes, tables=tuple(tables), **behind)


def asked(query, shapes, *rays):
    """Return the answer of a query for each ray, as NumPy arrays; the last call is filled up with repeated rays."""
    shapes, count = roomy(shapes), len(rays[0])
    number = np.resize(np.arange(count), -(-count // RAYS) * RAYS).reshape(-1, RAYS)
    parts = [query(shapes, *(jnp.asarray(x[some]) for x in rays)) for some in number]
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


def packed(shapes, o, d, t_max, exclude):
    dtype = f"f{shapes.tables[0].leaves.dtype.itemsize if shapes.tables else 4}"
    t_max, exclude = np.broadcast_to(t_max, len(o)), np.broadcast_to(exclude, len(o))
    return *(np.asarray(x, dtype) for x in (o, d, t_max)), np.asarray(exclude, np.int32)


def closest(shapes, o, d, t_max=np.inf, exclude=-1):
    """Return the hit of each ray, as NumPy arrays."""
    return asked(_closest, shapes, *packed(shapes, o, d, t_max, exclude))


def occluded(shapes, o, d, t_max=np.inf, target=-1):
    targets = np.broadcast_to(np.asarray(target, np.int32), len(o))
    return asked(_occluded, shapes, *packed(shapes, o, d, t_max, -1), targets)


def unit(v, dtype=np.float32):
    v = np.asarray(v, float)
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(dtype)


def random_rays(n, seed=0, reach=1.0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    o = rng.uniform(-reach, reach, (n, 3)).astype(dtype)
    return o, unit(rng.uniform(-reach, reach, (n, 3)) - o, dtype)


# ---- the reference: float64 brute force, which marks where rounding may decide -------------------------------------


class Candidates:
    """(N, P) distances of rays to primitives; inf where missed; `unsure` where the last bits decide."""

    def __init__(self, t, unsure, error):
        self.t, self.unsure, self.error = t, unsure, error


def of_triangles(vertices, o, d, rounding):
    a, b, c = (vertices[None, :, k] for k in range(3))
    o, d = o[:, None], d[:, None]
    e1, e2, s = b - a, c - a, o - a
    normal = np.cross(e1, e2)
    area2 = np.linalg.norm(normal, axis=-1)
    det = -(normal * d).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (normal * s).sum(-1) / det
        m = np.cross(s, d)
        b1, b2 = (e2 * m).sum(-1) / det, -(e1 * m).sum(-1) / det
        b0 = 1 - b1 - b2
        cos = np.abs(det) / area2
        reach = np.max([np.linalg.norm(o - x, axis=-1) for x in (a, b, c)], 0)
        lateral = rounding * reach / np.maximum(cos, 1e-300)
        bary = np.stack([b0, b1, b2])
        edges = np.stack([np.linalg.norm(e, axis=-1) + 0 * t for e in (c - b, e2, e1)])
        width = lateral * edges / area2  # of the border, in barycentrics
        # The distance is a barycentric mean over the vertices; barycentrics of thinner needles are less certain.
        error = lateral + np.minimum(rounding * reach**2 / area2 / cos, 1) * edges.max(0)
        finite, inside = np.isfinite(t), (bary > 0).all(0)
        possible = finite & (bary >= -width).all(0) & (t > -lateral)
        sure = (bary > width).all(0) & (np.abs(t) > lateral)
    return Candidates(np.where(inside & finite & (t > 0), t, np.inf), possible & ~sure, error)


def of_planars(frames, disk, o, d, rounding):
    c, a, b, n = (frames[None, :, k] for k in range(4))
    o, d = o[:, None], d[:, None]
    f = o - c
    cross = np.cross(a, b)
    squared = (cross**2).sum(-1, keepdims=True)
    dual_a, dual_b = np.cross(b, cross) / squared, np.cross(cross, a) / squared
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -(f * n).sum(-1) / (d * n).sum(-1)
        q = f + t[..., None] * d
        x, y = (q * dual_a).sum(-1), (q * dual_b).sum(-1)
        cos = np.abs((d * n).sum(-1))
        reach = np.linalg.norm(f, axis=-1) + np.linalg.norm(a, axis=-1) + np.linalg.norm(b, axis=-1)
        lateral = rounding * reach / np.maximum(cos, 1e-300)
        slack = lateral * (np.linalg.norm(dual_a, axis=-1) + np.linalg.norm(dual_b, axis=-1))
        over = np.hypot(x, y) - 1 if disk else np.maximum(np.abs(x), np.abs(y)) - 1
        finite = np.isfinite(t)
        inside = finite & (over <= 0)
        unsure = finite & (((np.abs(over) <= slack)) | ((over <= slack) & (np.abs(t) <= lateral))) & (t > -lateral)
    return Candidates(np.where(inside & (t > 0), t, np.inf), unsure, lateral)


def of_spheres(balls, o, d, rounding):
    center, radius = balls[None, :, :3], balls[None, :, 3]
    o, d = o[:, None], d[:, None]
    dd = (d * d).sum(-1)  # directions are unit to 1e-7 only
    f = o - center
    b = -(f * d).sum(-1) / dd
    closest = np.linalg.norm(f + b[..., None] * d, axis=-1)
    lateral = rounding * (np.linalg.norm(f, axis=-1) + radius)
    with np.errstate(invalid="ignore"):
        half = np.sqrt((radius**2 - closest**2) / dd)
        near, far = b - half, b + half
        # The error along the ray grows where the ray meets the surface obliquely.
        error = lateral * radius / np.maximum(half, 1e-300)
        t = np.where(near > 0, near, np.where(far > 0, far, np.inf))
        start = (np.abs(near) <= error) | (np.abs(far) <= error)
    t = np.where(np.isnan(half), np.inf, t)
    unsure = ((np.abs(closest - radius) <= lateral) & (b > -radius)) | (~np.isnan(half) & start)
    return Candidates(t, unsure, np.where(np.isnan(half), 0, error))


def reference(shapes, o, d, rounding=ROUNDING):
    """Return candidates of all primitives, by their indices, from the stored values of the scene."""
    o, d = np.asarray(o, np.float64), np.asarray(d, np.float64)
    parts = []
    for table in shapes.tables:
        if hasattr(table, "balls"):
            parts.append(of_spheres(np.asarray(table.balls, np.float64), o, d, rounding))
        elif hasattr(table, "frames"):
            parts.append(of_planars(np.asarray(table.frames, np.float64), isinstance(table, Disks), o, d, rounding))
        else:
            parts.append(of_triangles(np.asarray(table.vertices, np.float64), o, d, rounding))
    return Candidates(*(np.concatenate([getattr(p, k) for p in parts], 1) for k in ("t", "unsure", "error")))


def assert_same_hits(shapes, o, d, rounding=ROUNDING, clear=0.9, exclude=None):
    """Assert that rays agree with brute force where rounding cannot decide, for at least the share `clear` of them."""
    hit = closest(shapes, o, d, exclude=-1 if exclude is None else exclude)
    truth = reference(shapes, o, d, rounding)
    rays = np.arange(len(o))
    if exclude is not None:
        truth.t[rays, exclude], truth.unsure[rays, exclude] = np.inf, False
    first = truth.t.argmin(1)
    t = truth.t[rays, first]
    finite = np.isfinite(t)
    tolerance = np.where(finite, truth.error[rays, first] + 4 * rounding * np.where(finite, t, 0), 0)
    # Rounding decides about no primitive.
    sure = ~truth.unsure.any(1)
    assert sure.mean() >= clear, sure.mean()
    assert not np.isnan(hit.t).any()
    np.testing.assert_array_equal(np.isfinite(hit.t), hit.primitive >= 0)
    wrong = sure & (np.isfinite(hit.t) != finite)
    assert not wrong.any(), f"{wrong.sum()} rays, first {rays[wrong][:5]}, t {t[wrong][:5]} against {hit.t[wrong][:5]}"
    both = sure & finite
    off = both & (np.abs(np.where(both, hit.t, 0) - np.where(both, t, 0)) > tolerance)
    assert not off.any(), f"{off.sum()} rays, first {rays[off][:5]}, t {t[off][:5]} against {hit.t[off][:5]}"
    of_found = truth.t[rays, np.maximum(hit.primitive, 0)]
    other = both & ~(np.abs(np.where(both, of_found - np.where(finite, t, 0), 0)) <= 2 * tolerance)
    assert not other.any(), f"{other.sum()} rays hit other primitives"
    return hit, both


# ---- scenes ---------------------------------------------------------------------------------------------------------


def triangles(n, seed=1, size=0.3):
    rng = np.random.default_rng(seed)
    return mesh(rng.uniform(-1, 1, (n, 1, 3)) + rng.normal(size=(n, 3, 3)) * size)


def planars(kind, n, seed=2, size=0.3):
    rng = np.random.default_rng(seed)
    return [kind(affine(rng.normal(size=(3, 3)) * size, rng.uniform(-1, 1, 3))) for _ in range(n)]


def spheres(n, seed=3, size=0.3):
    rng = np.random.default_rng(seed)
    return [sphere(rng.uniform(-1, 1, 3), rng.uniform(0.05, 1) * size) for _ in range(n)]


SCENES = {
    "one triangle": [mesh([[-0.2, -0.3, 0.1], [1, 0, 0.2], [0, 1, -0.1]])],
    "8 triangles": [triangles(8)],
    "40 triangles": [triangles(40)],
    "400 triangles": [triangles(400, size=0.1)],
    "10 rectangles": planars(Rectangle, 10),
    "100 rectangles": planars(Rectangle, 100, size=0.1),
    "10 disks": planars(Disk, 10),
    "100 disks": planars(Disk, 100, size=0.1),
    "10 spheres": spheres(10),
    "100 spheres": spheres(100, size=0.1),
    "cubes": planars(Cube, 5, size=0.2),
    "100 cubes": planars(Cube, 100, size=0.1),
    "cubes before rectangles": [*planars(Cube, 4, size=0.2), *planars(Rectangle, 5, seed=4)],
    "mixed": [
        triangles(60, size=0.1),
        *planars(Rectangle, 9),
        *planars(Disk, 60, seed=4, size=0.1),
        *spheres(9, size=0.1),
    ],
}


@pytest.mark.parametrize("name", SCENES)
def test_random_rays_hit_as_brute_force_says(name):
    shapes = scene_of(*SCENES[name])
    hit, _ = assert_same_hits(shapes, *random_rays(4000))
    assert 0.01 < (hit.primitive >= 0).mean()
    number = np.asarray(shapes.shape)[np.maximum(hit.primitive, 0)]
    np.testing.assert_array_equal(hit.shape, np.where(hit.primitive >= 0, number, -1))


@pytest.mark.parametrize("name", ["40 triangles", "400 triangles", "mixed"])
def test_rays_along_axes_hit_as_brute_force_says(name):
    shapes = scene_of(*SCENES[name])
    o = random_rays(4000)[0]
    d = np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (667, 1))[:4000].astype(np.float32)
    assert_same_hits(shapes, o, d)


@pytest.mark.parametrize("name", ["40 triangles", "400 triangles", "mixed"])
def test_negative_zeros_in_the_direction_change_nothing(name):
    shapes = scene_of(*SCENES[name])
    o = random_rays(4000)[0]
    d = np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (667, 1))[:4000].astype(np.float32)
    negative = np.where(d == 0, np.float32(-0.0), d)
    np.testing.assert_array_equal(closest(shapes, o, negative).t, closest(shapes, o, d).t)


def grid(n, height=1.0):
    """Return n x n squares of two triangles each over [-1, 1]^2, facing down; their flat boxes share planes."""
    g = np.linspace(-1, 1, n + 1)
    vertices = np.stack(np.meshgrid(g, g, [height], indexing="ij"), -1).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a = i * (n + 1) + j
    return vertices, np.concatenate([np.stack([a, a + n + 1, a + 1], 1), np.stack([a + 1, a + n + 1, a + n + 2], 1)])


@pytest.mark.parametrize("sign", [0.0, -0.0])
@pytest.mark.parametrize("tiles", ["triangles", "rectangles"])
def test_axis_rays_that_start_on_slab_planes_hit(tiles, sign):
    """Origins are exactly over the borders of boxes, where a distance is 0 times infinity."""
    n = 16
    vertices, faces = grid(n)
    if tiles == "triangles":
        shapes = scene_of(mesh(vertices, faces))
    else:
        g = (np.arange(n) + 0.5) / n * 2 - 1
        shapes = scene_of(*(Rectangle(affine(np.diag([1 / n, 1 / n, 1]), [x, y, 1])) for x in g for y in g))
    inner = np.abs(vertices[:, :2]).max(1) < 1
    for z in (0.0, -3.0, 0.5):
        o = vertices[inner] * [1, 1, 0] + [0, 0, z]
        hit = closest(shapes, o, np.broadcast_to([sign, sign, 1.0], o.shape))
        np.testing.assert_allclose(hit.t, 1 - z, rtol=1e-6)


def test_rays_that_start_on_faces_of_boxes_hit_as_brute_force_says():
    """Origins are exactly on the planes of the root's box, with rays in all directions."""
    shapes = scene_of(mesh(*icosphere()))
    o, d = random_rays(1000)
    rays, axis = np.arange(1000), np.arange(1000) % 3
    o[rays, axis] = np.where(rays % 2, 1.0, -1.0)
    hit, _ = assert_same_hits(shapes, o, unit(0.3 * d - o))
    assert (hit.primitive >= 0).mean() > 0.9


def test_needles_and_tiny_triangles_are_hit_as_in_float64():
    rng = np.random.default_rng(5)
    n = 200
    p = rng.uniform(-1, 1, (n, 1, 3))
    tiny = p + rng.normal(size=(n, 3, 3)) * 1e-6
    long, thin = rng.normal(size=(n, 3)) * 0.3, rng.normal(size=(n, 3)) * 1e-5
    needles = p + np.stack([0 * long, long, thin], 1)
    for vertices in (tiny, needles, tiny[:40], needles[:40]):
        shapes = scene_of(mesh(vertices))
        stored = np.asarray(shapes.tables[0].vertices, np.float64)
        weights = rng.dirichlet([2, 2, 2], (20, len(stored)))
        target = (weights[..., None] * stored).sum(-2).reshape(-1, 3)
        # From nearby, so that float32 origins and directions can aim at 1e-6.
        o = np.float32(target + unit(rng.normal(size=target.shape)) * 0.05)
        assert_same_hits(shapes, o, unit(target - o), clear=0.3)
        # Random rays: nothing is hit beside the triangles.
        assert_same_hits(shapes, *random_rays(4000), clear=0.9)


def test_rays_in_the_plane_of_a_triangle_do_not_hit_beside_it():
    rng = np.random.default_rng(6)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    shapes = scene_of(mesh(corner @ rotation.T + 0.1))
    angle = rng.uniform(0, 2 * np.pi, 10_000)
    o = np.stack([rng.uniform(-3, 3, 10_000), rng.uniform(-3, 3, 10_000), 0 * angle], -1) @ rotation.T + 0.1
    d = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) @ rotation.T
    hit = closest(shapes, o, d)
    found = np.isfinite(hit.t)
    p = (o[found] + hit.t[found, None] * d[found] - 0.1) @ rotation
    # An edge-on ray may hit or miss, but a hit must lie on the triangle. All three edge functions are noise here, which
    # rarely passes for a hit.
    beside = (p[:, 0] < -1e-3) | (p[:, 1] < -1e-3) | (p[:, 0] + p[:, 1] > 1.001)
    assert beside.sum() < 0.01 * len(o), f"{beside.sum()} of {len(o)}"


COPIES = [(5, "triangle"), (300, "triangle"), (300, "rectangle"), (5, "disk"), (300, "sphere")]


@pytest.mark.parametrize("copies, name", COPIES)
def test_of_coincident_faces_the_lowest_primitive_is_hit(name, copies):
    one = {
        "triangle": mesh([[-1, -1, 1], [1, -1, 1], [0, 1, 1]]),
        "rectangle": Rectangle(affine(np.eye(3), [0, 0, 1])),
        "disk": Disk(affine(np.eye(3), [0, 0, 1])),
        "sphere": sphere([0, 0, 1], 0.5),
    }[name]
    # Another mesh, so that the copies are spread over several leaves of the tree.
    others = [Mesh(one.vertices + [5, 0, 0], one.faces, None, None)] if name == "triangle" else []
    shapes = scene_of(*[one] * copies, *others)
    rng = np.random.default_rng(7)
    target = np.c_[rng.uniform(-0.2, 0.2, (2000, 2)), np.ones(2000)]
    o = rng.uniform(-1, 0, (2000, 3))
    o[:500] = [0, 0, 0]
    hit = closest(shapes, o, unit(target - np.float32(o)))
    assert (hit.primitive == 0).all(), f"{(hit.primitive != 0).mean():.3f} hit {np.unique(hit.primitive)[:5]}"


def test_of_coincident_kinds_the_lowest_primitive_is_hit():
    flat = affine(np.eye(3), [0, 0, 1])
    shapes = scene_of(mesh([[-9, -9, 1], [9, -9, 1], [0, 9, 1]]), Disk(flat), Rectangle(flat))
    o = np.zeros((1, 3))
    hit = closest(shapes, o, [[0, 0, 1.0]])
    assert hit.primitive == 0 and hit.shape == 2  # the rectangle; order: spheres, rectangles, disks, triangles


def test_layers_close_behind_each_other_are_kept_in_order():
    """Layers 3e-6 apart at distance 1, in a tree: the traversal's sort keys are coarser than float32."""
    rng = np.random.default_rng(8)
    order = rng.permutation(100)
    z = 1 + 3e-6 * order
    corner = np.array([[-1, -1], [1, -1], [0, 1.0]])
    shapes = scene_of(mesh([np.c_[corner, np.full(3, h)] for h in z]))
    target = np.c_[rng.uniform(-0.2, 0.2, (2000, 2)), np.ones(2000)]
    o = np.c_[rng.uniform(-0.5, 0.5, (2000, 2)), np.zeros(2000)]
    hit = closest(shapes, o, unit(target - np.float32(o)))
    assert (hit.primitive == np.argmin(order)).all()


def test_huge_spheres_stay_in_place():
    """The nine-sphere box: walls of radius 1e5 around [-50, 50]^3, with hits exact to the last bits of a radius."""
    walls = [sphere(np.eye(3)[a] * s * (1e5 + 50), 1e5) for a in range(3) for s in (-1, 1)]
    shapes = scene_of(*walls, sphere([20, -30, 10], 16.5), sphere([-20, -30, -10], 16.5))
    o, d = random_rays(4000, reach=45)
    o, d = np.float32(o), unit(np.random.default_rng(1).normal(size=(4000, 3)))
    # The distance to a wall is the difference of numbers of size 1e5.
    assert_same_hits(shapes, o, d, rounding=3e-7, clear=0.9)
    hit = closest(shapes, o, d)
    p = o + hit.t[:, None] * d
    assert np.isfinite(hit.t).all() and np.abs(p).max() < 50.1


@pytest.mark.parametrize("scale, shift", [(1e-3, 0), (1e5, 0), (1, 1e4), (1e5, 1e4)])
def test_scale_and_place_of_the_scene_change_nothing(scale, shift):
    rng = np.random.default_rng(9)
    move = np.array([1.0, -1.0, 1.0]) * shift * scale
    parts = [mesh((triangles(200, size=0.2).vertices.reshape(-1, 3, 3)) * scale + move)]
    for kind in (Rectangle, Disk):
        linear = rng.normal(size=(60, 3, 3)) * 0.1 * scale
        parts += [kind(affine(m, c)) for m, c in zip(linear, rng.uniform(-1, 1, (60, 3)) * scale + move, strict=True)]
    parts += [sphere(rng.uniform(-1, 1, 3) * scale + move, 0.1 * scale) for _ in range(20)]
    shapes = scene_of(*parts)
    o, d = random_rays(2000)
    o = np.float32(o * scale + move)
    # Far from the origin, slabs are only known to the ulps of the coordinates; hits are computed from differences.
    hit, _ = assert_same_hits(shapes, o, d, clear=0.85)
    assert (hit.primitive >= 0).mean() > 0.5


def test_the_excluded_primitive_is_passed_through():
    for name in ("400 triangles", "10 rectangles", "100 disks"):
        shapes = scene_of(*SCENES[name])
        o, d = random_rays(4000)
        first = closest(shapes, o, d)
        found = first.primitive >= 0
        assert_same_hits(shapes, o[found], d[found], exclude=first.primitive[found])


def test_a_ray_leaving_a_sphere_meets_only_its_far_side():
    shapes = scene_of(*spheres(10))
    balls = np.asarray(shapes.tables[0].balls, np.float64)
    n = unit(np.random.default_rng(1).normal(size=(2000, 3)))
    row = np.arange(2000) % 10
    o = np.float32(balls[row, :3] + balls[row, 3:] * n)
    d = unit(np.random.default_rng(2).normal(size=(2000, 3)))
    alone = [closest(scene_of(Sphere(b[:3], b[3], np.eye(4))), o[row == i], d[row == i], exclude=0)
             for i, b in enumerate(balls[:3])]
    for i, hit in enumerate(alone):
        cos = np.sum(n[row == i] * d[row == i], 1)
        inwards = cos < -1e-2
        # The start lies on the sphere only to 1e-7 of the coordinates.
        np.testing.assert_allclose(hit.t[inwards], -2 * balls[i, 3] * cos[inwards], rtol=1e-5, atol=3e-5)
        assert np.isinf(hit.t[cos > 1e-3]).all()


@pytest.mark.parametrize("name", ["400 triangles", "mixed", "10 spheres", "100 rectangles"])
def test_occluded_is_a_closest_hit_before_the_end(name):
    shapes = scene_of(*SCENES[name])
    o, d = random_rays(4000)
    t = closest(shapes, o, d).t
    np.testing.assert_array_equal(occluded(shapes, o, d), np.isfinite(t))
    t_max = np.random.default_rng(1).uniform(0, 2, 4000).astype(np.float32)
    blocked = occluded(shapes, o, d, t_max)
    np.testing.assert_array_equal(blocked, t < t_max)
    assert 0.1 < blocked.mean() < 0.9
    np.testing.assert_array_equal(closest(shapes, o, d, t_max).t, np.where(t <= t_max, t, np.inf))
    # A hit exactly at the end counts for closest_hit only.
    end = np.where(np.isfinite(t), t, np.float32(1))
    assert not occluded(shapes, o, d, end).any()
    np.testing.assert_array_equal(closest(shapes, o, d, end).t, t)


def test_the_target_does_not_shadow_itself():
    shapes = scene_of(*SCENES["mixed"])
    o, d = random_rays(4000)
    hit = closest(shapes, o, d)
    found = hit.primitive >= 0
    past = np.nextafter(hit.t[found], np.float32(np.inf))
    assert not occluded(shapes, o[found], d[found], past, hit.primitive[found]).any()
    assert occluded(shapes, o[found], d[found], past).all()


def test_padded_lanes_are_never_hit():
    for name in ("400 triangles", "100 rectangles"):
        shapes = scene_of(*SCENES[name])
        rows = np.asarray(rows_of(shapes.tables[0].leaves))
        assert (rows < 0).any()
        numbers = numbers_of(shapes.tables[0].leaves[:, :-1], np.float32)
        assert np.isnan(np.moveaxis(np.asarray(numbers), 1, 2)[rows < 0]).all()
        # Through the origin, where zero padding would lie.
        o = unit(np.random.default_rng(1).normal(size=(2000, 3)))
        assert_same_hits(shapes, o, -o, clear=0.5)
        hit = closest(shapes, np.zeros((6, 3)), np.concatenate([np.eye(3), -np.eye(3)]))
        assert not np.isnan(hit.t).any()


def test_empty_scene_has_no_hits():
    rays = np.zeros((5, 3)), np.tile([0, 0, 1.0], (5, 1))
    hit = closest(scene_of(), *rays)
    assert np.isinf(hit.t).all() and (hit.primitive == -1).all() and (hit.shape == -1).all()
    assert not occluded(scene_of(), *rays).any()


@pytest.mark.parametrize("name", ["400 triangles", "mixed"])
def test_float64_hits_to_its_own_precision(name, x64):
    shapes = scene_of(*SCENES[name], dtype=jnp.float64)
    o, d = random_rays(2000, dtype=np.float64)
    assert_same_hits(shapes, o, d, rounding=1e-14, clear=0.999)


def test_float64_keeps_close_layers_in_order(x64):
    rng = np.random.default_rng(8)
    order = rng.permutation(100)
    corner = np.array([[-1, -1], [1, -1], [0, 1.0]])
    shapes = scene_of(mesh([np.c_[corner, np.full(3, h)] for h in 1 + 1e-9 * order]), dtype=jnp.float64)
    target = np.c_[rng.uniform(-0.2, 0.2, (2000, 2)), np.ones(2000)]
    o = np.c_[rng.uniform(-0.5, 0.5, (2000, 2)), np.zeros(2000)]
    hit = closest(shapes, o, unit(target - o, np.float64))
    assert (hit.primitive == np.argmin(order)).all(), f"{(hit.primitive != np.argmin(order)).mean()}"


# ---- watertightness -------------------------------------------------------------------------------------------------


def cube_mesh(n):
    """A closed cube whose faces are n x n squares, so that boxes are flat and share planes."""
    vertices, faces = grid(n)
    both = np.concatenate([vertices, vertices * [1, -1, -1]])
    both_faces = np.concatenate([faces, faces + len(vertices)])
    sides = [np.roll(both, k, axis=1) for k in range(3)]
    faces = np.concatenate([both_faces + k * len(both) for k in range(3)])
    # Weld shared vertices, since a rotation could round copies apart.
    vertices, number = np.unique(np.round(np.concatenate(sides), 9), axis=0, return_inverse=True)
    return vertices, number.reshape(-1)[faces]


def icosphere():
    ball = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


ROTATION = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]
CLOSED = {
    "icosphere": icosphere,
    "cube": lambda: cube_mesh(12),
    "turned cube": lambda: (cube_mesh(12)[0] @ ROTATION.T, cube_mesh(12)[1]),
    "cube of 12 triangles": lambda: cube_mesh(1),
}


def rays_at_edges(vertices, faces, n, seed):
    """Return rays from inside, aimed at vertices and at points of edges as exactly as float32 allows."""
    rng = np.random.default_rng(seed)
    center = vertices.mean(0)
    # Origins are in a ball well inside each of the meshes.
    reach = 0.5 * np.linalg.norm(vertices - center, axis=1).min() * rng.random((n, 1)) ** (1 / 3)
    o = np.float32(center + unit(rng.normal(size=(n, 3))) * reach)
    face, k = faces[rng.integers(len(faces), size=n)], rng.integers(3, size=n)
    a, b = vertices[face[np.arange(n), k]], vertices[face[np.arange(n), (k + 1) % 3]]
    along = np.where(np.arange(n) % 2, rng.random(n), rng.integers(0, 3, n) / 2)[:, None]  # ends and middles too
    return o, unit(a + along * (b - a) - o)


def misses(kind, n, seed, scale=1.0, shift=0.0):
    vertices, faces = CLOSED[kind]()
    vertices = np.float32(vertices * scale + np.array([1, -1, 1]) * shift * scale).astype(float)
    hit = closest(scene_of(mesh(vertices, faces)), *rays_at_edges(vertices, faces, n, seed))
    return int(np.isinf(hit.t).sum())


@pytest.mark.parametrize("kind", CLOSED)
def test_closed_meshes_do_not_leak(kind):
    assert misses(kind, 200_000, seed=1) == 0


@pytest.mark.parametrize("scale, shift", [(1e-3, 0), (1e5, 0), (1, 100), (1, 1e4)])
def test_closed_meshes_do_not_leak_at_any_scale_and_place(scale, shift):
    assert misses("icosphere", 50_000, 2, scale, shift) == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", CLOSED)
def test_closed_meshes_do_not_leak_in_ten_million_rays(kind):
    assert sum(misses(kind, 2_500_000, seed) for seed in range(10, 14)) == 0


def test_a_box_of_rectangles_does_not_leak():
    for parts in ([Cube(affine(ROTATION, [0.1, 0.2, 0.3]))], planes_of_box(5)):
        vertices, faces = cube_mesh(5)
        vertices = vertices if len(parts) > 1 else vertices @ ROTATION.T + [0.1, 0.2, 0.3]
        hit = closest(scene_of(*parts), *rays_at_edges(vertices, faces, 100_000, 3))
        assert np.isfinite(hit.t).all()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("sign", [-1, 1])
def test_rays_in_the_plane_of_a_face_hit_the_cube_where_they_meet_that_face(axis, side, sign):
    """Where a ray lies in the border of a slab, one distance is 0 / 0, and the other slabs alone decide."""
    o = np.roll([[side, -5, -5], [side, -5, -5], [side, -5, 0]], axis, axis=1) * 1.0
    d = np.roll([[0, 0.8, 0.2], [0, 0.2, 0.8], [0, 1, 0]], axis, axis=1) * 1.0
    o, d = (np.where(np.arange(3) == axis, x, sign * x) for x in (o, d))
    d[:, axis] = np.copysign(0.0, sign)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    hit = closest(scene_of(Cube(np.eye(4))), np.float32(o), np.float32(d))
    np.testing.assert_allclose(hit.t, [np.inf, np.inf, 4], rtol=1e-6)


def planes_of_box(n):
    """150 rectangles: enough for a tree."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    flat = [affine(np.diag([1 / n, 1 / n, 1]), [x, y, z]) for x in g for y in g for z in (-1, 1)]
    turn = np.eye(4)[[1, 2, 0, 3]]
    return [Rectangle(np.linalg.matrix_power(turn, k) @ m) for m in flat for k in range(3)]


# ---- surfaces -------------------------------------------------------------------------------------------------------


@jax.jit
def _surfaces(shapes, o, d):
    def one(o, d):
        ray = Ray(o, d, jnp.full_like(o[0], jnp.inf), jnp.int32(-1))
        hit = geometry.closest_hit(shapes, ray)
        return hit, geometry.surface(shapes, ray, hit)

    return jax.vmap(one)(o, d)


@pytest.mark.parametrize("scale, shift", [(1, 0), (1e-3, 0), (1e5, 0), (1, 1e4)])
def test_surface_points_lie_on_their_primitive_within_rounding(scale, shift):
    move = np.array([1.0, -1.0, 1.0]) * shift * scale
    rng = np.random.default_rng(9)
    frames = [affine(rng.normal(size=(3, 3)) * 0.3 * scale, rng.uniform(-1, 1, 3) * scale + move) for _ in range(10)]
    parts = [mesh(triangles(20).vertices * scale + move), *map(Rectangle, frames)]
    shapes = scene_of(*parts)
    o, d = random_rays(4000)
    o = np.float32(o * scale + move)
    hit, s = jax.tree.map(np.asarray, _surfaces(shapes, o, d))
    ok = hit.primitive >= 0
    rectangle = hit.primitive < 10
    frame, tri = np.asarray(shapes.tables[0].frames, float), np.asarray(shapes.tables[1].vertices, float)
    of_frame, of_tri = np.minimum(hit.primitive, 9), np.maximum(hit.primitive - 10, 0)
    corner = np.where(rectangle[:, None], frame[of_frame, 0], tri[of_tri, 0])
    normal = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    a, b = frame[:, 1], frame[:, 2]
    exact = np.cross(a, b) / np.linalg.norm(np.cross(a, b), axis=1, keepdims=True)
    n = np.where(rectangle[:, None], exact[of_frame], normal[of_tri])
    off = np.abs(np.sum((s.p - corner) * n, 1))
    # Rectangles have no margin; their points are sums of three rounded terms.
    reach = np.sum(np.abs(frame).sum(1)[of_frame] * np.abs(n), 1)
    bound = np.where(rectangle, 4 * np.finfo(np.float32).eps * reach, s.margin)
    assert (off[ok] <= bound[ok]).all(), np.max(off[ok] / bound[ok])
    np.testing.assert_allclose(np.abs(np.sum(s.n * n, 1))[ok], 1, atol=1e-6)
    # Points are also near o + t d; edge-on, both are uncertain along the ray.
    clear = ok & (np.abs(np.sum(n * d, 1)) > 0.05)
    np.testing.assert_allclose(s.p[clear], (o + hit.t[:, None] * d)[clear], atol=2e-5 * scale + 3e-7 * shift * scale)


def test_tiny_triangles_have_a_unit_normal():
    """Sides of 1e-9 in a scene of 1e-3, some of thin triangles: their squared cross product underflows."""
    rng = np.random.default_rng(4)
    side = rng.normal(size=(30, 3, 3)) * 1e-9
    side[:10, 2] = side[:10, 1] * 0.5 + rng.normal(size=(10, 3)) * 1e-12
    shapes = scene_of(mesh(side))

    def normal(row):
        hit = Ray(jnp.array([0, 0, 1e-3]), jnp.array([0, 0, -1.0]), jnp.float32(1), jnp.int32(-1))
        return shapes.tables[0].surface(row, hit.o, hit.d, jnp.float32(1e-3)).n

    n = jax.jit(jax.vmap(normal))(jnp.arange(30))
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-5)


def test_sphere_uv_and_normal():
    shapes = scene_of(sphere([1, 2, 3], 2.0))
    n = unit(np.random.default_rng(1).normal(size=(2000, 3)))
    hit, s = jax.tree.map(np.asarray, _surfaces(shapes, np.float32(np.array([1, 2, 3]) + 5 * n), -n))
    np.testing.assert_allclose(hit.t, 3, rtol=1e-5)
    np.testing.assert_allclose(s.n, n, atol=1e-6)
    np.testing.assert_allclose(s.uv[:, 0], np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) % 1, atol=1e-5)
    np.testing.assert_allclose(s.uv[:, 1], np.arccos(n[:, 2]) / np.pi, atol=1e-5)


FLAT = affine(np.eye(3), [0, 0, 0])
DOWN = [0, 0, -1]
SPECIAL_RAYS = {
    "sphere": (sphere([0, 0, 0], 1), [([0, 0, 3], DOWN), ([1, 0, 3], DOWN), ([0, 0, -1], [1, 0, 0])]),  # poles, tangent
    "disk": (Disk(FLAT), [([0, 0, 3], DOWN), ([1, 0, 3], DOWN), ([3, 0, 0], [-1, 0, 0])]),  # centre, rim, edge-on
    "rectangle": (Rectangle(FLAT), [([0.3, 0.2, 3], DOWN), ([1, 1, 3], DOWN), ([3, 0, 0], [-1, 0, 0])]),
    "triangle": (mesh(np.tril(np.ones((3, 3)), -1)), [([0, 0, 3], DOWN), ([1, 0.5, 3], DOWN), ([3, 0, 0], [-1, 0, 0])]),
}


@pytest.mark.parametrize("kind", SPECIAL_RAYS)
def test_surface_derivatives_are_finite(kind):
    geo, rays = SPECIAL_RAYS[kind]
    table = scene_of(geo).tables[0]

    def at(o, d):
        s = table.surface(0, o, d, jnp.float32(3.0))
        return s.p, s.n, s.uv

    o, d = (jnp.asarray(x, jnp.float32) for x in zip(*rays, strict=True))
    everything = jax.jit(jax.vmap(lambda o, d: (at(o, d), jax.jacfwd(at, (0, 1))(o, d), jax.jacrev(at, (0, 1))(o, d))))
    for leaf in jax.tree.leaves(everything(o, d)):
        bad = ~np.isfinite(np.asarray(leaf)).reshape(len(rays), -1).all(1)
        assert not bad.any(), [ray for ray, b in zip(rays, bad, strict=True) if b]


@jax.jit
def _bounce(shapes, *rays):
    def one(ray, shapes):
        o, d, wish = ray
        ray = Ray(o, d, jnp.full_like(o[0], jnp.inf), jnp.int32(-1))
        hit = geometry.closest_hit(shapes, ray)
        s = geometry.surface(shapes, ray, hit)
        inwards = normalize(wish - 1.0014 * s.n)  # normals of the mesh point outwards
        return hit.t, geometry.closest_hit(shapes, spawn_ray(s, inwards, hit.primitive)).t

    return native_map(one, rays, shapes)


def test_spawned_rays_stay_inside_a_closed_mesh():
    """From edges of the wall, inwards, down to 3 degrees above it: nothing leaks out through the neighbour."""
    vertices, faces = icosphere()
    for scale, shift in ((1.0, 0.0), (1.0, 1e4), (1e5, 0.0)):
        moved = np.float32(vertices * scale + shift * scale).astype(float)
        o, d = rays_at_edges(moved, faces, 200_000, 5)
        wish = unit(np.random.default_rng(6).normal(size=d.shape))
        first, second = asked(_bounce, scene_of(mesh(moved, faces)), o, d, np.float32(wish))
        assert np.isfinite(first).all() and np.isfinite(second).all(), (scale, shift, np.isinf(second).sum())


def test_sheets_thinner_than_the_spawn_offset_are_not_skipped():
    # Four ulps apart, so that distances tell the sheets apart.
    shapes = scene_of(*(Rectangle(affine(np.eye(3), [0, 0, z])) for z in (1 + 2**-21, 1)))
    o, d = random_rays(1000)
    o[:, 2], d[:, 2] = 3, -1 - np.abs(d[:, 2])
    o[:, :2] *= 0.3
    d = unit(d * [0.1, 0.1, 1])

    def pass_through(o, d):
        ray = Ray(o, d, jnp.float32(jnp.inf), jnp.int32(-1))
        hit = geometry.closest_hit(shapes, ray)
        behind = geometry.closest_hit(shapes, spawn_ray(geometry.surface(shapes, ray, hit), d, hit.primitive))
        return hit.primitive, behind.primitive

    first, second = (np.asarray(x) for x in jax.jit(jax.vmap(pass_through))(o, d))
    assert (first == 0).all() and (second == 1).all()
