"""Camera rays equal Mitsuba's for the same random numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.sensors import Orthographic, Perspective, ThinLens
from pathjax.sensors.film import HDRFilm

ORIGIN, TARGET, UP = [1.0, 2.0, -4.0], [0.3, 0.2, 0.5], [0.1, 1.0, 0.2]


def look_at():
    """Return Mitsuba's matrix, of columns left, up, forward, origin."""
    forward = np.subtract(TARGET, ORIGIN) / np.linalg.norm(np.subtract(TARGET, ORIGIN))
    left = np.cross(UP, forward) / np.linalg.norm(np.cross(UP, forward))
    m = np.eye(4)
    m[:3] = np.stack([left, np.cross(forward, left), forward, ORIGIN], -1)
    return m


def numbers(n=200):
    rng = np.random.default_rng(1)
    return rng.random((n, 2)), rng.random((n, 2))


def rays_of(record, width, height, positions, lens, dtype=jnp.float32):
    built = record.build(HDRFilm(width, height), dtype)
    sample = jax.jit(jax.vmap(built.sample_ray))
    ray = sample(jnp.asarray(positions, dtype), jnp.asarray(lens, dtype))
    return np.asarray(ray.o), np.asarray(ray.d), np.asarray(ray.t_max)


def assert_mitsubas(record, width, height, crop=None, **more):
    """Compare with Mitsuba's sensor; its positions lie in the crop window, ours on the whole film."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    x, y, w, h = crop or (0, 0, width, height)
    film = {"type": "hdrfilm", "width": width, "height": height, "filter": {"type": "box"}}
    film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": w, "crop_height": h}
    sensor = mi.load_dict(
        {
            "type": type(record).__name__.lower(),
            "to_world": mi.ScalarTransform4f(record.to_world.tolist()),
            **{key: getattr(record, key) for key in ("fov", "fov_axis") if hasattr(record, key)},
            "near_clip": record.near_clip,
            "far_clip": record.far_clip,
            "film": film,
            **more,
        }
    )
    positions, lens = numbers()
    theirs = [sensor.sample_ray(0, 0, list(p), list(u))[0] for p, u in zip(positions, lens, strict=True)]
    whole = (positions * [w, h] + [x, y]) / [width, height]
    o, d, t_max = rays_of(record, width, height, whole, lens)
    # Mitsuba goes through a 4 x 4 projection in float32, whose error grows with the far clip.
    np.testing.assert_allclose(d, [list(r.d) for r in theirs], atol=5e-6)
    np.testing.assert_allclose(o, [list(r.o) for r in theirs], atol=5e-6)
    np.testing.assert_allclose(t_max, [r.maxt for r in theirs], rtol=1e-5)


@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "smaller", "larger"])
@pytest.mark.parametrize("size", [(60, 40), (40, 60)])
def test_field_of_view_along_each_axis(axis, size):
    assert_mitsubas(Perspective(look_at(), 50.0, axis), *size)


def test_crop_window_is_a_part_of_the_film():
    assert_mitsubas(Perspective(look_at(), 50.0), 60, 40, (10, 5, 20, 30))


@pytest.mark.parametrize("crop", [None, (10, 5, 20, 30)])
def test_principal_point_offset(crop):
    record = Perspective(look_at(), 50.0, principal_point_offset=(0.1, -0.2))
    more = {"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.2}
    assert_mitsubas(record, 60, 40, crop, **more)


def test_clip_distances_run_along_the_axis():
    record = Perspective(look_at(), 70.0, near_clip=0.5, far_clip=20.0)
    assert_mitsubas(record, 60, 40)
    o, d, t_max = rays_of(record, 60, 40, *numbers())
    forward = look_at()[:3, 2]
    np.testing.assert_allclose((o - ORIGIN) @ forward, 0.5, rtol=1e-5)
    np.testing.assert_allclose((o + t_max[:, None] * d - ORIGIN) @ forward, 20, rtol=1e-5)


def test_thin_lens():
    record = ThinLens(look_at(), 50.0, aperture_radius=0.3, focus_distance=3.0)
    assert_mitsubas(record, 60, 40, aperture_radius=0.3, focus_distance=3.0)


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 2, 2), (2, 3, 0.5), (-1.5, 1, 1)])
@pytest.mark.parametrize("crop", [None, (10, 5, 20, 30)])
def test_orthographic(scale, crop):
    to_world = look_at() @ np.diag([*scale, 1.0])
    assert_mitsubas(Orthographic(to_world, near_clip=0.5, far_clip=20.0), 60, 40, crop)


def test_orthographic_rays_are_parallel_and_as_long_as_the_clip_distances_say():
    _, d, t_max = rays_of(Orthographic(look_at(), near_clip=0.5, far_clip=20.0), 60, 40, *numbers())
    np.testing.assert_allclose(d, np.broadcast_to(look_at()[:3, 2], d.shape), atol=1e-6)
    np.testing.assert_allclose(t_max, 19.5)


def test_thin_lens_rays_of_a_position_meet_in_the_plane_of_focus():
    sharp = Perspective(look_at(), 50.0, near_clip=1e-6)
    blurred = ThinLens(look_at(), 50.0, near_clip=1e-6, aperture_radius=0.3, focus_distance=3.0)
    positions = np.repeat(numbers(10)[0], 20, 0)
    forward = look_at()[:3, 2]
    o, d, _ = rays_of(sharp, 60, 40, positions, numbers()[1])
    focus = o + d * ((3 - (o - ORIGIN) @ forward) / (d @ forward))[:, None]
    o, d, _ = rays_of(blurred, 60, 40, positions, numbers()[1])
    assert np.linalg.norm(o - ORIGIN, axis=1).max() <= 0.3 + 1e-5 and np.ptp(o, 0).max() > 0.3
    np.testing.assert_allclose(o + d * ((3 - (o - ORIGIN) @ forward) / (d @ forward))[:, None], focus, atol=5e-6)


def test_a_lens_of_radius_0_is_a_pinhole():
    pinhole = rays_of(Perspective(look_at(), 50.0), 60, 40, *numbers())
    lens = rays_of(ThinLens(look_at(), 50.0, aperture_radius=0.0, focus_distance=3.0), 60, 40, *numbers())
    for a, b in zip(pinhole, lens, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6, rtol=1e-6)


def test_upper_left_corner_comes_first():
    """Camera at the origin looking along +z: x to the left of the image, y up."""
    _, d, _ = rays_of(Perspective(np.eye(4), 90.0), 40, 40, [[0, 0], [1, 0], [0, 1], [0.5, 0.5]], np.zeros((4, 2)))
    np.testing.assert_allclose(d / d[:, 2:], [[1, 1, 1], [-1, 1, 1], [1, -1, 1], [0, 0, 1]], atol=1e-6)


def test_scale_in_to_world_changes_neither_directions_nor_distances():
    """Ray directions are unit vectors for any matrix."""
    scaled = look_at()
    scaled[:3, :3] *= 3
    for a, b in zip(*(rays_of(Perspective(m, 50.0), 60, 40, *numbers()) for m in (look_at(), scaled)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6, rtol=1e-6)
