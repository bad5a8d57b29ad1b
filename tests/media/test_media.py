"""Radiance in media and its derivatives, against closed forms and quadrature; numerically hard cases."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import media
from pathjax.core.types import Ray

NULL = {"type": "null"}
RAY = Ray(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]), jnp.float32(jnp.inf), jnp.int32(-1))
slow = pytest.mark.slow


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def medium(phase=None, **colours):
    made = {name: rgb(*x) if isinstance(x, tuple) else x for name, x in colours.items()}
    return {"type": "homogeneous", **made, **({} if phase is None else {"phase": phase})}


def slab(inside, thickness=1.0):
    """Return a slab between the planes z = 0 and z = thickness, far wider than the visible part."""
    to_world = pj.Transform().scale([2, 2, thickness / 2]).translate([0, 0, thickness / 2])
    return {"type": "cube", "id": "slab", "to_world": to_world.matrix, "bsdf": NULL, "interior": inside}


def scene(depth=-1, res=2, width=1e-3, integrator="volpath", sensor=(), **things):
    """Return a scene, seen from z = -3 along z by parallel rays at most `width` away from the axis."""
    to_world = pj.Transform().scale([width, width, 1]).translate([0, 0, -3])
    film = {"type": "hdrfilm", "width": res, "height": res, "filter": {"type": "box"}}
    camera = {"type": "orthographic", "to_world": to_world.matrix, "film": film, **dict(sensor)}
    return pj.load_dict(
        {"type": "scene", "integrator": {"type": integrator, "max_depth": depth}, "sensor": camera, **things}
    )


SKY = {"type": "constant", "radiance": rgb(1.0, 2.0, 3.0)}


# ---- absorption -----------------------------------------------------------------------------------------------------


@slow
@pytest.mark.parametrize("thickness", [1.0, 1e-3, 1e-6])
def test_a_slab_absorbs_as_beer_and_lambert_say(thickness):
    sigma = np.array([0.3, 1.0, 4.0])
    made = scene(sky=SKY, slab=slab(medium(albedo=0.0, sigma_t=tuple(sigma / thickness)), thickness))
    image, J = pj.jacobian(made, ["slab_interior.sigma_t", "slab_interior.scale"], spp=1)
    # Rays leave faces by a margin for rounding, some 1e-6 of the distances in the scene.
    rtol = 1e-5 + 3e-6 / thickness
    expected = np.array([1, 2, 3]) * np.exp(-sigma)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=rtol)
    by_sigma = np.diagonal(J["slab_interior.sigma_t"], axis1=-2, axis2=-1)
    np.testing.assert_allclose(by_sigma, np.broadcast_to(-thickness * expected, image.shape), rtol=rtol)
    np.testing.assert_allclose(J["slab_interior.scale"], np.broadcast_to(-sigma * expected, image.shape), rtol=rtol)


def test_of_media_that_only_absorb_no_scattering_is_compiled():
    made = scene(sky=SKY, slab=slab(medium(albedo=0.0)))
    assert not made.media.scatters and made.media.phases == ()
    with pytest.raises(pj.InputError, match="slab_interior.albedo is 0, as that of all media"):
        pj.with_parameters(made, {"slab_interior.albedo": 0.5})


@slow
def test_one_that_scatters_draws_what_another_absorbs_too(estimate, agree):
    """With a scattering medium elsewhere, a slab of albedo 0 transmits the same light in expectation."""
    other = {"type": "sphere", "center": [9, 0, 0], "bsdf": NULL, "interior": medium()}
    made = scene(sky=SKY, slab=slab(medium(albedo=0.0, sigma_t=(0.3, 1.0, 4.0), scale=0.5)), other=other)
    assert made.media.scatters
    agree(estimate(made, spp=256, count=8), np.array([1, 2, 3]) * np.exp([-0.15, -0.5, -2.0]), pixelwise=False)


# ---- scattering -----------------------------------------------------------------------------------------------------


EVEN = {"type": "isotropic"}


@slow
@pytest.mark.parametrize(
    "inside",
    [
        medium(albedo=1.0, sigma_t=(0.5, 2.0, 8.0)),
        medium(albedo=1.0, sigma_t=3.0, phase={"type": "hg", "g": 0.8}),
        medium(albedo=1.0, sigma_t=(0.5, 2.0, 8.0), phase={"type": "hg", "g": -0.8}),
        medium(albedo=1.0, sigma_t=3.0, phase={"type": "blendphase", "weight": 0.3, "a": {"type": "hg"}, "b": EVEN}),
    ],
)
def test_a_white_medium_cannot_be_told_from_the_sky(inside, estimate, agree):
    made = scene(sky=SKY, ball={"type": "sphere", "bsdf": NULL, "interior": inside})
    agree(estimate(made, spp=256, count=8), [1, 2, 3], pixelwise=False)


LIGHT, INTENSITY = np.array([1.5, 0.5, 0.2]), np.array([3.0, 2.0, 1.0])
SIGMA, ALBEDO, G = np.array([0.4, 1.0, 2.5]), np.array([0.9, 0.5, 0.2]), 0.6


def single_scattering(sigma, albedo, g, count=4000):
    """Integrate along the axis of the cube [-1, 1]^3, with LIGHT inside or outside, by the midpoint rule."""
    z = -1 + (np.arange(count) + 0.5) * 2 / count
    p = np.stack([np.zeros_like(z), np.zeros_like(z), z], -1)
    to_light = LIGHT - p
    distance = np.linalg.norm(to_light, axis=1)
    d = to_light / distance[:, None]
    leaves = ((np.sign(d) - p) / d).min(1)  # distance at which the ray to the light leaves the cube
    cos = d[:, 2]
    phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cos) ** 1.5)
    way = (z + 1 + np.minimum(leaves, distance))[:, None]
    return (albedo * sigma * np.exp(-sigma * way) * (phase / distance**2)[:, None]).sum(0) * (2 / count) * INTENSITY


@pytest.fixture(scope="module")
def lit_cube():
    inside = medium(albedo=tuple(ALBEDO), sigma_t=tuple(SIGMA), phase={"type": "hg", "g": G})
    cube = {"type": "cube", "id": "cube", "bsdf": NULL, "interior": inside}
    light = {"type": "point", "position": list(LIGHT), "intensity": rgb(*INTENSITY)}
    return scene(depth=2, cube=cube, light=light)


def test_single_scattering_is_that_of_quadrature(lit_cube, estimate, agree):
    agree(estimate(lit_cube, spp=1024, count=8), single_scattering(SIGMA, ALBEDO, G), pixelwise=False)


@slow
def test_derivatives_of_single_scattering_are_those_of_quadrature(lit_cube, derivatives, agree):
    """In albedo and extinction, per channel, and in g."""
    at = {"cube_interior.sigma_t": 0, "cube_interior.albedo": 1, "cube_interior.g": 2}
    _, found = derivatives(lit_cube, list(at), spp=1024, count=8)
    for name, place in at.items():
        values, moved = [SIGMA, ALBEDO, G], []
        for step in (1e-5, -1e-5):
            changed = list(values)
            changed[place] = values[place] + step
            moved.append(single_scattering(*changed))
        agree(found[name], (moved[0] - moved[1]) / 2e-5, pixelwise=False)


# ---- where media begin and end --------------------------------------------------------------------------------------


@slow
def test_the_camera_may_lie_in_a_medium():
    """From z = -3 to the far face of a cube that reaches from -4 to 4."""
    fog = {**medium(albedo=0.0, sigma_t=0.25), "id": "fog"}
    around = {"type": "ref", "id": "fog"}
    cube = {"type": "cube", "to_world": pj.Transform().scale(4).matrix, "bsdf": NULL, "interior": around}
    image = pj.render(scene(sky=SKY, fog=fog, cube=cube, sensor={"medium": around, "near_clip": 1e-6}), spp=1)
    np.testing.assert_allclose(image, np.broadcast_to(np.exp(-7 / 4) * np.array([1, 2, 3]), (2, 2, 3)), rtol=1e-5)


@slow
def test_nested_media_follow_each_other():
    """A sphere of radius 1/2 in one of radius 1, whose medium is the exterior of the inner one."""
    outer, inner = medium(albedo=0.0, sigma_t=0.5), {**medium(albedo=0.0, sigma_t=2.0), "id": "inner"}
    ball = {"type": "sphere", "bsdf": NULL, "interior": {**outer, "id": "outer"}}
    small = {
        "type": "sphere",
        "radius": 0.5,
        "bsdf": NULL,
        "interior": inner,
        "exterior": {"type": "ref", "id": "outer"},
    }
    image = pj.render(scene(sky=SKY, ball=ball, small=small), spp=1)
    np.testing.assert_allclose(image[..., 0], np.full((2, 2), np.exp(-0.5 - 2.0)), rtol=1e-5)


@slow
def test_what_has_no_medium_outside_leaves_paths_in_none():
    """As in Mitsuba: the inner sphere has no exterior medium, so behind it paths are in none."""
    ball = {"type": "sphere", "bsdf": NULL, "interior": medium(albedo=0.0, sigma_t=0.5)}
    small = {"type": "sphere", "radius": 0.5, "bsdf": NULL, "interior": medium(albedo=0.0, sigma_t=2.0)}
    image = pj.render(scene(sky=SKY, ball=ball, small=small), spp=1)
    np.testing.assert_allclose(image[..., 0], np.full((2, 2), np.exp(-0.25 - 2.0)), rtol=1e-5)


def test_path_takes_no_notice_of_media():
    made = scene(sky=SKY, slab=slab(medium()), integrator="path")
    assert made.media is None
    assert any("takes no notice of media" in note for note in made.about.description.notes)


# ---- hard cases -----------------------------------------------------------------------------------------------------


@slow
@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e6, 1e30])
def test_no_number_is_nan_whatever_the_extinction(sigma):
    inside = medium(albedo=(1.0, 0.5, 0.0), sigma_t=(sigma, 1.0, 0.0), phase={"type": "hg", "g": 0.9})
    made = scene(depth=8, sky=SKY, ball={"type": "sphere", "id": "ball", "bsdf": NULL, "interior": inside})
    names = [f"ball_interior.{each}" for each in ("sigma_t", "albedo", "scale", "g")]
    image, J = pj.jacobian(made, names, spp=64)
    assert np.isfinite(image).all() and (np.asarray(image) >= 0).all() and np.asarray(image).mean() <= 3
    assert all(np.isfinite(J[name]).all() for name in names)
    np.testing.assert_array_equal(np.asarray(image)[..., 2] > 0, True)


def test_weights_of_a_flight_average_to_1(average_to_1):
    """In all channels, also one in which the throughput is 0, for flights of any length."""
    fog = media.Homogeneous.instance("it", sigma_t=np.array([0.1, 1.0, 10.0]), albedo=np.ones(3))
    weights = average_to_1(fog, RAY, jnp.array([0.0, 0.2, 3.0]), 200_000, 1e-6)
    assert weights.max() <= 1 / media.LEAST
