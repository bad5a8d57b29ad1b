"""Coincident surfaces: no light is lost between them, and the visible one is the same as with a small gap.

With bsdf sampling, a surface of reflectance 1/2 under an unoccluded sky of radiance 1 has exactly the radiance 1/2.
"""

import numpy as np
import pytest

import pathjax as pj
from pathjax import description as desc
from pathjax.bsdfs import Diffuse
from pathjax.scene import build
from pathjax.sensors import Perspective
from pathjax.sensors.film import HDRFilm
from pathjax.shapes import Rectangle, coincident
from pathjax.shapes.coincident import Faces, close_pairs, contacts
from pathjax.system import cores

SKY = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
GREY = '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></bsdf>'
GLASS = '<bsdf type="dielectric"/>'
LAMP = '<bsdf type="diffuse"/><emitter type="area"><rgb name="radiance" value="10"/></emitter>'


def shape(kind, transform="", inside=GREY):
    return f'<shape type="{kind}"><transform name="to_world">{transform}</transform>{inside}</shape>'


def turned(angle):
    return f'<rotate x="1" angle="{angle}"/>'


@pytest.fixture
def obj(tmp_path):
    """(vertices, faces, inside) -> content of a <shape type="obj"> with flat faces."""
    numbers = iter(range(100))

    def write(vertices, faces, inside=GREY):
        path = tmp_path / f"{next(numbers)}.obj"
        lines = ["v {!r} {!r} {!r}".format(*map(float, v)) for v in vertices]
        path.write_text("\n".join(lines + ["f " + " ".join(str(i + 1) for i in face) for face in faces]))
        flat = '<boolean name="face_normals" value="true"/>'
        return f'<string name="filename" value="{path}"/>{flat}{inside}'

    return write


SQUARE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
HALVES = [[0, 1, 2], [0, 2, 3]]
CUBE = [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
SIDES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]


def assert_half_everywhere(scene):
    np.testing.assert_allclose(np.asarray(pj.render(scene, 16, 1)), 0.5, rtol=1e-6)


ANGLES = [1, 10, 45, 90]
SMALL = '<scale value="0.5"/><rotate z="1" angle="30"/>'
LARGE = '<scale value="30"/>'
PAIRS = {
    "a rectangle twice": (("rectangle", ""), ("rectangle", "")),
    "a disk twice": (("disk", ""), ("disk", "")),
    "a cube twice": (("cube", ""), ("cube", "")),
    "a small rectangle in a large one": (("rectangle", SMALL), ("rectangle", LARGE)),
    "a disk in a rectangle": (("disk", SMALL), ("rectangle", LARGE)),
    "a rectangle in a mesh": (("rectangle", ""), ("obj", LARGE)),
    "a mesh in a rectangle": (("obj", ""), ("rectangle", LARGE)),
    "a small mesh in a large one": (("obj", ""), ("obj", LARGE)),
    "a cube on a rectangle, from below": (("cube", '<translate z="-1"/>'), ("rectangle", LARGE)),
}


@pytest.fixture
def among_others(obj):
    """(pair, steps) -> the shapes of the pair, moved by these steps, and others far below, out of view.

    There are four of each kind, at least two of which coincide, so all pairs share one structure and one kernel.
    """
    square = obj(SQUARE, HALVES)

    def body(pair, steps):
        hidden = '<scale value="0.01"/><translate z="-20"/>'
        kinds = ("rectangle", "disk", "cube", "obj")
        others = [(kind, hidden) for kind in kinds for _ in range(4 - sum(kind == k for k, _ in PAIRS[pair]))]
        return "".join(
            shape(kind, transform + steps, square if kind == "obj" else GREY)
            for kind, transform in (*PAIRS[pair], *others)
        )

    return body


@pytest.mark.parametrize("pair", PAIRS)
def test_coplanar_shapes_swallow_no_light(make_scene, among_others, pair):
    for angle in ANGLES:
        body = among_others(pair, turned(angle))
        above = f"0, {float(-5 * np.sin(np.radians(angle)))}, {float(5 * np.cos(np.radians(angle)))}"
        scene = make_scene(body + SKY, origin=above, up="1, 0, 0", fov=10, depth=2, res=8)
        assert_half_everywhere(scene)


@pytest.mark.parametrize("scale, shift", [(1e-3, 0), (1e5, 0), (1, 1e4), (1e5, 1e3)])
@pytest.mark.parametrize("pair", ["a rectangle twice", "a cube twice", "a small mesh in a large one"])
def test_coplanar_shapes_swallow_no_light_at_any_scale_and_place(make_scene, among_others, pair, scale, shift):
    move = f'<scale value="{scale!r}"/><translate x="{scale * shift!r}" y="{-scale * shift!r}" z="{scale * shift!r}"/>'
    origin, target = (
        ", ".join(repr(scale * float(c + s * shift)) for c, s in zip(p, (1, -1, 1), strict=True))
        for p in ((0, -5 * np.sin(np.radians(10)), 5 * np.cos(np.radians(10))), (0, 0, 0))
    )
    scene = make_scene(
        among_others(pair, turned(10) + move) + SKY, origin=origin, target=target, up="1, 0, 0", fov=10, depth=2, res=8,
        near=0.01 * scale, far=100 * scale,
    )  # fmt: skip
    assert_half_everywhere(scene)


@pytest.mark.parametrize("transform", ["", '<translate x="0.1" y="0.3" z="0.7"/>'])
def test_a_sphere_twice_swallows_no_light(make_scene, transform):
    assert_half_everywhere(make_scene(shape("sphere", transform) * 2 + SKY, fov=10, depth=2, res=8))


@pytest.mark.parametrize("z", [0, 0.01, 0.1, 1])
def test_faces_that_a_mesh_holds_twice_swallow_no_light(make_scene, obj, z):
    """With opposite winding, as modellers write faces that are visible from both sides."""
    doubled = obj(np.add(SQUARE, [0, 0, z]), HALVES + [face[::-1] for face in HALVES])
    assert_half_everywhere(make_scene(shape("obj", "", doubled) + SKY, fov=20, depth=2, res=8))


@pytest.mark.parametrize("height", [0, -0.01, -1, -20])
@pytest.mark.parametrize("distance", [1e3, 1e4, 1e5])
def test_rays_from_an_edge_are_not_stopped_by_the_neighbour(make_scene, obj, distance, height):
    """The edge is the diagonal of a square or the ridge of a roof: two triangles in planes through the origin."""
    ends = [[-50, -50, 0], [50, -50, height], [50, 50, 0], [-50, 50, height]]
    k = distance / 3**0.5
    fov = float(np.degrees(2 * np.arctan(0.004 * 8 / 2 / distance)))
    scene = make_scene(
        shape("obj", "", obj(ends, HALVES)) + SKY,
        origin=f"{k}, {k}, {k}", up="0, 0, 1", fov=fov, depth=2, res=8, far=1e9,
    )  # fmt: skip
    assert_half_everywhere(scene)


# ---- order ----------------------------------------------------------------------------------------------------------

TILTED = '<rotate x="0.8" y="0.6" angle="37"/>'
KINDS = ["rectangle", "obj"]


@pytest.mark.parametrize("tilt", ["", TILTED])
@pytest.mark.parametrize("wall", KINDS)
@pytest.mark.parametrize("lamp", KINDS)
def test_a_lamp_in_the_plane_of_a_wall_shines_as_one_before_it(make_scene, obj, lamp, wall, tilt):
    """Also where the wall comes first in the file; a gap of 1e-3 itself changes the image by 3e-3.

    The kinds that wall and lamp do not have stand dark behind the wall, so all cases share a kernel.
    """

    def image(gap):
        square = {"rectangle": lambda inside: inside, "obj": lambda inside: obj(SQUARE, HALVES, inside)}
        dark, behind = LAMP.replace('"10"', '"0"'), '<scale value="0.1"/><translate z="-20"/>'
        others = [(kind, inside) for kind in KINDS for inside in (GREY, dark)]
        others.remove((wall, GREY))
        others.remove((lamp, dark))
        scene = make_scene(
            shape(wall, '<scale value="3"/>' + tilt, square[wall](GREY))
            + shape(lamp, f'<scale value="0.3"/><translate z="{gap}"/>' + tilt, square[lamp](LAMP))
            + "".join(shape(kind, behind + tilt, square[kind](inside)) for kind, inside in others)
            + shape("rectangle", '<scale value="3"/><rotate y="1" angle="180"/><translate z="2"/>' + tilt),
            origin="0.3, 0.2, 1", up="0, 1, 0.1", fov=100, depth=4, res=16,
        )  # fmt: skip
        return np.asarray(pj.render(scene, 64, 1))

    touching, apart = image(0), image(1e-3)
    np.testing.assert_allclose(touching.mean(), apart.mean(), rtol=0.01)


@pytest.mark.parametrize("tilt", ["", TILTED])
@pytest.mark.parametrize(
    "glass, below", [("cube", "rectangle"), ("obj", "rectangle"), ("obj", "obj"), ("cube", "cube")]
)
def test_between_glass_and_what_it_touches_there_is_air(make_scene, obj, glass, below, tilt):
    tops = {"cube": GLASS, "obj": obj(CUBE, SIDES, GLASS)}
    bottoms = {"rectangle": GREY, "obj": obj(SQUARE, HALVES), "cube": GLASS}
    hidden = '<scale value="0.1"/><translate z="-20"/>'  # behind everything, so that all cases share a kernel
    others = [(kind, tops[kind]) for kind in tops if kind != glass]
    others += [(kind, bottoms[kind]) for kind in bottoms if kind != below]

    def image(gap):
        place = '<translate z="-1"/>' if below == "cube" else '<scale value="3"/>'
        scene = make_scene(
            shape(glass, f'<translate z="{1 + gap}"/>' + tilt, tops[glass]) + shape(below, place + tilt, bottoms[below])
            + "".join(shape(kind, hidden + tilt, inside) for kind, inside in others)
            + shape("rectangle", '<scale value="9"/><translate z="-5"/>' + tilt) + SKY,
            origin="1, -1, 6", fov=25, depth=20, res=16,
        )  # fmt: skip
        return np.asarray(pj.render(scene, 64, 1))

    np.testing.assert_allclose(image(0).mean(), image(1e-4).mean(), rtol=0.01)


# ---- what is left alone ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", ["", '<rotate x="0.8" y="0.6" angle="10"/>', TILTED])
def test_a_slab_that_is_a_mesh_has_both_its_faces_at_a_millionth_of_its_size(make_scene, obj, tilt):
    """This is above the rounding bound of distances; see `test_hard_cases` for cubes, which may be thinner."""
    lamp = shape("rectangle", '<scale value="5"/><translate z="-6"/>', LAMP)

    def image(thickness):
        slab = shape("obj", f'<scale x="1" y="1" z="{thickness / 2}"/>' + tilt, obj(CUBE, SIDES, GLASS))
        return np.asarray(pj.render(make_scene(slab + lamp, fov=0.2, depth=1000, res=8), 64, 1))

    np.testing.assert_allclose(image(1e-6), image(1e-2), rtol=1e-3)


def tables_of(*geometries, dtype=np.float32):
    grey = Diffuse.instance("grey")
    shapes = tuple(desc.Shape(f"s{i}", g, grey, None, False) for i, g in enumerate(geometries))
    camera, film = Perspective(np.eye(4), 45.0), HDRFilm(2, 2)
    description = desc.Description("test", desc.View(camera, film, 1, "independent"), desc.Integrator(), shapes)
    return build(description, dtype).geometry.tables


def rectangle(z=0.0, x=0.0):
    to_world = np.eye(4)
    to_world[:3, 3] = x, 0, z
    return Rectangle(to_world)


def test_scenes_in_which_nothing_coincides_hold_nothing_for_it(shipped):
    for name in ("furnace", "glass_and_mirror", "mesh", "nine_spheres", "triangle_box"):
        assert all(table.margins is None for table in shipped(name, res=16).geometry.tables)


@pytest.mark.parametrize(
    "second, touches",
    [
        (rectangle(1), True),
        (rectangle(1 + 1e-12), True),  # as transforms round
        (rectangle(1 + 2**-21), False),  # four ulps apart: a separate sheet
        (rectangle(1, x=2), True),  # side by side, they share an edge
        (rectangle(1, x=2.1), False),
    ],
)
def test_rectangles_touch_if_they_overlap_in_one_plane(second, touches):
    (table,) = tables_of(rectangle(1), second)
    assert (table.margins is not None) == touches


def test_copies_get_a_margin_wherever_they_stand_among_thousands():
    rng = np.random.default_rng(0)
    apart = [rectangle(z, x) for z, x in zip(rng.permutation(3000), rng.uniform(-5, 5, 3000), strict=True)]
    (table,) = tables_of(*apart, apart[123])
    assert np.flatnonzero(np.asarray(table.margins)).tolist() == [123, 3000]


@pytest.mark.parametrize("planes", [1, 70])
def test_of_a_large_mesh_the_triangles_in_a_plane_are_found(planes, monkeypatch):
    """Hills around a level field with a rectangle on it, all rotated; other rectangles cut through them."""
    rng = np.random.default_rng(planes)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    side = int(np.sqrt(cores.SMALL / 2)) + 2
    x, y = np.mgrid[:side, :side] - side / 2
    height = np.maximum(0, np.hypot(x, y) - side / 4) * rng.uniform(0.1, 1, x.shape)
    at = np.stack([x, y, height], -1)
    a, b, c, d = (v.reshape(-1, 3) for v in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    assert len(triangles) >= cores.SMALL
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 6
    level = (triangles[:, :, 2] == 0).all(1)
    under = level & (triangles.min(1) <= side / 6)[:, :2].all(1) & (triangles.max(1) >= -side / 6)[:, :2].all(1)
    through = [square @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T + 0.3 for _ in range(planes)]
    corners = np.stack([square, *through]) @ turn.T
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sheets = Faces(corners, normals, np.full(len(corners), np.inf), False, False)
    found = []
    for most in (coincident.MOST_PLANES, 0):
        monkeypatch.setattr(coincident, "MOST_PLANES", most)
        _, margins = contacts([Faces(triangles @ turn.T, None, None, False, False), sheets], np.float32)
        found.append(margins)
    (mesh, flat), others = found
    assert np.array_equal(mesh, others[0]) and np.array_equal(flat, others[1])
    assert under.sum() > 1000 and (mesh[under] > 0).all() and not mesh[~level].any()
    assert (flat > 0).tolist() == [True] + [False] * planes


@pytest.mark.parametrize("count, distance", [(0, 1), (1, 1), (2, 0), (300, 1e-9), (300, 0.2)])
def test_close_pairs_are_those_of_all_pairs(count, distance):
    """For points on a lattice, some of which coincide exactly or nearly."""
    generator = np.random.default_rng(1)
    points = generator.integers(0, 4, (count, 3)) + generator.choice([0, 1e-10, 0.1], (count, 1))
    between = np.linalg.norm(points[:, None] - points, axis=-1)
    expected = {tuple(pair) for pair in np.argwhere(np.triu(between <= distance, 1))}
    found = [tuple(sorted(pair)) for pair in close_pairs(points, distance).tolist()]
    assert len(found) == len(set(found))
    assert set(found) == expected
