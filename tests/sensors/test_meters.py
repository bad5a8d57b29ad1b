"""Sensors that measure a single value, against closed forms and Mitsuba."""

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
    "distant, at a cube": {"type": "distant", "direction": [0.1, 0.3, -1], "target": {"type": "cube"}},
    "distant, at a disk": {"type": "distant", "direction": [0.1, 0.3, -1], "target": {"type": "disk"}},
}
TILT = Transform().translate([0.3, 1.6, 0.5]).rotate([1, 2, 0], 50).scale(0.4)
ON = {
    "rectangle": {"type": "rectangle", "to_world": TILT},
    "rectangle, flipped": {"type": "rectangle", "to_world": TILT, "flip_normals": True},
    "disk": {"type": "disk", "to_world": TILT},
    "cube": {"type": "cube", "to_world": TILT},
    "cylinder": {"type": "cylinder", "to_world": TILT},
    # Not turned: Mitsuba turns the points of a sphere with it, but not their normals.
    "sphere": {"type": "sphere", "center": [0.3, 1.6, 0.5], "radius": 0.4},
}


def seen(sensor, width=1, filter="box", **objects):
    film = {"type": "hdrfilm", "width": width, "height": 1, "rfilter": {"type": filter}}
    return {"type": "scene", "integrator": {"type": "path"}, "sensor": {**sensor, "film": film}, **objects}


def around():
    """Return a gold ball and a tube over a floor, a lamp and a sky."""
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
    """The sphere around the box of a ball of radius r has the radius r sqrt(3)."""
    scene = pj.load_dict(seen({"type": "distant", "direction": [1, 2, 3]}, lamp=LAMP))
    shares = np.stack([np.asarray(pj.render(scene, spp=SPP, seed=seed))[0, 0] for seed in range(SEEDS)])
    # Four standard errors: a false alarm in 16,000.
    assert (abs(shares.mean(0) - np.array([1, 2, 3]) / 3) < 4 * shares.std(0, ddof=1) / SEEDS**0.5 + 1e-6).all()


def of_mitsuba(mi, value):
    """Return a dictionary of pathjax in the form that Mitsuba takes."""
    if isinstance(value, Transform):
        return mi.ScalarTransform4f(value.matrix.tolist())
    return {key: of_mitsuba(mi, each) for key, each in value.items()} if isinstance(value, dict) else value


def on(shape, **objects):
    """Return a scene whose only sensor is on a shape."""
    scene = seen({"type": "irradiancemeter"}, **objects)
    meter = scene.pop("sensor")
    return {**scene, "measured": {**shape, "meter": {**meter, "id": "meter"}}}


@pytest.mark.parametrize(("center", "to_world"), [([30, 20, 10], Transform()), ([0, 0, 0], TILT)])
def test_a_ball_that_measures_is_lit_from_a_sky_alike_from_all_sides(center, to_world):
    """Irradiance is pi L, also for a turned ball, where Mitsuba sends some rays into the ball."""
    sky = {"type": "constant", "id": "sky", "radiance": {"type": "rgb", "value": [0.5, 1, 2]}}
    scene = pj.load_dict(on({"type": "sphere", "center": center, "to_world": to_world}, sky=sky))
    image, J = pj.jacobian(scene, ["sky.radiance"], spp=256)
    np.testing.assert_allclose(image, np.pi * np.array([[[0.5, 1, 2]]]), rtol=1e-6)
    np.testing.assert_allclose(J["sky.radiance"][0, 0], np.pi * np.eye(3), rtol=1e-6, atol=1e-6)


def test_irradiance_under_a_lamp_is_its_form_factor():
    """It is pi L (r / d)^2 at a point that faces the centre of a sphere, within 4 standard errors."""
    lamp = {"type": "sphere", "center": [0, 0, 5], "radius": 1, "emitter": {"type": "area", "radiance": 1.0}}
    small = {"type": "rectangle", "to_world": Transform().scale(1e-3)}
    scene = pj.load_dict(on(small, lamp=lamp))
    spp = 1 << 16
    share = (1 / 5) ** 2
    error = np.pi * np.sqrt(share * (1 - share) / spp)
    np.testing.assert_allclose(pj.render(scene, spp=spp), np.pi * share, atol=4 * error)
    # Output variables are means over rays, not irradiances.
    toward = pj.render_aovs(pj.load_dict(on({**small, "flip_normals": True}, lamp=LAMP)), ["depth"], spp=64)["depth"]
    assert 2 - 1e-3 < float(toward.mean()) < 2 + 1e-3


@pytest.mark.parametrize("case", [*SENSORS, *ON])
def test_sensors_of_one_number_agree_with_mitsuba(case):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    scene = seen(SENSORS[case], **around()) if case in SENSORS else on(ON[case], **around())
    ours, theirs = pj.load_dict(scene), mi.load_dict(of_mitsuba(mi, scene))
    one = np.stack([np.asarray(pj.render(ours, spp=SPP, seed=seed))[0, 0] for seed in range(SEEDS)])
    other = np.stack([np.array(mi.render(theirs, spp=SPP, seed=seed))[0, 0] for seed in range(SEEDS)])
    error = np.sqrt((one.var(0, ddof=1) + other.var(0, ddof=1)) / SEEDS)
    # Student's t of 16 seeds each: five standard errors are a false alarm in 10,000; 1e-6 is rounding.
    assert (abs(one.mean(0) - other.mean(0)) < 5 * error + 1e-6 * one.mean(0)).all()


@pytest.mark.parametrize(
    ("case", "lights"),
    [("radiancemeter", ("sky", "lamp")), pytest.param("distant", ("sky",), marks=pytest.mark.slow)],
)
def test_derivatives_through_glass_are_finite(case, lights):
    """Paths move with the IOR, though no ray moves with its film position."""
    glass = {"type": "sphere", "bsdf": {"type": "dielectric", "id": "clear"}}
    scene = pj.load_dict(seen(SENSORS[case], **{name: around()[name] for name in lights}, glass=glass))
    image, J = pj.jacobian(scene, ["clear.int_ior", f"{lights[-1]}.radiance"], spp=64)
    assert np.isfinite(image).all() and all(np.isfinite(each).all() for each in J.values())


def test_a_scene_with_cameras_and_meters_is_seen_by_each():
    scene = seen({"type": "perspective"}, width=4, lamp=LAMP)  # its camera stands in the lamp
    scene["meter"] = seen(SENSORS["radiancemeter"])["sensor"]
    made = pj.load_dict(scene)
    np.testing.assert_array_equal(pj.render(made, spp=4), np.zeros((1, 4, 3)))
    np.testing.assert_allclose(pj.render(made.with_sensor("meter"), spp=4), [[[1, 2, 3]]], rtol=1e-6)


VIEWS = {
    "left": {"type": "perspective", "fov": 40, "to_world": LOOK},
    "right": {"type": "perspective", "fov": 50, "to_world": LOOK.rotate([0, 0, 1], 30)},
}


def test_a_batch_shows_what_each_of_its_sensors_sees():
    """Two radiance meters and a sensor of another kind, side by side."""
    meters = [{"type": "radiancemeter", "origin": [0, 1, z], "direction": [0, 0, -1]} for z in (5, -5)]
    afar = {"type": "distant", "direction": [0, 0, -1], "target": [0.1, 0.2, 0]}
    sensor = {"type": "batch", "a": meters[0], "b": afar, "c": meters[1]}
    image = pj.render(pj.load_dict(seen(sensor, 6, lamp=LAMP)), spp=4)
    np.testing.assert_allclose(image, [[[1, 2, 3]] * 4 + [[0, 0, 0]] * 2], rtol=1e-6)


@pytest.mark.parametrize("lens", [{}, {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 5}])
def test_a_batch_agrees_with_mitsuba(lens):
    """With sensors of one kind, and of two; means over blocks of 4 x 4 pixels are compared."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    scene = seen({"type": "batch", "left": VIEWS["left"], "right": {**VIEWS["right"], **lens}}, **around())
    scene["sensor"]["film"] |= {"width": 32, "height": 16}
    ours, theirs = pj.load_dict(scene), mi.load_dict(of_mitsuba(mi, scene))
    one = np.stack([np.asarray(pj.render(ours, spp=64, seed=seed), float) for seed in range(SEEDS)])
    other = np.stack([np.array(mi.render(theirs, spp=64, seed=seed), float) for seed in range(SEEDS)])
    one, other = (each.reshape(SEEDS, 4, 4, 8, 4, 3).mean((2, 4)) for each in (one, other))
    error = np.sqrt((one.var(0, ddof=1) + other.var(0, ddof=1)) / SEEDS)
    # One of 96 values is off by five standard errors of 16 seeds in one of 100 runs; rounding shifts edges by 1e-3.
    assert (abs(one.mean(0) - other.mean(0)) < 5 * error + 1e-3 * one.mean(0)).all()


def test_sensors_on_shapes_come_last_and_are_saved(tmp_path):
    scene = on(ON["disk"], **{name: around()[name] for name in ("sky", "lamp")})
    scene["camera"] = seen({"type": "perspective"}, width=4)["sensor"]
    made = pj.load_dict(scene)
    assert made.sensors == ("camera", "meter")
    view = made.with_sensor("meter")
    pj.save_scene(made, tmp_path / "saved.xml")
    again = pj.load_scene(tmp_path / "saved.xml", sensor="meter")
    image = pj.render(view, spp=4)
    assert image.max() > 0
    np.testing.assert_array_equal(pj.render(again, spp=4), image)


def test_a_group_holds_no_sensors():
    scene = on(ON["disk"])
    group = {"type": "shapegroup", "measured": scene.pop("measured")}
    with pytest.raises(pj.InputError, match="measured: .*holds a sensor, which instances cannot"):
        pj.load_dict({**scene, "group": group, "shown": {"type": "instance", "of": {"type": "ref", "id": "group"}}})


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
        ({"type": "distant", "aim": {"type": "cube"}}, 1, "sensor.aim: .*has no place inside"),
        ({"type": "distant", "target": {"type": "shapegroup"}}, 1, "sensor.target: .*is not one shape"),
        ({"type": "irradiancemeter"}, 1, "sensor: .*stands inside of the <shape>"),
        ({"type": "batch"}, 1, "sensor: .*needs one <sensor> or more inside"),
        ({"type": "batch", **VIEWS}, 5, "sensor.film: .*has 2 sensors; the width must be a multiple of that"),
        ({"type": "batch", "inner": {"type": "batch"}}, 1, "sensor.inner: .*is not supported"),
    ],
)
def test_meters_that_cannot_be_are_refused(sensor, width, says):
    with pytest.raises(pj.InputError, match=says):
        pj.load_dict(seen(sensor, width, lamp=LAMP))


def test_from_afar_a_sky_alone_is_seen_as_it_is():
    scene = pj.load_dict(seen({"type": "distant", "direction": [1, 2, 3]}, sky={"type": "constant", "radiance": 0.7}))
    np.testing.assert_allclose(pj.render(scene, spp=4), [[[0.7] * 3]], rtol=1e-6)
