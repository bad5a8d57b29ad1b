"""Kinds of light registered by a user's script: read from scene files, rendered, and differentiated."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import emitters, transport
from pathjax.core.math import dot, luminance, safe_sqrt
from pathjax.core.warp import SPHERE_PDF, square_to_sphere
from pathjax.kinds import Color, Number


class Bulb(emitters.DiracEmitter):
    """A point light at (0, height, 0)."""

    intensity = Color(1.0, bounds=(0, math.inf), textured=False, radiance=True)  # W / sr
    height = Number(0.0)

    @staticmethod
    def power(p):
        return 4 * luminance(p.intensity)

    @staticmethod
    def sample(p, ref):
        to_light = jnp.stack([jnp.zeros_like(p.height), p.height, jnp.zeros_like(p.height)]) - ref
        squared = dot(to_light, to_light)
        distance = safe_sqrt(squared)
        return to_light / distance, distance, p.intensity / squared


class Sun(emitters.DiracEmitter):
    """A distant light from straight above."""

    irradiance = Color(1.0, bounds=(0, math.inf), textured=False, radiance=True)
    distant = True

    @staticmethod
    def power(p):
        return luminance(p.irradiance) / math.pi

    @staticmethod
    def sample(p, ref):
        return jnp.stack([ref[0] * 0, ref[0] * 0 + 1, ref[0] * 0]), jnp.full_like(ref[0], jnp.inf), p.irradiance


class Dome(emitters.Background):
    """1 at the zenith, 0 at the horizon and below; sampled over the sphere."""

    radiance = Color(1.0, bounds=(0, math.inf), textured=False, radiance=True)

    @staticmethod
    def power(p):
        return luminance(p.radiance) / 4

    @staticmethod
    def sample(p, u, u_part):
        return square_to_sphere(u)

    @staticmethod
    def emitted(p, d):
        return p.radiance * jnp.maximum(d[1], 0)

    @staticmethod
    def density(p, d):
        return jnp.full_like(d[0], SPHERE_PDF)


class Tinted(emitters.SurfaceEmitter):
    """Green seen along y, red seen across y."""

    strength = Number(1.0, bounds=(0, math.inf))

    @staticmethod
    def power(p):
        return p.strength

    @staticmethod
    def emitted(p, d):
        return p.strength * jnp.stack([1 - jnp.abs(d[1]), jnp.abs(d[1]), 0 * d[1]])


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(emitters, "KINDS", dict(emitters.KINDS))
    for name, kind in {"bulb": Bulb, "sun": Sun, "dome": Dome, "tinted": Tinted}.items():
        emitters.register(name)(kind)


FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/>{}</transform>
  <bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.5"/></bsdf></shape>"""
# The point (0, 0, 0) of the floor, seen obliquely from above.
VIEW = {"origin": "1, 2, 1", "fov": 0.01, "res": 2, "depth": 2}


def emitter(kind, inside=""):
    return f'<emitter type="{kind}" id="{kind}">{inside}</emitter>'


def color(name, value):
    return f'<rgb name="{name}" value="{value}"/>'


BULB = emitter("bulb", color("intensity", "6, 3, 0") + '<float name="height" value="2"/>')
SUN = emitter("sun", color("irradiance", "1, 2, 3"))
DOME = emitter("dome", color("radiance", "0.3, 0.6, 0.9"))
SKY = emitter("constant", color("radiance", "0.1, 0.2, 0.4"))
# Radiance of a floor of albedo rho: rho / pi times the irradiance I / h^2; E; L integral of cos^2 = L 2 pi / 3; pi L.
ANSWERS = {
    BULB: 0.5 / np.pi * np.array([6, 3, 0]) / 4,
    SUN: 0.5 / np.pi * np.array([1, 2, 3]),
    DOME: 0.5 / np.pi * np.array([0.3, 0.6, 0.9]) * 2 * np.pi / 3,
    SKY: 0.5 * np.array([0.1, 0.2, 0.4]),
}


@pytest.mark.parametrize("light", [BULB, SUN])
@pytest.mark.parametrize("strategy", ["mis", pytest.param("light", marks=pytest.mark.slow)])
def test_a_dirac_light_alone_leaves_no_noise(make_scene, light, strategy):
    image = pj.render(make_scene(FLOOR.format("") + light, **VIEW), 1, strategy=strategy)
    np.testing.assert_allclose(image, np.broadcast_to(ANSWERS[light], image.shape), rtol=1e-4)


@pytest.mark.parametrize("strategy", ["mis", "light"])
def test_lights_of_all_kinds_add_up(make_scene, estimate, agree, strategy):
    """Two Dirac lights and two backgrounds, one of which is sampled by one strategy only."""
    scene = make_scene(FLOOR.format('<scale value="9"/>') + SKY + BULB + DOME + SUN, **VIEW)
    assert [emitters.name(lights) for lights in scene.emitters] == ["bulb", "constant", "sun", "dome"]
    agree(estimate(scene, 64, 16, strategy=strategy), sum(ANSWERS.values()), pixelwise=False)


def test_backgrounds_of_one_kind_add_up_and_are_parameters_each(make_scene):
    twice = SKY + SKY.replace("0.1, 0.2, 0.4", "0.3, 0, 0.1").replace('id="constant"', 'id="second"')
    scene = make_scene(twice, res=2)
    image, J = pj.jacobian(scene, ["constant.radiance", "second.radiance"], 1)
    np.testing.assert_allclose(image, np.broadcast_to([0.4, 0.2, 0.5], (2, 2, 3)), rtol=1e-6)
    for derivative in J.values():
        np.testing.assert_allclose(derivative, np.broadcast_to(np.eye(3), (2, 2, 3, 3)), rtol=1e-6)


def test_the_parameters_of_a_registered_kind_are_differentiated(make_scene):
    scene = make_scene(FLOOR.format("") + BULB, **VIEW)
    assert {"bulb.intensity", "bulb.height"} <= set(pj.parameters(scene))
    _, J = pj.jacobian(scene, ["bulb.intensity", "bulb.height"], 1)
    np.testing.assert_allclose(J["bulb.intensity"][0, 0], np.eye(3) * 0.5 / np.pi / 4, rtol=1e-4)
    # d/dh of I / h^2 is -2 / h times I / h^2, with h = 2.
    np.testing.assert_allclose(J["bulb.height"][0, 0], -ANSWERS[BULB], rtol=1e-3)


LAMP = '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/>{}</transform>{}</shape>'


@pytest.mark.parametrize("strategy", ["mis", pytest.param("light", marks=pytest.mark.slow)])
def test_two_kinds_of_lamp_are_sampled_and_hit_as_one_another(make_scene, estimate, agree, strategy):
    """Images equal those of bsdf sampling alone; the lamps are a sphere of one kind and a rectangle of the other."""
    body = FLOOR.format('<scale value="9"/>') + LAMP.format('<translate y="2" x="1"/>', emitter("area"))
    body += '<shape type="sphere"><point name="center" x="-2" y="3" z="0"/>' + emitter("tinted") + "</shape>"
    scene = make_scene(body, **VIEW)
    assert [emitters.name(lights) for lights in scene.emitters] == ["area", "tinted"]
    alone = estimate(scene, 1024, 16, strategy="bsdf")
    agree(estimate(scene, 256, 16, strategy=strategy), alone, pixelwise=False)


def test_a_name_is_taken_once():
    with pytest.raises(pj.InputError, match="taken by Area"):
        emitters.register("area")(Bulb)
    with pytest.raises(pj.InputError, match="must be a class derived from emitters.Emitter"):
        emitters.register("other")(dict)


def test_transport_refuses_lights_that_are_not_even(make_scene):
    with pytest.raises(pj.InputError, match="tinted emitter"):
        transport.operator(make_scene(LAMP.format("", emitter("tinted"))))


def test_lights_without_parameters_or_with_textures_are_refused():
    class Nothing(emitters.Background):
        pass

    class Textured(emitters.Background):
        radiance = Color(1.0)

    for kind, complaint in ((Nothing, "declares nothing"), (Textured, "textured parameter")):
        with pytest.raises(pj.InputError, match=complaint):
            emitters.register("mine")(kind)
