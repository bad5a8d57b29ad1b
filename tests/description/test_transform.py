"""`pj.Transform` composes affine maps as Mitsuba's transforms do."""

import numpy as np
import pytest

import pathjax as pj
from pathjax import Transform

POINTS = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [-2.0, 0.5, 1.0]])


def test_what_is_appended_acts_first():
    made = Transform().translate([0, 0, 4]).rotate([0, 0, 1], 90).scale([2, 1, 1])
    np.testing.assert_allclose(made @ [1, 0, 0], [0, 2, 4], atol=1e-15)


def test_composition_is_that_of_the_maps():
    a, b = Transform().rotate([1, 2, 3], 40).scale(2), Transform().translate([1, 2, 3])
    np.testing.assert_allclose((a @ b) @ POINTS, a @ (b @ POINTS), rtol=1e-14)
    np.testing.assert_allclose(a.translate([1, 2, 3]).matrix, (a @ b).matrix)


def test_the_inverse_undoes_it():
    made = Transform().look_at([1, 2, 3], [0, 0, 0], [0, 1, 0]).scale([1, 2, 3])
    np.testing.assert_allclose(made.inverse() @ (made @ POINTS), POINTS, rtol=1e-13, atol=1e-13)


def test_a_camera_looks_along_z_with_y_up():
    made = Transform().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    np.testing.assert_allclose(made @ [0, 0, 1], [0, 0, 3])
    np.testing.assert_allclose(made @ [0, 1, 0], [0, 1, 4])


def test_an_axis_may_have_any_length():
    turned = Transform().rotate([0, 3, 0], 90) @ [1, 0, 0]
    np.testing.assert_allclose(turned, [0, 0, -1], atol=1e-15)


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_vectors_may_be_tiny_or_huge(size):
    turned = Transform().rotate([0, size, 0], 90) @ [1, 0, 0]
    np.testing.assert_allclose(turned, [0, 0, -1], atol=1e-15)
    seen = Transform().look_at([0, 0, size], [0, 0, 0], [0, size, 0])
    np.testing.assert_allclose(seen.matrix[:3, :3], np.diag([-1, 1, -1]), atol=1e-15)


def test_it_does_not_change():
    matrix = np.eye(4)
    made = Transform(matrix)
    matrix[0, 0] = 7
    assert made.matrix[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        made.matrix[0, 0] = 2


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Transform(np.eye(3)), r"finite numbers of shape \(4, 4\)"),
        (lambda: Transform(np.ones((4, 4))), "last row"),
        (lambda: Transform().translate([1, 2]), "three finite numbers"),
        (lambda: Transform().scale("large"), "three finite numbers, not large"),
        (lambda: Transform().scale([1, np.nan, 1]), "three finite numbers"),
        (lambda: Transform().rotate([0, 0, 0], 90), "zero vector"),
        (lambda: Transform().rotate([0, 0, 1], [1, 2, 3]), "one finite number"),
        (lambda: Transform().look_at([0, 0, 0], [0, 0, 0], [0, 1, 0]), "coincide"),
        (lambda: Transform().look_at([0, 0, 0], [0, 1, 0], [0, 2, 0]), "parallel"),
        (lambda: Transform().look_at([0, 0, 0], [0.1, 0.3, 0.7], [1e20, 3e20, 7e20]), "parallel"),
        (lambda: Transform().scale([1, 0, 1]).inverse(), "flattens"),
    ],
)
def test_nonsense_is_refused(make, says):
    with pytest.raises(pj.InputError, match=says):
        make()


def test_it_agrees_with_mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")

    def made(transform):
        return (
            transform.translate([1, 2, 3])
            .rotate([0, 1, 0], 35)
            .scale([1, 2, 3])
            .look_at(origin=[1, 5, 2], target=[0, 1, 0], up=[0, 0, 1])
        )

    np.testing.assert_allclose(made(Transform()).matrix, made(mi.ScalarTransform4f()).matrix, rtol=1e-5, atol=1e-5)
