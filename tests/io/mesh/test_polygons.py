"""Triangles cover their polygon once, with its winding and uv, and meet the vertices of its neighbours."""

import numpy as np
import pytest

L = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)  # area 3
ARROW = np.array([(0, 0), (2, -1), (0, 2), (-2, -1)], float)  # area 4
# A square with a square hole, cut open: the border runs from corner 0 in, around the hole, and out again.
FRAME = np.array([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], float)  # area 12
STRAIGHT = np.array([(0, 0), (1, 0), (2, 0), (2, 2), (1, 2), (0, 2)], float)  # area 4, corners within edges
KINDS = ["obj", "ply"]


def shoelace(points):
    x, y = points.T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def text(kind, polygons, planes=None):
    """Return a file of polygons (n, 2), whose x and y are also uv, each in a plane given by origin, u and v (3, 3)."""
    planes = planes or [np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], float)] * len(polygons)
    points = np.concatenate([p[0] + polygon @ p[1:] for polygon, p in zip(polygons, planes, strict=True)])
    uv = np.concatenate(polygons)
    ends = np.cumsum([len(polygon) for polygon in polygons])
    index = [np.arange(end - len(polygon), end) for polygon, end in zip(polygons, ends, strict=True)]
    if kind == "obj":
        lines = ["v {!r} {!r} {!r}".format(*p.tolist()) for p in points] + [
            "vt {!r} {!r}".format(*t.tolist()) for t in uv
        ]
        lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in corners) for corners in index]
    else:
        lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
        lines += [f"property double {name}" for name in "xyzuv"]
        lines += [f"element face {len(index)}", "property list uchar int vertex_indices", "end_header"]
        lines += [" ".join(map(repr, [*p.tolist(), *t.tolist()])) for p, t in zip(points, uv, strict=True)]
        lines += [" ".join(map(str, [len(corners), *corners])) for corners in index]
    return "\n".join(lines) + "\n"


def assert_covered(loaded, area_vector, uv_area):
    """Assert that the areas, all facing the same way, add up to the polygon's; likewise those of uv."""
    np.testing.assert_allclose(loaded.area_vectors.sum(axis=0), area_vector, atol=1e-9)
    assert loaded.area == pytest.approx(np.linalg.norm(area_vector), rel=1e-9)
    areas = loaded.uv_areas
    assert (areas > 0).all() if uv_area > 0 else (areas < 0).all()
    assert areas.sum() == pytest.approx(uv_area, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("polygon", "area"), [(L, 3), (ARROW, 4), (FRAME, 12), (STRAIGHT, 4)], ids=["L", "arrow", "frame", "straight"]
)
def test_polygons_are_covered_whatever_their_first_corner_and_winding(load, kind, polygon, area):
    for turned in (polygon, polygon[::-1]):
        for k in range(len(polygon)):
            first = np.roll(turned, k, axis=0)
            sign = 1 if turned is polygon else -1
            loaded = load(kind, text(kind, [first]), flip_tex_coords=False)
            assert_covered(loaded, [0, 0, sign * area], sign * area)
            assert loaded.notes == []


@pytest.mark.parametrize("kind", KINDS)
def test_polygons_in_slanted_planes_far_from_the_origin_are_covered(load, kind):
    rng = np.random.default_rng(1)
    for axis in range(3):
        turn = np.roll(np.linalg.qr(rng.normal(size=(3, 3)))[0], axis, axis=0)
        plane = np.stack([[1000, -2000, 500], turn[0], turn[1]])
        loaded = load(kind, text(kind, [np.roll(L, 2, axis=0)], [plane]), flip_tex_coords=False)
        np.testing.assert_allclose(loaded.area_vectors.sum(axis=0), 3 * np.cross(turn[0], turn[1]), atol=1e-6)
        assert loaded.area == pytest.approx(3, rel=1e-6)
        assert loaded.uv_areas.sum() == pytest.approx(3, rel=1e-9) and (loaded.uv_areas >= 0).all()


def star(rng, n):
    """Return a polygon with corners in order around the origin at random distances; on a grid, for exact sums."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, n)) + np.arange(n)  # spread, or the origin might lie outside
    angle *= 2 * np.pi / (2 * np.pi + n)
    return np.round(rng.uniform(0.2, 1, n)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1) * 4096) / 4096


def test_random_polygons_between_triangles_keep_their_order_and_their_vertices(load):
    rng = np.random.default_rng(7)
    polygons = [star(rng, n) for n in rng.integers(3, 14, 300)]
    loaded = load("obj", text("obj", polygons), flip_tex_coords=False)
    assert loaded.notes == [] and len(loaded.mesh.faces) == sum(len(polygon) - 2 for polygon in polygons)
    assert (loaded.area_vectors[:, 2] > 0).all()
    ends = np.cumsum([len(polygon) - 2 for polygon in polygons])
    areas = np.diff(np.cumsum(loaded.area_vectors[:, 2])[ends - 1], prepend=0)
    np.testing.assert_allclose(areas, [shoelace(polygon) for polygon in polygons], rtol=1e-9)
    assert len(np.unique(loaded.mesh.faces)) == sum(len(polygon) for polygon in polygons)


def test_corners_on_straight_edges_stay_corners(load):
    """So that no ray passes between a polygon and neighbours that have a vertex there."""
    used = load("ply", text("ply", [STRAIGHT])).mesh.faces
    assert set(used.ravel()) == set(range(6))


def test_convex_polygons_are_fans_as_in_mitsuba(load):
    hexagon = np.stack([np.cos(np.arange(6)), np.sin(np.arange(6))], axis=1)
    loaded = load("obj", text("obj", [hexagon]))
    np.testing.assert_array_equal(loaded.mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])


def test_polygons_that_are_not_planar_are_cut_as_their_projection_is(load):
    """Seen along its normal, each triangle of an L with a bent arm faces the same way."""
    bent = np.array([(0, 0, 0), (2, 0, 0.1), (2, 1, -0.1), (1, 1, 0), (1, 2, 0.2), (0, 2, 0)])
    lines = [f"v {x} {y} {z}" for x, y, z in bent] + ["f 2 3 4 5 6 1"]
    loaded = load("obj", "\n".join(lines))
    assert (loaded.area_vectors[:, 2] > 0).all() and loaded.area_vectors[:, 2].sum() == pytest.approx(3)


@pytest.mark.parametrize(
    "polygon",
    [[(0, 0), (1, 1), (1, 0), (0, 1)], [(np.cos(a), np.sin(a)) for a in 0.8 * np.pi * np.arange(5)]],
    ids=["bow tie", "pentagram"],
)
def test_polygons_that_cross_themselves_are_noted_and_leave_others_alone(load, polygon):
    loaded = load("obj", text("obj", [L, np.array(polygon, float), L]))
    assert any("1 polygons cross themselves" in note for note in loaded.notes)
    own = (loaded.mesh.faces >= 6).all(axis=1) & (loaded.mesh.faces < 6 + len(polygon)).all(axis=1)
    assert own.any() and loaded.area_vectors[~own].sum(axis=0) == pytest.approx([0, 0, 6])


def test_polygons_that_cross_themselves_by_a_hair_are_covered_but_for_a_hair(load):
    """As where a hole is cut open by two edges that differ only by the rounding of the text."""
    frame = FRAME.copy()
    frame[4] += 1e-4, -1e-4
    frame[5] -= 1e-4, -1e-4
    loaded = load("obj", text("obj", [frame]))
    assert loaded.area == pytest.approx(12, abs=1e-3)


def test_polygons_without_area_are_degenerate_not_crossing(load):
    loaded = load("obj", text("obj", [L, np.array([(0, 0), (1, 1), (2, 2), (3, 3)], float)]))
    assert loaded.area == pytest.approx(3) and loaded.mesh.dropped == 2
    assert not any("cross" in note for note in loaded.notes)
