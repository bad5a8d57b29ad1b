"""Form factors against closed forms and between methods, and their errors."""

import numpy as np
import pytest
from scipy import stats

from pathjax import transport

ROOT2 = np.sqrt(2)
# Howell, "A catalog of radiation heat transfer configuration factors", C-11 and C-14, for unit squares.
FACING = 2 / np.pi * (np.log(2 / np.sqrt(3)) + 2 * ROOT2 * np.arctan(1 / ROOT2) - 2 * np.arctan(1))
ADJACENT = (2 * np.arctan(1) - ROOT2 * np.arctan(1 / ROOT2) + np.log(3 / 4) / 4) / np.pi
GREY = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
INSIDE = '<boolean name="flip_normals" value="true"/>'


def shape(kind, inside=""):
    return f'<shape type="{kind}">{inside}{GREY}</shape>'


def placed(*steps):
    return f'<transform name="to_world">{"".join(steps)}</transform>'


def plates(gap=2, between=""):
    """Return two squares of side 2 that face each other along the z axis."""
    return (
        shape("rectangle")
        + shape("rectangle", placed('<rotate x="1" angle="180"/>', f'<translate z="{gap}"/>'))
        + between
    )


def between_shapes(op):
    """Return (P, P) form factors between whole primitives, float64."""
    F, area = np.asarray(op.F.as_matrix(), float), np.asarray(op.area, float)
    primitive = np.asarray(op.patches.primitive)[np.asarray(op.patches.cell)]
    of = np.equal.outer(np.arange(primitive.max() + 1), primitive).astype(float)
    return of * area @ F @ of.T / (of @ area)[:, None]


@pytest.mark.parametrize("side", [1, 2, 5])
def test_facing_plates(make_scene, side):
    op = transport.operator(make_scene(plates()), 2 * side**2, method="dense")
    assert op.patches.count == 2 * side**2
    np.testing.assert_allclose(between_shapes(op), [[0, FACING], [FACING, 0]], rtol=1e-5)


@pytest.mark.parametrize("side", [1, 2, 5])
def test_faces_of_a_cube(make_scene, side):
    """Patches that touch are the hard ones."""
    F = between_shapes(transport.operator(make_scene(shape("cube", INSIDE)), 6 * side**2, method="dense"))
    np.testing.assert_allclose(np.sort(F), np.tile([0, FACING, *[ADJACENT] * 4], (6, 1)), rtol=1e-5)


def test_triangles_and_a_turned_scene(make_scene, tmp_path):
    """A box of 12 triangles, cut into some 48 patches, with sides 1 : 2 : 3 and turned, against its rectangles."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    lines = ["v {} {} {}".format(*v) for v in corners] + ["f {} {} {}".format(*(i + 1 for i in f)) for f in faces]
    (tmp_path / "cube.obj").write_text("\n".join(lines))
    where = placed('<scale x="1" y="2" z="3"/>', '<rotate x="0.6" y="0.8" angle="70"/>', '<translate x="5"/>')
    flat = f'<string name="filename" value="{tmp_path}/cube.obj"/><boolean name="face_normals" value="true"/>'
    meshed = transport.operator(make_scene(shape("obj", flat + INSIDE + where)), 48, method="dense")
    boxed = transport.operator(make_scene(shape("cube", INSIDE + where)), 24, method="dense")
    primitive = np.asarray(meshed.patches.primitive)[np.asarray(meshed.patches.cell)]
    assert (np.bincount(primitive) > 1).any()

    def by_area(op, face):
        """Return the exchange between faces, sorted."""
        exchange = between_shapes(op) * np.bincount(primitive_of(op), np.asarray(op.area))[:, None]
        return np.sort(np.add.reduceat(np.add.reduceat(exchange, face, 0), face, 1).ravel())

    def primitive_of(op):
        return np.asarray(op.patches.primitive)[np.asarray(op.patches.cell)]

    np.testing.assert_allclose(
        by_area(meshed, range(0, 12, 2)), by_area(boxed, range(6)), rtol=2e-4, atol=1e-5 * float(boxed.area.sum())
    )
    np.testing.assert_allclose(np.asarray(meshed.F.as_matrix()).sum(1), 1, rtol=1e-6)


def test_a_patch_that_another_one_cuts_is_seen_in_part(make_scene):
    """A floor sees the upper half of a wall that goes through it: the adjacent square of the closed form."""
    wall = shape("rectangle", placed('<scale x="1" y="2" z="1"/>', '<rotate x="1" angle="90"/>', '<translate y="1"/>'))
    op = transport.operator(make_scene(shape("rectangle") + wall), 3, method="dense")
    F, area = np.asarray(op.F.as_matrix()), np.asarray(op.area)
    assert (area[:1] @ F[:1, 1:]).sum() / 4 == pytest.approx(ADJACENT, rel=1e-5)


def test_inside_of_a_sphere(shipped):
    op = transport.operator(shipped("furnace", shape="sphere", res=16), 100)
    area = np.asarray(op.area)
    np.testing.assert_allclose(op.F.as_matrix(), np.broadcast_to(area / (4 * np.pi), (len(area),) * 2), rtol=1e-6)


# ---- occlusion ---------------------------------------------------------------------------------------------------


def test_a_plate_hides_what_is_behind_it(make_scene):
    screen = shape("rectangle", placed('<scale value="2"/>', '<translate z="1"/>'))
    op = transport.operator(make_scene(plates(between=screen)), 36, method="dense", rays=16)
    F = between_shapes(op)
    assert F[0, 1] == F[1, 0] == 0
    # The screen's front faces the upper plate; its back is black.
    assert F[2, 1] > 0 and F[2, 0] == F[0, 2] == 0
    assert np.asarray(op.factors.errors)[0].max() > 0  # 16 rays leave an error


@pytest.mark.parametrize("boxes", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_dense_and_ray_cast_form_factors_agree_within_their_errors(shipped, empty_cornell, boxes):
    """For all pairs that 20 rays or more should join, and for the light that each patch receives."""
    scene = shipped("cornell_box", res=16) if boxes else empty_cornell(res=16)
    rays = 2048
    dense = transport.operator(scene, 150, method="dense", rays=128)
    cast = transport.operator(scene, 150, method="rays", rays=rays)
    F, G = (np.asarray(op.F.as_matrix(), float) for op in (dense, cast))
    area = np.asarray(dense.area, float)
    density = rays / 2 * (1 / area + 1 / area.mean())
    expected = F * area[:, None] * (density[:, None] + density)
    pairs = expected > 20
    # Poisson error of the expected count; that of the observed count is too small where by chance few rays hit.
    errors = np.hypot(F[pairs] / np.sqrt(expected[pairs]), np.asarray(dense.factors.errors)[pairs])
    light = np.random.default_rng(1).uniform(size=dense.Le.shape).astype(np.float32)
    of_light = (np.asarray(op.T.mv(light)) for op in (dense, cast))
    for difference, error in (
        ((F - G)[pairs], errors),
        (np.subtract(*of_light), np.hypot(dense.error(light), cast.error(light))),
    ):
        difference, error = difference[error > 0], error[error > 0]
        z = difference / error
        assert np.abs(z).max() < -stats.norm.ppf(1e-4 / z.size / 2)
        assert np.mean(z**2) < 1.1
