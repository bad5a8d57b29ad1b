"""Named parameters as a vector, and its unbounded coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.kinds.parameter import Parameter

COLOR = Parameter(("a",), (0,), (3,), (0, 1))
IOR = Parameter(("b",), (0,), (), (1e-38, np.inf))
RADIANCE = Parameter(("c",), (0,), (3,), (0, np.inf))
BOTH = ParameterVector((("paint.reflectance", COLOR), ("glass.int_ior", IOR), ("lamp.radiance", RADIANCE)))
VALUES = {"paint.reflectance": [0.1, 0.5, 0.9], "glass.int_ior": 1.5, "lamp.radiance": [3.0, 20, 0.2]}


def test_components_are_named_by_channel():
    assert BOTH.labels == [
        *(f"paint.reflectance.{c}" for c in "rgb"),
        "glass.int_ior",
        *(f"lamp.radiance.{c}" for c in "rgb"),
    ]


def test_components_of_textures_and_tables_are_named_by_their_place():
    shapes = {"wall.reflectance": (2, 1, 3), "volume.density": (2, 2)}
    vector = ParameterVector(tuple((name, Parameter((name,), (0,), shape, (0, 1))) for name, shape in shapes.items()))
    assert vector.labels == [
        *(f"wall.reflectance[{row}, 0].{c}" for row in range(2) for c in "rgb"),
        *(f"volume.density[{i}, {j}]" for i in range(2) for j in range(2)),
    ]
    values = {name: np.arange(np.prod(shape)).reshape(shape) for name, shape in shapes.items()}
    for name, value in vector.unpack(vector.pack(values)).items():
        np.testing.assert_array_equal(value, values[name])
    assert len(vector.bounds) == 10


def test_three_numbers_in_a_row_of_a_texture_are_no_colour():
    texture = Parameter(("alpha",), (0,), (2, 3), (0, 1), rows=6, of_numbers=True)
    vector = ParameterVector((("metal.alpha", texture),))
    assert vector.labels == [f"metal.alpha[{row}, {column}]" for row in range(2) for column in range(3)]
    assert vector.runs == [(False, 6)]
    J = np.arange(3 * 6, dtype=np.float32).reshape(3, 2, 3)
    np.testing.assert_array_equal(vector.columns({"metal.alpha": J}, J[:, 0, 0]), J.reshape(3, 6).T)


def test_unpack_inverts_pack():
    again = BOTH.unpack(BOTH.pack(VALUES))
    assert again.keys() == VALUES.keys()
    for name, value in VALUES.items():
        np.testing.assert_array_equal(again[name], value)
        assert np.shape(again[name]) == np.shape(value)


def test_bounded_inverts_unbounded():
    v = BOTH.pack(VALUES)
    np.testing.assert_allclose(BOTH.bounded(jnp.asarray(BOTH.unbounded(v), jnp.float32)), v, rtol=1e-5)


def test_any_coordinates_give_values_within_the_bounds():
    low, high = BOTH.bounds.T
    for x in (-80.0, -3.0, 0.0, 3.0, 80.0):
        v = np.asarray(BOTH.bounded(jnp.full(7, x, jnp.float32)))
        assert np.isfinite(v).all() and (v >= low).all() and (v <= high).all()


def test_values_at_a_bound_can_be_left():
    """The derivative there must not vanish, or a start at a bound would stay there."""
    ends = ParameterVector((("paint.reflectance", COLOR),))
    x = jnp.asarray(ends.unbounded(np.array([0.0, 1.0, 0.5])), jnp.float32)
    slope = np.diag(jax.jacfwd(ends.bounded)(x))
    assert (slope > 1e-4).all() and np.isfinite(slope).all()


@pytest.mark.parametrize("missing", ["paint.reflectance", "glass.int_ior"])
def test_names_that_a_view_lacks_have_columns_of_zeros(missing):
    image = np.zeros((2, 3, 3), np.float32)
    jacobian = {name: np.ones((*image.shape, *np.shape(v))) for name, v in VALUES.items() if name != missing}
    columns = np.asarray(BOTH.columns(jacobian, image))
    assert columns.shape == (2, 3, 3, 3)
    zero = np.array([name == missing for name in VALUES])
    np.testing.assert_array_equal(columns, np.broadcast_to(np.where(zero, 0.0, 1.0)[:, None], columns.shape))


def test_columns_are_colours_by_channel_and_numbers():
    """They convert to and from the components that they hold, and are the columns of a Jacobian of images."""
    column, seen = BOTH.entries
    assert column.tolist() == [0, 0, 0, 1, 2, 2, 2]
    np.testing.assert_array_equal(seen.T, [*np.eye(3), np.ones(3), *np.eye(3)])
    x = np.arange(1.0, 8.0)
    by_column = np.asarray(BOTH.by_column(x))
    np.testing.assert_array_equal(by_column, [[1, 2, 3], [4, 4, 4], [5, 6, 7]])
    np.testing.assert_array_equal(BOTH.by_component(by_column), x * [1, 1, 1, 3, 1, 1, 1])
    rng = np.random.default_rng(0)
    slopes = {name: rng.normal(size=(2, 3)) for name in VALUES}
    jacobian = {n: slope[..., None] * np.eye(3) if np.shape(VALUES[n]) else slope for n, slope in slopes.items()}
    expected = np.stack(list(slopes.values()), 1)
    np.testing.assert_allclose(BOTH.columns(jacobian, np.zeros((2, 3), np.float32)), expected, rtol=1e-6)


def test_what_counts_from_its_least_on_is_approached_by_its_logarithm():
    """Halfway lies the geometric mean of the bounds, and the least value has a derivative."""
    alpha = ParameterVector((("metal.alpha", Parameter(("a",), (0,), (), (0, 1), least=1e-4)),))
    np.testing.assert_array_equal(alpha.bounds, [[1e-4, 1]])
    assert float(alpha.bounded(jnp.zeros(1))[0]) == pytest.approx(1e-2, rel=1e-5)
    for value in (1e-4, 1e-3, 0.3, 1.0):
        x = jnp.asarray(alpha.unbounded(np.array([value])), jnp.float32)
        assert float(alpha.bounded(x)[0]) == pytest.approx(value, rel=0.02)
        assert float(jax.jacfwd(alpha.bounded)(x)[0, 0]) > 1e-3 * value
    np.testing.assert_array_equal(alpha.scale(np.array([0.02])), [0.02])
