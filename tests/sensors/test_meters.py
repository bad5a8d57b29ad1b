"""Sensors that measure one number, against closed forms and Mitsuba."""

import numpy as np
import pytest

import pathjax as pj
from pathjax.description.transform import Transform

SPP, SEEDS = 1024, 16
LOOK = Transform().look_at([0, 2, 5], [0, 0.3, 0], [0, 1, 0])
SENSORS = {
    "radiancemeter": {"type": "radiancemeter", "origin": [0.2, 0.5, 5], "direction": [0, 0.1, -2]},
    "radiancemeter, placed": {"type": "radiancemeter", "to_world": LOOK},
    "distant": {"type": "distant", "direction": [0.1, 0.3, -1]},
    "distant, placed": {"type": "distant", "to_world": LOOK.scale([0.5, 0.5, 1])},
    "distant, at a point": {"type": "distant", "direction": [0.1, 0.3, -1], "target": [0, 0.2, 1]},
    "distant, at a point far away": {"type": "distant", "direction": [0.1, 0.3, -1], "target": [1, 5, -30]},
}


def seen(sensor, width=1, filter="box", **objects):
    film = {"type": "hdrfilm", "width": width, "height": 1, "rfilter": {"type": filter}}
    return {"type": "scene", "integrator": {"type": "path"}, "sensor": {**sensor, "film": film}, **objects}


def around():
    """A grey ball and a tube over a floor, a lamp and a sky."""
    metal = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    return {
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1, 2]}},
        "ball": {"type": "sphere", "bsdf": metal},
        "floor": {"type": "rectangle", "to_world": Transform().translate([0, 0, -1]).scale(3)},
        "tube": {"type": "cylinder", "p0": [2, 0, 0], "p1": [3, 1, 2], "radius": 0.4},
        "lamp": {"type": "sphere", "center": [0, 1, 3], "radius": 0.3, "emitter": {"type": "area", "radiance": 5.0}},
    }


LAMP = {"type": "sphere", "radius": 2, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}}


@pytest.mark.parametrize("filter", ["box", "gaussian", "lanczos"])
def test_a_radiance_meter_measures_the_radiance_of_a_lamp(filter):
    sensor = {"type": "radiancemeter", "origin": [0, 1, 5], "direction": [0, 0, -1]}
    scene = pj.load_dict(seen(sensor, 1, filter, lamp=LAMP))
    np.testing.assert_allclose(pj.render(scene, spp=4), [[[1, 2, 3]]], rtol=1e-6)


def test_from_afar_a_lamp_has_its_share_of_the_disk_around_its_box():
    """A ball of radius r has a box whose sphere has the radius r sqrt(3)."""
    scene = pj.load_dict(seen({"type": "distant", "direction": [1, 2, 3]}, lamp=LAMP))
    shares = np.stack([np.asarray(pj.render(scene, spp=SPP, seed=seed))[0, 0] for seed in range(SEEDS)])
    # Four standard errors: a false alarm in 16,000.
    assert (abs(shares.mean(0) - np.array([1, 2, 3]) / 3) < 4 * shares.std(0, ddof=1) / SEEDS**0.5 + 1e-6).all()


@pytest.mark.parametrize("case", SENSORS)
def test_sensors_of_one_number_agree_with_mitsuba(case):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")

    def mitsubas(value):
        if isinstance(value, Transform):
            return mi.ScalarTransform4f(value.matrix.tolist())
        return {key: mitsubas(each) for key, each in value.items()} if isinstance(value, dict) else value

    scene = seen(SENSORS[case], **around())
    ours, theirs = pj.load_dict(scene), mi.load_dict(mitsubas(scene))
    one = np.stack([np.asarray(pj.render(ours, spp=SPP, seed=seed))[0, 0] for seed in range(SEEDS)])
    other = np.stack([np.array(mi.render(theirs, spp=SPP, seed=seed))[0, 0] for seed in range(SEEDS)])
    error = np.sqrt((one.var(0, ddof=1) + other.var(0, ddof=1)) / SEEDS)
    # Student's t of 16 seeds each: five standard errors are a false alarm in 10,000; 1e-6 is rounding.
    assert (abs(one.mean(0) - other.mean(0)) < 5 * error + 1e-6 * one.mean(0)).all()


@pytest.mark.parametrize("case", ["radiancemeter", "distant"])
def test_derivatives_through_glass_are_finite(case):
    """Where paths move with a parameter, though no ray moves with its place on the film."""
    glass = {"type": "sphere", "bsdf": {"type": "dielectric", "id": "clear"}}
    scene = pj.load_dict(seen(SENSORS[case], **around(), glass=glass))
    image, J = pj.jacobian(scene, ["clear.int_ior", "lamp.radiance"], spp=64)
    assert np.isfinite(image).all() and all(np.isfinite(each).all() for each in J.values())


def test_a_scene_with_cameras_and_meters_is_seen_by_each():
    scene = seen({"type": "perspective"}, width=4, **around())
    scene["meter"] = seen(SENSORS["radiancemeter"])["sensor"]
    made = pj.load_dict(scene)
    assert pj.render(made, spp=1).shape == (1, 4, 3) and pj.render(made.with_sensor("meter"), spp=1).shape == (1, 1, 3)


@pytest.mark.parametrize(
    ("sensor", "width", "says"),
    [
        (SENSORS["radiancemeter"], 2, r"scene.sensor.film: .*its film must have width and height 1"),
        ({"type": "radiancemeter", "origin": [0, 0, 1]}, 1, "scene.sensor: .*needs both origin and direction"),
        ({"type": "radiancemeter", "direction": [0, 0, 0]}, 1, "sensor.direction: .*points nowhere"),
        ({"type": "radiancemeter", "origin": [0, 0, 1], "to_world": LOOK}, 1, "sensor.origin: .*excludes to_world"),
        ({"type": "radiancemeter", "near_clip": 1.0}, 1, "sensor.near_clip: .*is not a parameter"),
        (SENSORS["distant"], 3, "its film must have width and height 1"),
        ({"type": "distant", "direction": [0, 0, 0]}, 1, "sensor.direction: .*points nowhere"),
        ({"type": "distant", "target": {"type": "cube"}}, 1, "sensor.target: .*as a target is not supported"),
    ],
)
def test_meters_that_cannot_be_are_refused(sensor, width, says):
    with pytest.raises(pj.InputError, match=says):
        pj.load_dict(seen(sensor, width, lamp=LAMP))


def test_from_afar_a_sky_alone_is_seen_as_it_is():
    scene = pj.load_dict(seen({"type": "distant", "direction": [1, 2, 3]}, sky={"type": "constant", "radiance": 0.7}))
    np.testing.assert_allclose(pj.render(scene, spp=4), [[[0.7] * 3]], rtol=1e-6)
