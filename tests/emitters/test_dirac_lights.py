"""Dirac lights, which a point of a surface sees in one direction: against closed forms and Mitsuba's."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import emitters, transport
from pathjax.description.spectra import UNIFORM_RADIANCE
from pathjax.emitters import Directional, Point, Projector, Spot
from pathjax.emitters.selection import AllRows
from pathjax.images import write_exr
from pathjax.kinds import Parameters, Row

# ---- one light, one point of a floor --------------------------------------------------------------------------------

ALBEDO = np.array([0.2, 0.5, 0.8])
GREY = '<bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
# A camera that sees only the origin, and light reflected once.
VIEW = {"origin": "1, 2, 1.5", "fov": 1e-3, "res": 2, "depth": 2}
# Samples lie within 3e-5 of the origin, and float32 adds 1e-6.
NEAR = 2e-4


def emitter(kind, inside="", name=None):
    return f'<emitter type="{kind}" id="{name or kind}">{inside}</emitter>'


def color(name, *value):
    return f'<rgb name="{name}" value="{", ".join(map(str, value))}"/>'


def vector(name, value):
    return f'<vector name="{name}" value="{", ".join(map(str, value))}"/>'


def placed(*steps):
    return f'<transform name="to_world">{"".join(steps)}</transform>'


def lookat(origin, target, up=(0.1, 1, 0.3)):
    values = (", ".join(map(str, v)) for v in (origin, target, up))
    return placed("<lookat origin='{}' target='{}' up='{}'/>".format(*values))


def plate(*steps, inside=GREY):
    """A square that faces up, unless `steps` turn it."""
    up = '<rotate x="1" angle="-90"/>'
    return f'<shape type="rectangle">{placed(up, *steps)}{inside}</shape>'


FLOOR = plate()


# A dark light of each kind, and a sheet out of the way, so that scenes share a kernel.
DARK = {
    kind: emitter(kind, color(name, 0, 0, 0), f"dark {kind}")
    for kind, name in (
        *(("point", "intensity"), ("spot", "intensity"), ("directional", "irradiance")),
        ("projector", "irradiance"),
    )
}
BELOW = plate('<translate y="-9"/>', inside='<bsdf type="diffuse"/>')


def under(kind, light, floor=FLOOR, sheet=BELOW):
    """Return a floor under one light of this kind, with the dark lights by which all such scenes share a kernel."""
    return floor + sheet + light + "".join(dark for other, dark in DARK.items() if other != kind)


def reflected(irradiance):
    return ALBEDO / np.pi * irradiance


def rendered(scene, **how):
    """Return the mean of all pixels, with one sample each."""
    return np.asarray(pj.render(scene, 1, **how), float).mean((0, 1))


INTENSITY = np.array([6.0, 3.0, 1.0])


@pytest.mark.parametrize("where", [(0, 2, 0), (0.5, 0.3, -2), (-3, 40, 1)])
@pytest.mark.parametrize("strategy", ["mis", "light"])
def test_a_point_light_falls_with_the_square_of_the_distance(make_scene, where, strategy):
    light = emitter("point", color("intensity", *INTENSITY) + vector("position", where))
    scene = make_scene(under("point", light), **VIEW)
    distance = np.linalg.norm(where)
    expected = reflected(INTENSITY * where[1] / distance**3)
    np.testing.assert_allclose(rendered(scene, strategy=strategy), expected, rtol=NEAR)


def test_to_world_moves_the_origin_to_a_point_light(make_scene):
    moved = placed('<scale value="2"/>', '<translate x="0.25" y="1"/>', '<scale x="2" y="1" z="-1"/>')
    lights = (emitter("point", inside) for inside in (moved, vector("position", (0.5, 1, 0))))
    one, other = (make_scene(under("point", light), **VIEW) for light in lights)
    np.testing.assert_array_equal(pj.render(one, 1), pj.render(other, 1))


def spot(angle, inside, distance=2.0):
    """A spot straight above the origin, aimed `angle` degrees beside it."""
    x, y = math.sin(math.radians(angle)), distance - math.cos(math.radians(angle))
    return emitter("spot", color("intensity", *INTENSITY) + inside + lookat((0, distance, 0), (x, y, 0)))


def cone(cutoff=None, beam=None):
    values = {"cutoff_angle": cutoff, "beam_width": beam}
    return "".join(f'<float name="{name}" value="{x}"/>' for name, x in values.items() if x is not None)


@pytest.mark.parametrize(
    "cutoff, beam, angle, falloff",
    [
        (None, None, 0, 1),  # 20 and 15 degrees
        (None, None, 14.9, 1),
        (None, None, 16, 0.8),
        (None, None, 19, 0.2),
        (None, None, 20.1, 0),
        (40, None, 35, 0.5),
        (40, 0, 0.0, 1),
        (40, 0, 10, 0.75),
        (30, 30, 29.9, 1),  # a hard edge
        (30, 30, 30.1, 0),
        (0.5, 0.1, 0.2, 0.75),  # cosines have no digits left here
        (170, 100, 135, 0.5),
        (170, 100, 180, 0),
    ],
)
def test_a_spot_falls_linearly_in_the_angle(make_scene, cutoff, beam, angle, falloff):
    scene = make_scene(under("spot", spot(angle, cone(cutoff, beam))), **VIEW)
    # Seen from the light, samples lie within 1e-3 degrees; the narrowest ramp is 0.4 degrees wide.
    np.testing.assert_allclose(rendered(scene), reflected(INTENSITY * falloff / 4), rtol=3e-3 if falloff % 1 else NEAR)


@pytest.mark.parametrize("tilt", [0, 30, -60, 89])
@pytest.mark.parametrize("given", ["direction", "to_world"])
def test_a_directional_light_falls_with_the_cosine(make_scene, tilt, given):
    towards = np.array([-1.0, -2.0, 0.5])
    where = vector("direction", 7e-30 * towards) if given == "direction" else lookat((5, 6, 7), (5, 6, 7) + towards)
    floor = plate(f'<rotate z="1" angle="{tilt}"/>')
    light = emitter("directional", color("irradiance", 1, 2, 3) + where)
    scene = make_scene(under("directional", light, floor), **VIEW)
    normal = np.array([-math.sin(math.radians(tilt)), math.cos(math.radians(tilt)), 0])
    cosine = max(-towards @ normal / np.linalg.norm(towards), 0)
    # The camera is behind the floor with the largest tilt.
    expected = reflected(np.array([1, 2, 3]) * cosine) * (normal @ [1, 2, 1.5] > 0)
    np.testing.assert_allclose(rendered(scene), expected, rtol=NEAR)


def test_defaults_are_mitsubas(make_scene):
    """Intensity 1 at the origin, along z, within 20 degrees; uniform spectra have the colour of uniform radiance."""
    wall = plate('<rotate x="1" angle="-90"/>', '<translate z="1"/>')
    for kind in ("point", "spot", "directional"):
        light = f'<emitter type="{kind}" id="{kind}"/>'
        scene = make_scene(under(kind, light, wall), **VIEW | {"target": "0, 0, 1", "origin": "0.1, 0.2, 0"})
        np.testing.assert_allclose(rendered(scene), reflected(1.0), rtol=NEAR)
        assert {f"{kind}.{name}" for name in ("intensity", "irradiance")} & pj.parameters(scene).keys()
    uniform = emitter("point", '<spectrum name="intensity" value="2"/>')
    found = pj.parameters(make_scene(uniform))["point.intensity"]
    np.testing.assert_allclose(found, 2 * UNIFORM_RADIANCE, rtol=1e-6)


@pytest.mark.parametrize("at, lit", [((0, 0), 1), ((0.9, 0), 1), ((0, 0.9), 1), ((1.1, 0), 0), ((0, -1.1), 0)])
def test_a_projector_lights_a_screen_evenly(make_scene, at, lit):
    """Wherever the image falls, the screen receives pi times `irradiance` over the square of the distance."""
    x, z = -2 * at[0], -2 * at[1]
    above = lookat((x, 2, z), (x, 0, z), (0, 0, 1))
    light = emitter("projector", color("irradiance", 1, 2, 3) + lens(90) + above)
    found = rendered(make_scene(under("projector", light, plate('<scale value="4"/>')), **VIEW))
    np.testing.assert_allclose(found, lit * reflected(np.pi * np.array([1, 2, 3]) / 4), rtol=NEAR)


# ---- shadows --------------------------------------------------------------------------------------------------------

BULB = emitter("point", color("intensity", *INTENSITY) + vector("position", (0, 2, 0)))
SPOT = spot(0, cone(30))
SUN = emitter("directional", color("irradiance", *INTENSITY) + vector("direction", (0, -1, 0)))


LAMPS, SMOOTH = {"point": BULB, "spot": SPOT, "directional": SUN}, ("dielectric", "conductor")
SHADOWS = [
    *((name, "diffuse") for name in LAMPS),
    *(("point", kind) for kind in SMOOTH),
    *(pytest.param(name, kind, marks=pytest.mark.slow) for name in ("spot", "directional") for kind in SMOOTH),
]


@pytest.mark.parametrize("name, kind", SHADOWS)
def test_what_stands_in_the_way_casts_a_shadow(make_scene, name, kind):
    """Glass casts one too: a direction sampled from its bsdf never meets a light without size, as in Mitsuba."""
    light = LAMPS[name]
    # Sheets of glass and of metal, one of them out of the way, share a kernel.
    others = "".join(BELOW.replace("diffuse", other) for other in SMOOTH if kind in SMOOTH and other != kind)
    sheet = others + plate('<scale value="0.1"/>', '<translate y="0.5"/>', inside=f'<bsdf type="{kind}"/>')
    beside = sheet.replace('y="0.5"', 'x="0.3" y="0.5"')
    above = sheet.replace('y="0.5"', 'y="3"')
    assert not np.any(pj.render(make_scene(under(name, light, sheet=sheet), **VIEW | {"depth": 8}), 1))
    plain = rendered(make_scene(under(name, light, sheet=beside), **VIEW))
    assert plain.min() > 0
    over = rendered(make_scene(under(name, light, sheet=above), **VIEW))
    np.testing.assert_allclose(over, 0 if light is SUN else plain, rtol=NEAR)


def test_a_light_shines_off_the_wall_that_it_lies_in(make_scene):
    """In a tilted scene far from the origin, rounding alone would hide the light from a tenth of all points."""
    tilt, wide, there = np.radians(17), '<scale value="9"/>', '<translate x="1000" y="{}" z="1000"/>'
    tilted = '<rotate x="1" angle="17"/>'
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    light, origin, target = turn @ [1000, 102.3, 1000], turn @ [1001, 102, 1001.5], turn @ [1000, 100.3, 1000]
    floor = plate(wide, there.format(100.3), tilted)
    ceiling = plate('<rotate x="1" angle="180"/>', wide, there.format(102.3), tilted, inside="")
    scene = make_scene(
        floor + ceiling + emitter("point", color("intensity", *INTENSITY) + vector("position", light)),
        **VIEW | {"origin": ", ".join(map(str, origin)), "target": ", ".join(map(str, target)), "fov": 1},
    )
    # Samples lie within 0.02 of the point below the light.
    np.testing.assert_allclose(np.asarray(pj.render(scene, 64)).mean((0, 1)), reflected(INTENSITY / 4), rtol=1e-3)


def test_at_the_light_itself_nothing_is_nan():
    for kind in (Point, Spot, Projector):
        p = Row(table(kind), 0)
        both = jax.jit(lambda ref, p=p, kind=kind: jax.jvp(lambda ref: kind.sample(p, ref), [ref], [jnp.ones(3)]))
        for ref in (np.zeros(3), np.array([0, 0, 1e-25]), np.array([0, 0, 3e18])):
            value, slopes = both(jnp.float32(ref))
            assert all(np.isfinite(x).all() for x in (*value, *slopes))


# ---- derivatives ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LAMPS)
def test_images_are_linear_in_the_light(make_scene, kind):
    """Up to rounding, with interreflection."""
    ball = '<shape type="sphere"><point name="center" x="0.4" y="0.3" z="0"/><float name="radius" value="0.3"/></shape>'
    scene = make_scene(FLOOR + ball + "".join(LAMPS.values()), origin="1, 2, 1.5", depth=4)
    names = {light: f"{light}.{'irradiance' if light == 'directional' else 'intensity'}" for light in LAMPS}
    scene = pj.with_parameters(scene, {name: 0.0 for light, name in names.items() if light != kind})
    image, J = pj.jacobian(scene, list(names.values()), 16)
    assert np.asarray(image).max() > 0.1
    slope = np.einsum("...cc->...c", np.asarray(J[names[kind]]))
    np.testing.assert_allclose(slope * INTENSITY, image, rtol=1e-5, atol=1e-7)
    doubled, _ = pj.jacobian(pj.with_parameters(scene, {names[kind]: 2 * INTENSITY}), list(names.values()), 16)
    np.testing.assert_allclose(doubled, 2 * np.asarray(image), rtol=1e-5, atol=1e-7)


def test_a_dark_light_has_a_derivative(make_scene):
    dark = FLOOR + emitter("point", color("intensity", 0, 0, 0) + vector("position", (0, 2, 0)))
    _, J = pj.jacobian(make_scene(dark, **VIEW), ["point.intensity"], 1)
    np.testing.assert_allclose(J["point.intensity"][0, 0], np.diag(reflected(0.25)), rtol=NEAR)


def test_places_and_angles_are_no_parameters(make_scene):
    scene = make_scene(FLOOR + BULB + SPOT + SUN)
    assert set(pj.parameters(scene)) == {
        "grey.reflectance",
        "point.intensity",
        "spot.intensity",
        "directional.irradiance",
    }
    with pytest.raises(pj.InputError, match="no parameter is named 'point.position'"):
        pj.with_parameters(scene, {"point.position": (0, 1, 0)})
    with pytest.raises(pj.InputError, match="outside its bounds"):
        pj.with_parameters(scene, {"spot.intensity": -1})


# ---- among other lights ---------------------------------------------------------------------------------------------

LAMP = plate(
    '<rotate x="1" angle="180"/>',
    '<scale value="0.3"/>',
    '<translate x="-1" y="1.5"/>',
    inside=emitter("area", color("radiance", 3, 2, 1)),
)
SKY = emitter("constant", color("radiance", 0.1, 0.2, 0.4))
LIGHTS = {
    "point": BULB,
    "second point": emitter("point", color("intensity", 0, 1, 9) + vector("position", (3, 1, 0.5)), "second"),
    "spot": SPOT,
    "second spot": spot(5, cone(8), 1).replace('id="spot"', 'id="beam"'),
    "directional": SUN,
    "second directional": emitter("directional", color("irradiance", 0, 2, 0) + vector("direction", (1, -1, 0)), "eve"),
    "area": LAMP,
    "constant": SKY,
}


@pytest.mark.parametrize("strategy", ["mis", pytest.param("light", marks=pytest.mark.slow)])
def test_lights_of_all_kinds_add_up(make_scene, estimate, agree, strategy):
    """z-test with the false-alarm rate of `agree`, 1e-4, since each sample chooses one light. One light alone is exact,
    except the lamp, and the sky that the lamp partly hides, which 16,384 samples estimate within `NEAR`."""
    together = make_scene(FLOOR + "".join(LIGHTS.values()), **VIEW)
    names = [name for name in pj.parameters(together) if not name.endswith("reflectance")]
    assert len(names) == len(LIGHTS)
    alone = [pj.with_parameters(together, dict.fromkeys({*names} - {name}, 0.0)) for name in names]
    expected = sum(np.asarray(pj.render(scene, 4096), float).mean((0, 1)) for scene in alone)
    kinds = ["area", "point", "spot", "constant", "directional"]
    assert [emitters.name(lights) for lights in together.emitters] == kinds
    agree(estimate(together, 1024, 24, strategy=strategy), expected, pixelwise=False, rounding=NEAR)


def test_terms_of_the_series_and_first_hits(make_scene):
    scene = make_scene(FLOOR + BULB, **VIEW)
    terms = np.asarray(pj.render_bounces(scene, 3, 4).terms)
    np.testing.assert_allclose(terms[1].mean((0, 1)), reflected(INTENSITY / 4), rtol=NEAR)
    assert not terms[0].any() and not terms[2].any()
    np.testing.assert_allclose(pj.render_aovs(scene, ["albedo"])["albedo"][0, 0], ALBEDO, rtol=1e-5)


def integral(falloff):
    """Integrate a function of the polar angle in degrees over the sphere."""
    theta = (np.arange(2_000_000) + 0.5) / 2_000_000 * np.pi
    return 2 * np.pi * np.sum(falloff(np.degrees(theta)) * np.sin(theta)) * np.pi / 2_000_000


def table(kind, dtype=np.float32, **values):
    return jax.device_put(kind.build([kind.instance("it", **values)], dtype, (), Parameters(), None))


@pytest.mark.parametrize("cutoff, beam", [(20, 15), (90, 0), (50, 50), (170, 20), (2, 1)])
def test_a_spot_is_chosen_by_the_root_of_its_share_of_directions(cutoff, beam):
    """This minimises the error of an image if all directions are equally visible."""
    made = table(Spot, intensity=(3, 3, 3), cutoff_angle=cutoff, beam_width=beam)
    share = integral(lambda a: np.interp(a, [beam, cutoff + 1e-9], [1, 0])) / (4 * np.pi)
    np.testing.assert_allclose(Spot.power(AllRows(made)), [4 * 3 * np.sqrt(share)], rtol=1e-3)


def test_the_narrowest_spot_has_some_power():
    """Otherwise it would never be chosen."""
    assert Spot.power(AllRows(table(Spot, cutoff_angle=1e-4)))[0] > 0


# ---- beside Mitsuba -------------------------------------------------------------------------------------------------


@pytest.fixture
def mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    return mi


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """File with an image of 4 x 6 texels."""
    texels = np.random.default_rng(1).random((4, 6, 3), np.float32)
    file = tmp_path_factory.mktemp("pictures") / "small.exr"
    write_exr(file, {channel: texels[..., k] for k, channel in enumerate("RGB")}, {})
    return file


def picture(name):
    return f'<texture type="bitmap" name="{name}"><string name="filename" value="PICTURE"/></texture>'


def lens(fov, axis="x"):
    return f'<float name="fov" value="{fov}"/><string name="fov_axis" value="{axis}"/>'


TURNED = lookat((0.3, 1, -0.4), (-1, 0.2, 0.5))


@pytest.mark.parametrize(
    "kind, inside",
    [
        (Point, vector("position", (0.3, 1, -0.4))),
        (Point, placed('<translate x="0.3"/>', '<scale value="-2"/>') + '<spectrum name="intensity" value="2"/>'),
        (Spot, TURNED + color("intensity", 3, 2, 1)),
        (Spot, TURNED + cone(60, 10)),
        (Spot, TURNED + cone(150)),
        (Spot, TURNED + cone(70, 70)),
        (Spot, placed('<scale x="3" y="3" z="-3"/>', '<translate z="1"/>') + cone(80)),
        (Directional, vector("direction", (1, -2, 3)) + color("irradiance", 3, 2, 1)),
        (Directional, TURNED),
        (Spot, TURNED + cone(60, 10) + color("intensity", 3, 2, 1) + picture("texture")),
        (Spot, placed('<scale x="-1"/>', '<rotate y="1" angle="40"/>') + cone(80) + picture("texture")),
        (Projector, TURNED + lens(fov=100)),
        (Projector, TURNED + lens(fov=80) + picture("irradiance") + '<float name="scale" value="3"/>'),
        (Projector, placed('<rotate y="1" angle="200"/>') + lens(fov=100, axis="y") + picture("irradiance")),
        (Projector, picture("irradiance") + '<string name="focal_length" value="12mm"/>'),
    ],
)
def test_what_arrives_is_what_mitsuba_says(make_scene, mitsuba, pictures, kind, inside):
    name = next(name for name, each in emitters.KINDS.items() if each is kind)
    text = emitter(name, inside.replace("PICTURE", str(pictures)))
    scene = make_scene(FLOOR + text)
    theirs = mitsuba.load_string(f'<scene version="3.0.0">{FLOOR}{text}</scene>').emitters()[0]
    (lights,) = scene.emitters
    refs = np.random.default_rng(3).normal(size=(50, 3))
    ours = jax.jit(lambda lights, refs: jax.vmap(lambda ref: kind.sample(lights.parameters(0), ref))(refs))
    ours = map(np.asarray, ours(lights, jnp.asarray(refs, jnp.float32)))
    for ref, d, distance, arriving in zip(refs, *ours, strict=True):
        at = mitsuba.SurfaceInteraction3f()
        at.p = list(ref)
        drawn, irradiance = theirs.sample_direction(at, [0.5, 0.5])
        np.testing.assert_allclose(d, np.array(drawn.d), atol=1e-6)
        np.testing.assert_allclose(arriving, np.array(irradiance), rtol=1e-4, atol=1e-5)
        assert np.isinf(distance) if kind.distant else np.isclose(distance, drawn.dist, rtol=1e-3)


def test_a_beam_wider_than_its_cone_ends_with_it(make_scene):
    wide, even = (make_scene(emitter("spot", cone(30, beam))) for beam in (50, 30))
    said = [each.about.description.emitters[0].values["beam_width"] for each in (wide, even)]
    assert said == [30, 30]
    assert any("is wider than cutoff_angle, 30" in note for note in wide.about.description.notes)


# ---- refusals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "light, words",
    [
        (emitter("point", color("intensity", 1, -1, 1)), "must not be negative"),
        (emitter("point", color("irradiance", 1, 1, 1)), "it has: sampling_weight, intensity, position, to_world"),
        (emitter("point", TURNED + vector("position", (0, 1, 0))), '"position" of .* excludes to_world'),
        (emitter("point", '<point name="position" x="1" y="2"/>'), 'lacks the attribute "z"'),
        (emitter("directional", vector("direction", (0, 0, 0))), "is the zero vector"),
        (emitter("directional", TURNED + vector("direction", (0, 1, 0))), '"direction" of .* excludes to_world'),
        (emitter("directional", color("intensity", 1, 1, 1)), "sampling_weight, irradiance, direction, to_world"),
        (emitter("spot", cone(180)), "must be above 0 and below 180, is 180"),
        (emitter("spot", cone(0)), "must be above 0 and below 180, is 0"),
        (emitter("spot", cone(None, -1)), "must be at least 0, is -1"),
        (emitter("spot", vector("position", (0, 1, 0))), "it has: to_world, beam_width, sampling_weight"),
        (emitter("spot", placed('<scale x="2"/>')), "scales unevenly"),
        (emitter("spot", cone(90) + '<rgb name="texture" value="1"/>'), "must be below 90 where a texture covers"),
        (emitter("projector", placed('<scale value="2"/>')), "scales or shears"),
        (emitter("projector", lens(180)), "above 0 and below 180"),
        (emitter("projector", color("irradiance", 1, -1, 1)), "must not be negative"),
        (emitter("projector", '<float name="scale" value="-1"/>'), "at least 0"),
        (emitter("spot", '<texture name="intensity" type="bitmap"/>'), "cannot be a <texture>"),
        (plate(inside=emitter("point")), "shines from no surface; it stands directly in <scene>"),
    ],
)
def test_bad_values_are_refused_with_file_line_and_cause(make_scene, light, words):
    with pytest.raises(pj.InputError, match=rf"\.xml:\d+: .*{words}"):
        make_scene(FLOOR + light)


def test_a_strategy_that_meets_no_such_light_is_refused(make_scene):
    """Without light samples the image would lack their light."""
    scene = make_scene(FLOOR + BULB + SUN + SKY)
    message = "'bsdf' misses all light of the point, directional emitters.*use one of mis, light$"
    for call in (
        lambda: pj.render(scene, 1, strategy="bsdf"),
        lambda: pj.jacobian(scene, ["grey.reflectance"], 1, strategy="bsdf"),
        lambda: pj.render_bounces(scene, 2, 1, strategy="bsdf"),
        lambda: pj.render_until(scene, spp=1, strategy="bsdf"),
    ):
        with pytest.raises(pj.InputError, match=message):
            call()


def test_transport_refuses_them_by_name(make_scene):
    for kind, light in {"point": BULB, "spot": SPOT, "directional": SUN}.items():
        with pytest.raises(pj.InputError, match=f"has a {kind} emitter"):
            transport.operator(make_scene(FLOOR + LAMP + light))
