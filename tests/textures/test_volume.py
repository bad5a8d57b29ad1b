"""Volumes as textures: values on surfaces, derivatives in values, and scene files."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import testing, textures
from pathjax.kinds import Parameters
from pathjax.media.gridvolume import GridVolume, read_vol
from pathjax.textures import Volume

RNG = np.random.default_rng(3)
TURNED = pj.Transform().rotate([1, 2, 3], 40).scale([2, 1.5, 1]).translate([-0.6, -0.5, -0.4]).matrix
CHOICES = list(itertools.product(("clamp", "repeat", "mirror"), (False, True)))


def record(data, wrap="clamp", nearest=False):
    to_cells = np.diag([*data.shape[2::-1], 1.0])
    to_cells[:3, 3] = -0.5
    return GridVolume(data, (to_cells @ np.linalg.inv(TURNED))[:3], np.zeros((2, 3)), wrap, nearest)


def wrapped(i, size, wrap):
    """Return the cell, in a row of this size, that cell i of an endless row stands for."""
    if wrap == "mirror":
        i = i % (2 * size)
        return np.where(i < size, i, 2 * size - 1 - i)
    return i % size if wrap == "repeat" else np.clip(i, 0, size - 1)


@pytest.mark.parametrize("wrap, nearest", CHOICES)
def test_a_surface_has_the_values_of_where_it_is(wrap, nearest):
    """Also beyond the grid; a smaller volume of one channel precedes it in the table."""
    data = RNG.random((3, 4, 2, 3))
    other = Volume.instance("other", volume=record(RNG.random((1, 2, 1, 1))))
    made, codes = textures.build(
        [other, it := Volume.instance("it", volume=record(data, wrap, nearest))], np.float32, (), Parameters()
    )
    p = RNG.uniform(-3, 3, (300, 3))
    x = p @ it.values["volume"].to_grid[:, :3].T + it.values["volume"].to_grid[:, 3]
    low = np.floor(x + 0.5 * nearest).astype(int)
    expected = np.zeros((300, 3))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (wrapped(low[:, a] + corner[a], data.shape[2 - a], wrap) for a in range(3))
        share = np.prod(np.where(corner, x - low, 1 - (x - low)), 1) if not nearest else corner == (0, 0, 0)
        expected += np.reshape(share * np.ones(300), (-1, 1)) * data[k, j, i]
    surfaces = SimpleNamespace(uv=jnp.zeros(2), p=None)

    def look_up(p):
        return made.look_up(jnp.asarray(codes[it], jnp.int32), SimpleNamespace(uv=surfaces.uv, p=p))

    found = jax.jit(jax.vmap(look_up))(jnp.asarray(p, jnp.float32))
    # Within rounding of a face between cells either side is right.
    near = (np.abs(x + 0.5 * nearest - np.rint(x + 0.5 * nearest)) < 1e-4).any(1)
    np.testing.assert_allclose(found[~near], expected[~near], atol=1e-5)
    assert near.mean() < 0.05


@pytest.mark.parametrize("wrap, nearest", CHOICES)
def test_volumes_pass_the_checks_of_textures(wrap, nearest):
    testing.check_texture(Volume, volume=record(RNG.random((2, 3, 2, 3)), wrap, nearest))


def scene(reflectance, **more):
    """Return a scene of a plate that fills the film, under a sky: the image is its colour."""
    film = {"type": "hdrfilm", "width": 4, "height": 4, "filter": {"type": "box"}}
    camera = {"type": "orthographic", "to_world": pj.Transform().translate([0, 0, -3]).matrix, "film": film}
    plate = {"type": "rectangle", "flip_normals": True, "bsdf": {"type": "diffuse", "id": "it", **reflectance}}
    rest = {"integrator": {"type": "path"}, "sky": {"type": "constant"}}
    return pj.load_dict({"type": "scene", "camera": camera, "plate": plate, **rest, **more})


def volume(data, **more):
    to_world = pj.Transform().scale(2).translate([-0.5, -0.5, -0.5]).matrix
    grid = {"type": "gridvolume", "data": data, "to_world": to_world, **more}
    return {"reflectance": {"type": "volume", "volume": grid}}


def test_a_plate_shows_a_slice_and_its_derivative_is_the_share_of_the_image():
    """The plate lies between two layers, the farther twice as bright; each column of cells covers half of it."""
    data = np.stack([np.full((1, 2), 0.2), np.full((1, 2), 0.4)])
    made = scene(volume(data, filter_type="nearest"))
    np.testing.assert_allclose(pj.render(made, spp=4), 0.4, rtol=1e-5)
    made = scene(volume(data))
    np.testing.assert_allclose(pj.render(made, spp=4), 0.3, rtol=1e-5)
    values = pj.parameters(made)["it.reflectance"]
    assert values.shape == (2, 1, 2, 3)

    def mean(values):
        return pj.render(pj.with_parameters(made, {"it.reflectance": values}), 256).mean()

    slope = jax.grad(mean)(values)
    np.testing.assert_allclose(slope.sum(), 1, rtol=1e-5)
    np.testing.assert_allclose(slope[0], slope[1], rtol=1e-4)
    np.testing.assert_allclose(jax.jvp(mean, (values,), (jnp.ones_like(values),))[1], 1, rtol=1e-5)


def test_a_colour_or_a_constant_volume_is_the_same_everywhere():
    for given, value in (({}, 0.75), ({"volume": 0.3}, 0.3), ({"volume": {"type": "constvolume", "value": 0.6}}, 0.6)):
        made = scene({"reflectance": {"type": "volume", **given}})
        np.testing.assert_allclose(pj.render(made, spp=4), value, rtol=1e-5)
        with pytest.raises(pj.InputError, match="is a volume that repeats or has one value"):
            pj.with_parameters(made, {"it.reflectance": 0.5})


@pytest.mark.parametrize("changed", [False, True])
def test_volumes_are_saved_with_their_values(tmp_path, changed):
    made = scene(volume(RNG.random((2, 3, 4)), wrap_mode="mirror", filter_type="nearest"))
    if changed:
        made = pj.with_parameters(made, {"it.reflectance": RNG.random((2, 3, 4, 3)).astype(np.float32)})
    pj.save_scene(made, tmp_path / "saved.xml")
    again = pj.load_scene(tmp_path / "saved.xml")
    for a, b in zip(jax.tree.leaves(made.materials), jax.tree.leaves(again.materials), strict=True):
        np.testing.assert_array_equal(a, b)
    (file,) = tmp_path.glob("*.vol")
    assert read_vol(file)[0].shape[3] == (3 if changed else 1)


GRID = volume(np.ones((1, 1, 2)))["reflectance"]
CHECKS = {"type": "checkerboard", "color0": 0.5}
ATTRIBUTE = {"type": "mesh_attribute", "name": "vertex_color"}


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"a": {"type": "projector", "irradiance": GRID}}, "irradiance.*depends on more than uv"),
        ({"a": {"type": "spot", "texture": {**CHECKS, "color1": GRID}}}, "texture.*depends on more than uv"),
        ({"a": {"type": "sphere", "b": {"type": "bumpmap", "b": {"type": "diffuse"}, "c": GRID}}}, "has no slope"),
        ({"a": {"type": "sphere", "b": {"type": "bumpmap", "b": {"type": "diffuse"}, "c": ATTRIBUTE}}}, "has no slope"),
        ({"a": {"type": "diffuse", "reflectance": {**GRID, "to_uv": np.eye(4)}}}, "to_uv.*is not a parameter"),
    ],
)
def test_where_a_volume_cannot_stand_it_is_refused(more, says):
    with pytest.raises(pj.InputError, match=says):
        scene({}, **more)
