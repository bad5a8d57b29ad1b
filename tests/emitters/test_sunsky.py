"""The clear sky: position of the sun, radiance, sampling, and values against Mitsuba's."""

from __future__ import annotations

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import testing
from pathjax.emitters import SunSky
from pathjax.emitters.sunsky import APERTURE
from pathjax.kinds import Parameters, Row


def sky(dtype=np.float32, **values):
    made = SunSky.build([SunSky.instance("sky", **values)], dtype, (), Parameters(), None)
    return Row(jax.device_put(made), 0)


def loaded(**fields):
    ball = {"type": "sphere", "bsdf": {"type": "diffuse"}}
    return pj.load_dict({"type": "scene", "sky": {"type": "sunsky", **fields}, "ball": ball})


def parameters(scene):
    (lights,) = scene.emitters
    return lights.parameters(0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [
        {"sun": (0.8, 0.6, 0.0), "turbidity": 9.5},
        {"sun_scale": 0.0, "albedo": (0, 1, 0.5), "sun": (0, 0, 1)},
        {"sun": (0.6, 0.0, -0.8)},
    ],
)
def test_directions_are_drawn_by_their_density(values):
    """For a sun across the horizon, switched off, or below, where there is no light; it is wide for the test's grid."""
    testing.check_emitter(SunSky, samples=50_000, sun_aperture=20.0, **values)


def test_a_wider_sun_shines_as_much():
    """The irradiance, radiance times solid angle, does not change."""
    usual, wide = sky(), sky(sun_aperture=10.0)
    np.testing.assert_allclose(wide.disc * wide.one_minus_cos, usual.disc * usual.one_minus_cos, rtol=1e-6)


def test_its_power_is_the_mean_luminance_over_the_sphere():
    """By points spread evenly over the sky, four in each cell."""
    p, count = sky(sun_scale=0.0, sun=(0.0, 0.6, 0.8)), 20_000
    z, turn = (np.arange(count) + 0.5) / count, np.arange(count) * (np.sqrt(5) - 1) / 2
    r = np.sqrt(1 - z * z)
    d = jnp.asarray(np.stack([r * np.cos(2 * np.pi * turn), r * np.sin(2 * np.pi * turn), z], -1), jnp.float32)
    mean = np.asarray(jax.jit(jax.vmap(lambda d: SunSky.emitted(p, d)))(d), float).mean(0) / 2
    np.testing.assert_allclose(SunSky.power(p), mean @ [0.212671, 0.715160, 0.072169], rtol=2e-3)


@pytest.mark.parametrize(
    ("fields", "direction"),
    [
        # The equinox of 2024 was on the 20th of March at 3:06; by the equation of time noon comes 7.5 minutes late.
        ({"hour": 12.0, "minute": 7.5, "latitude": 0.0}, (0, 0, 1)),
        ({"hour": 12.0, "minute": 7.5, "latitude": 60.0}, (np.sin(np.pi / 3), 0, np.cos(np.pi / 3))),
        ({"hour": 17.0, "minute": 7.5, "latitude": 0.0}, (0, np.sin(5 * np.pi / 12), np.cos(5 * np.pi / 12))),
        ({"hour": 9.0, "minute": 7.5, "latitude": 0.0, "timezone": 2.0}, (0, -np.sqrt(0.5), np.sqrt(0.5))),
    ],
)
def test_the_sun_stands_where_place_and_time_say(fields, direction):
    """South is +x and west is +y; within a quarter of a degree, by which the sun moves north on that day."""
    greenwich = {"year": 2024, "month": 3, "day": 20, "longitude": 0.0, "timezone": 0.0}
    if "timezone" in fields:
        fields = {**fields, "hour": fields["hour"] + fields["timezone"]}
    assert np.linalg.norm(parameters(loaded(**{**greenwich, **fields})).direction - np.array(direction)) < 0.0045


def test_the_sun_s_direction_is_given_in_world_space():
    to_world = pj.Transform().rotate([1, 0, 0], -90)
    p = parameters(loaded(sun_direction=[1.0, 2.0, 0.0], to_world=to_world))
    toward = jnp.asarray(np.array([1, 2, 0]) / np.sqrt(5), jnp.float32)
    assert SunSky.emitted(p, toward).min() > 1000 > SunSky.emitted(p, jnp.array([0.0, 1, 0])).max()


def test_scales_are_parameters_in_which_light_is_linear():
    scene = loaded(sun_direction=[1.0, 2.0, 3.0])
    assert {"sky.sky_scale", "sky.sun_scale"} <= pj.parameters(scene).keys()
    p = parameters(pj.with_parameters(scene, {"sky.sky_scale": 0.0, "sky.sun_scale": 3.0}))
    np.testing.assert_allclose(SunSky.emitted(p, p.direction), 3 * np.asarray(p.disc), rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"turbidity": 11.0}, '"turbidity" of .* must be at least 1 and at most 10, is 11'),
        ({"albedo": 1.5}, '"albedo" of .* must lie between 0 and 1'),
        ({"sun_aperture": 90.0}, '"sun_aperture" of .* must be above 0 and below 90'),
        ({"sun_direction": [0.0, 0.0, 0.0]}, "the zero vector, which points nowhere"),
        ({"sun_direction": [0.0, 0.0, 1.0], "hour": 9.0}, '"hour" of .* cannot stand beside sun_direction'),
        ({"month": 2, "day": 30}, '"day" of .* is none: day is out of range for month'),
        ({"complex_sun": True}, '"complex_sun" of .* asks for a darker limb of the sun, which is not modelled'),
    ],
)
def test_what_is_wrong_is_told(fields, says):
    with pytest.raises(pj.InputError, match=says):
        loaded(**fields)


def test_a_sun_below_the_horizon_is_told_and_dark():
    with pytest.warns(UserWarning, match="black"):
        scene = loaded(sun_direction=[1.0, 0.0, -0.1])
    assert any("below the horizon" in note for note in scene.about.description.notes)


# ---- Mitsuba --------------------------------------------------------------------------------------------------------

MI = """
import json, sys
import mitsuba as mi, numpy as np
mi.set_variant("scalar_rgb")
found = []
for fields, directions in json.load(sys.stdin):
    made, si = mi.load_dict({"type": "sunsky", **fields}), mi.SurfaceInteraction3f()
    for d in directions:
        si.wi = [-x for x in d]
        found.append(list(made.eval(si)))
print(json.dumps(found))
"""
SKIES = [
    {"sun_direction": [0.3, 0.5, 0.6]},
    {"turbidity": 7.3, "albedo": 0.9, "sun_direction": [-0.3, 0.5, 0.05], "sky_scale": 2.0, "sun_scale": 0.5},
    {"turbidity": 1.0, "sun_direction": [1.0, 0.0, 2.0], "sun_aperture": 3.0},
    {"turbidity": 10.0, "sun_direction": [0.0, 0.0, 1.0]},
]


@pytest.mark.slow
def test_radiance_is_that_of_mitsuba():
    """In directions all over the sky and within the sun; Mitsuba rounds angles, which changes radiance by 1e-4 of it.

    It also rounds the solid angle of the sun to the eight bits that float32 leaves of 1 - cos; the test undoes that.
    """
    pytest.importorskip("mitsuba")
    rng, cases, found = np.random.default_rng(0), [], []
    for fields in SKIES:
        p = parameters(loaded(**fields))
        d = np.concatenate([rng.normal(size=(300, 3)) * [1, 1, 0.3], p.direction + 1e-3 * rng.normal(size=(20, 3))])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        found.append(jax.jit(jax.vmap(lambda d, p=p: SunSky.emitted(p, d)))(jnp.asarray(d, jnp.float32)))
        cases.append((fields, d.tolist()))
    command = [sys.executable, "-c", MI]
    run = subprocess.run(command, input=json.dumps(cases), capture_output=True, text=True, check=True)
    theirs = np.array(json.loads(run.stdout)).reshape(len(SKIES), -1, 3)
    for fields, seen in zip(SKIES, theirs, strict=True):
        aperture = np.radians([fields.get("sun_aperture", APERTURE), APERTURE]) / 2
        exact, rounded = (1 - np.cos(aperture.astype(each)) for each in (np.float64, np.float32))
        seen[300:] *= (exact[1] / exact[0]) / (rounded[1] / rounded[0])
    theirs, ours = theirs.reshape(-1, 3), np.concatenate(found)
    assert (np.abs(ours - theirs) <= 3e-4 * theirs.max(1, keepdims=True)).all()
