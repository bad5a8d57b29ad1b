"""Every parameter of every kind, in one scene or more per kind: derivatives by `check_gradient`, images by Mitsuba.

A correct derivative fails with probability 1e-3 each; seeds are fixed.
"""

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs, emitters, media, textures
from pathjax.bsdfs.ior import LEAST_IOR
from pathjax.sensors.film import image_shape

SEEDS = 16
# Samples per pixel of the first check, and at most: enough to detect a relative error of RESOLUTION half of the time.
SPP, MOST_SPP = 64, 2048
RESOLUTION = 0.15
# Its square overflows float32.
LARGE_IOR = 1e30

# The surroundings. Their parameters, named "around-...", are checked in the cases of their own kinds.
FLOOR = """<shape type="rectangle"><transform name="to_world"><scale value="3"/><rotate x="1" angle="-90"/>
  <translate y="-1"/></transform><bsdf type="diffuse" id="around-floor"><texture type="checkerboard" name="reflectance">
  <rgb name="color0" value="0.7, 0.6, 0.5"/><rgb name="color1" value="0.2, 0.3, 0.4"/>
  <transform name="to_uv"><scale value="3"/></transform></texture></bsdf></shape>"""
AROUND = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/>
  <translate x="1" y="2.5" z="1"/></transform><bsdf type="diffuse" id="around-lamp"/>
  <emitter type="area" id="around-light">
  <rgb name="radiance" value="{}"/></emitter></shape>
  <emitter type="constant" id="around-sky"><rgb name="radiance" value="{}"/></emitter>"""
# Roughness shows best under LAMP, whose sky is dark; smooth surfaces are noisy in its light.
LIGHT, LAMP = AROUND.format("4, 3, 2", "0.4, 0.5, 0.6"), AROUND.format("20, 16, 12", "0.1, 0.15, 0.2")
BALL = '<shape type="sphere"><float name="radius" value="0.9"/>{}</shape>'
PANE = '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="25"/></transform>{}</shape>'
TINTED = '<shape type="ply"><string name="filename" value="meshes/tinted.ply"/>{}</shape>'
GREY = '<bsdf type="diffuse" id="around-grey"/>'
GLASS = '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'
METAL = '<rgb name="eta" value="0.2, 0.9, 1.1"/><rgb name="k" value="3.9, 2.4, 2.2"/>'
SPECULAR = '<rgb name="specular_reflectance" value="0.9, 0.7, 0.5"/>'
TRANSMITTED = '<rgb name="specular_transmittance" value="0.5, 0.7, 0.9"/>'
GGX = '<string name="distribution" value="ggx"/>'
PICTURE = """<texture type="bitmap" name="{}"><string name="filename" value="textures/marks.png"/>
  <boolean name="raw" value="true"/></texture>"""


def bsdf(kind, *inside):
    return f'<bsdf type="{kind}" id="it">{"".join(inside)}</bsdf>'


def numbers(**values):
    return "".join(f'<float name="{name}" value="{value}"/>' for name, value in values.items())


def rgb(name, value="0.6, 0.4, 0.7"):
    return f'<rgb name="{name}" value="{value}"/>'


def filled(*of_medium):
    medium = f'<medium type="homogeneous" name="interior" id="it">{"".join(of_medium)}</medium>'
    return LIGHT + BALL.format(f'<bsdf type="null"/>{medium}')


def grid(name, file):
    place = '<transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2.6"/></transform>'
    file = f'<string name="filename" value="textures/{file}.vol"/>'
    return f'<volume name="{name}" type="gridvolume">{file}{place}</volume>'


def lit(*emitter):
    return LIGHT + "".join(emitter) + BALL.format(GREY)


def lights(of_bsdf):
    return LAMP if any(word in text for text in of_bsdf for word in ("alpha", "roughness")) else LIGHT


def on_ball(*of_bsdf):
    return lights(of_bsdf) + BALL.format(bsdf(*of_bsdf))


def on_pane(*of_bsdf):
    return lights(of_bsdf) + PANE.format(bsdf(*of_bsdf))


AIMED = '<transform name="to_world"><lookat origin="1, 2, 3" target="0, 0, 0" up="0, 1, 0"/></transform>'
# Mitsuba accepts no colours above 1 here.
SIGMA = rgb("sigma_t", "0.125, 0.5, 1") + numbers(scale=4)
SHEEN = numbers(sheen=0.5, sheen_tint=0.4)
CASES = {
    "diffuse": on_ball("diffuse", rgb("reflectance")),
    "conductor": on_ball("conductor", METAL, SPECULAR),
    "roughconductor": on_ball("roughconductor", METAL, SPECULAR, numbers(alpha=0.3)),
    "roughconductor, ggx": on_ball("roughconductor", GGX, METAL, numbers(alpha=0.1)),
    "roughconductor, brushed": on_ball("roughconductor", METAL, numbers(alpha_u=0.4, alpha_v=0.2)),
    "roughconductor, brushed ggx": on_ball("roughconductor", GGX, METAL, numbers(alpha_u=0.1, alpha_v=0.4)),
    "dielectric": on_ball("dielectric", GLASS, SPECULAR, TRANSMITTED),
    "dielectric, of an ellipsoid": LIGHT
    + '<shape type="shapegroup" id="ball">'
    + BALL.format(bsdf("dielectric", GLASS, SPECULAR, TRANSMITTED))
    + '</shape><shape type="instance"><ref id="ball"/><transform name="to_world"><scale x="1.2" y="0.7"/>'
    '<rotate z="1" angle="20"/></transform></shape>',
    "thindielectric": on_pane("thindielectric", GLASS, SPECULAR, TRANSMITTED),
    "thindielectric, passed": on_pane("thindielectric", GLASS, SPECULAR),
    "roughdielectric": on_ball("roughdielectric", GLASS, SPECULAR, TRANSMITTED, numbers(alpha=0.3)),
    "roughdielectric, ggx": on_ball("roughdielectric", GGX, GLASS, numbers(alpha=0.15)),
    "roughdielectric, bubble": on_ball("roughdielectric", numbers(int_ior=1.0, ext_ior=1.33, alpha=0.3)),
    "roughdielectric, brushed": on_pane("roughdielectric", GGX, GLASS, numbers(alpha_u=0.1, alpha_v=0.3)),
    "plastic": on_ball("plastic", GLASS, SPECULAR, rgb("diffuse_reflectance")),
    "plastic, nonlinear": on_ball("plastic", '<boolean name="nonlinear" value="true"/>', rgb("diffuse_reflectance")),
    "roughplastic": on_ball("roughplastic", GLASS, SPECULAR, rgb("diffuse_reflectance"), numbers(alpha=0.2)),
    "roughplastic, ggx": on_ball("roughplastic", GGX, GLASS, rgb("diffuse_reflectance"), numbers(alpha=0.3)),
    "pplastic": on_ball("pplastic", GLASS, SPECULAR, rgb("diffuse_reflectance"), numbers(alpha=0.2)),
    "pplastic, brushed ggx": on_ball("pplastic", GGX, rgb("diffuse_reflectance"), numbers(alpha_u=0.4, alpha_v=0.2)),
    "null": on_pane("null"),
    "principled": on_ball(
        "principled",
        rgb("base_color"),
        numbers(roughness=0.4, anisotropic=0.5, metallic=0.4, specular=0.6, spec_tint=0.3, flatness=0.4),
        SHEEN,
    ),
    "principled, coated": on_ball(
        "principled", rgb("base_color", "0.05"), numbers(roughness=0.9, specular=0.1, clearcoat=1, clearcoat_gloss=0.2)
    ),
    "principled, clear": on_ball(
        "principled", rgb("base_color"), numbers(roughness=0.5, spec_trans=0.7, eta=1.4, metallic=0.2), SHEEN
    ),
    "principledthin": on_pane(
        "principledthin",
        rgb("base_color"),
        numbers(roughness=0.5, anisotropic=0.4, spec_trans=0.4, eta=1.4, spec_tint=0.3, flatness=0.3, diff_trans=0.8),
        SHEEN,
    ),
    "twosided": LIGHT + PANE.format(f'<bsdf type="twosided">{bsdf("diffuse", rgb("reflectance"))}</bsdf>'),
    "blendbsdf": on_ball("blendbsdf", numbers(weight=0.4), GREY, '<bsdf type="roughconductor" id="around-metal"/>'),
    "mask": on_pane("mask", numbers(opacity=0.4), f'<bsdf type="twosided">{GREY}</bsdf>'),
    "polarizer": on_pane("polarizer", numbers(transmittance=0.7)),
    "circular": on_pane("circular", numbers(transmittance=0.8)),
    "retarder": on_pane("retarder", numbers(transmittance=0.6)),
    "bumpmap": on_ball(
        "bumpmap",
        '<texture type="bitmap"><string name="filename" value="textures/heights.png"/></texture>',
        bsdf("diffuse", rgb("reflectance")).replace("it", "held"),
    ),
    "normalmap": on_ball(
        "normalmap",
        '<texture type="bitmap" name="normalmap"><string name="filename" value="textures/normals.png"/>'
        '<boolean name="raw" value="true"/></texture>',
        bsdf("roughconductor", METAL, numbers(alpha=0.3)).replace("it", "held"),
    ),
    "checkerboard": on_ball(
        "diffuse", f'<texture type="checkerboard" name="reflectance">{rgb("color0")}{rgb("color1", "0.2")}</texture>'
    ),
    "checkerboard, of textures": on_ball(
        "diffuse",
        f'<texture type="checkerboard" name="reflectance">{PICTURE.format("color0")}<texture type="checkerboard" '
        f'name="color1" id="board">{rgb("color0")}<transform name="to_uv"><scale x="9" y="5"/></transform></texture>'
        '<transform name="to_uv"><scale x="2" y="1.5"/></transform></texture>',
    ),
    "bitmap": on_ball("diffuse", PICTURE.format("reflectance")),
    "bitmap, in a metal": on_ball("roughconductor", METAL, PICTURE.format("specular_reflectance"), numbers(alpha=0.3)),
    "bitmap, in a number": on_ball("roughconductor", GGX, METAL, PICTURE.format("alpha")),
    "bitmap, in a weight": on_ball(
        "blendbsdf", PICTURE.format("weight"), GREY, bsdf("conductor").replace("it", "held")
    ),
    "uniform": on_ball(
        "diffuse", '<texture type="uniform" name="reflectance"><float name="value" value="0.4"/></texture>'
    ),
    "volume": on_ball("diffuse", f'<texture type="volume" name="reflectance">{grid("volume", "tints")}</texture>'),
    "volume, in a number": on_ball(
        "roughconductor", METAL, f'<texture type="volume" name="alpha">{grid("volume", "tints")}</texture>'
    ),
    "mesh_attribute": LIGHT
    + TINTED.format(
        '<bsdf type="diffuse" id="it"><texture type="mesh_attribute" name="reflectance"><string name="name" '
        'value="vertex_color"/><float name="scale" value="0.8"/></texture></bsdf>'
    ),
    "homogeneous": filled(rgb("sigma_t", "0.5, 0.8, 1"), rgb("albedo"), numbers(scale=1.5)),
    "homogeneous, absorbing": filled(rgb("sigma_t", "0.5, 0.8, 1"), rgb("albedo", "0")),
    "heterogeneous": filled(
        '<volume name="sigma_t" type="constvolume"><rgb name="value" value="0.5, 0.8, 1"/><transform name="to_world">'
        '<translate x="-0.5" y="-0.5" z="-0.5"/><scale value="4"/></transform></volume>',
        rgb("albedo"),
        numbers(scale=1.5),
    ).replace('"homogeneous"', '"heterogeneous"'),
    # Grids of one channel and of three, which shadow rays cross one after the other.
    "heterogeneous, of grids": filled(grid("sigma_t", "cloud"), grid("albedo", "tints"), numbers(scale=1.5)).replace(
        '"homogeneous"', '"heterogeneous"'
    )
    + '<shape type="sphere"><point name="center" value="0.8, 1.1, 0.3"/><float name="radius" value="0.4"/>'
    f'<bsdf type="null"/><medium type="heterogeneous" name="interior" id="its">{grid("sigma_t", "tints")}'
    f"{numbers(scale=4)}</medium></shape>",
    "isotropic": filled(SIGMA, rgb("albedo"), '<phase type="isotropic"/>'),
    "hg": filled(rgb("sigma_t", "1"), rgb("albedo"), f'<phase type="hg" id="phase">{numbers(g=0.6)}</phase>'),
    "blendphase": filled(
        rgb("sigma_t", "1"),
        rgb("albedo"),
        f'<phase type="blendphase" id="phase">{numbers(weight=0.3)}<phase type="isotropic"/>'
        f'<phase type="hg" id="held">{numbers(g=0.6)}</phase></phase>',
    ),
    "tabphase": filled(
        SIGMA, rgb("albedo"), '<phase type="tabphase"><string name="values" value="0.3, 0.1, 0.2, 0.5, 2"/></phase>'
    ),
    "rayleigh": filled(SIGMA, rgb("albedo"), '<phase type="rayleigh"/>'),
    "area": BALL.format(GREY)
    + '<shape type="sphere"><point name="center" value="1, 1, 1"/><float name="radius" value="0.5"/>'
    f'<bsdf type="diffuse" id="around-lamp"/><emitter type="area" id="it">{rgb("radiance", "4, 3, 2")}</emitter>'
    "</shape>",
    "area, with a picture": BALL.format(GREY)
    + PANE.format(
        f'<bsdf type="diffuse" id="around-lamp"/><emitter type="area" id="it">{PICTURE.format("radiance")}</emitter>'
    ),
    "constant": BALL.format(GREY) + f'<emitter type="constant" id="it">{rgb("radiance")}</emitter>',
    "envmap": BALL.format(GREY) + '<emitter type="envmap" id="it"><string name="filename" value="textures/marks.png"/>'
    '<float name="scale" value="0.7"/></emitter>',
    "sunsky": BALL.format(GREY)
    + '<emitter type="sunsky" id="it"><vector name="sun_direction" value="1, 2, 3"/></emitter>',
    "point": lit(
        f'<emitter type="point" id="it">{rgb("intensity", "5, 4, 3")}<point name="position" value="0, 2, 1"/></emitter>'
    ),
    "spot": lit(f'<emitter type="spot" id="it">{rgb("intensity", "9, 8, 7")}{AIMED}</emitter>'),
    "spot, covered": lit(
        f'<emitter type="spot" id="it">{rgb("intensity", "9, 8, 7")}{AIMED}{rgb("texture", "0.3, 0.6, 0.9")}</emitter>'
    ),
    "spot, with a picture": lit(
        f'<emitter type="spot" id="it">{rgb("intensity", "9, 8, 7")}{AIMED}{PICTURE.format("texture")}</emitter>'
    ),
    "directional": lit(f'<emitter type="directional" id="it">{rgb("irradiance")}{AIMED}</emitter>'),
    "projector": lit(
        f'<emitter type="projector" id="it">{PICTURE.format("irradiance")}{numbers(scale=9)}{AIMED}</emitter>'
    ),
}


@pytest.fixture(scope="module")
def file_of(write_scene, root):
    @cache
    def file(case):
        text = (CASES[case] + FLOOR).replace('"textures/', f'"{root}/tests/scenes/textures/')
        path = write_scene(text, res=16, depth=5, origin="0, 1, 3.5", fov=45)
        if "<medium" in text or case.endswith("passed"):
            path.write_text(path.read_text().replace('<integrator type="path">', '<integrator type="volpath">'))
        return path

    return file


@pytest.fixture(scope="module")
def scene_of(file_of):
    return cache(lambda case: pj.load_scene(file_of(case)))


def checked(scene):
    return [name for name in pj.parameters(scene) if not name.startswith("around-")]


def test_every_kind_has_a_scene_here():
    kinds = [*bsdfs.KINDS, *textures.KINDS, *emitters.KINDS, *media.KINDS, *media.PHASES]
    assert {case.split(",")[0] for case in CASES} == set(kinds)


def test_every_parameter_that_a_kind_declares_is_checked(scene_of):
    fields = {name.split(".")[1] for case in CASES for name in checked(scene_of(case))}
    rooms = bsdfs.KINDS, emitters.KINDS, textures.KINDS, media.KINDS, media.PHASES
    kinds = [kind for room in rooms for kind in room.values()]
    declared = {name for kind in kinds for name, each in kind.declared.items() if each.listed}
    assert declared <= fields


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case != "null"])  # it has no parameters
def test_derivatives_are_those_of_differences(scene_of, case):
    scene = scene_of(case)
    names, values = checked(scene), pj.parameters(scene)
    known = scene.about.parameters
    numbers = [name for name in names if not known[name].is_texture and not known[name].moves_paths]

    @cache
    def jacobian(spp, seed):
        return pj.jacobian(scene, numbers, spp, seed)[1]

    def check(name, spp):
        if name not in numbers:
            return pj.check_gradient(scene, name, spp, seeds=SEEDS)

        def image(theta, seed):
            return pj.render(pj.with_parameters(scene, {name: theta}), spp, seed)

        def derivative(theta, v, seed):
            return np.tensordot(jacobian(spp, seed)[name], v, v.ndim)

        return pj.check_gradient(image, values[name], derivative=derivative, bounds=known[name].bounds, seeds=SEEDS)

    found = {}
    for name in names:
        found[name] = check(name, SPP)
        if found[name].passed and found[name].resolution > RESOLUTION:
            # A power of two, so that parameters share Jacobians.
            more = 2 ** math.ceil(2 * math.log2(found[name].resolution / RESOLUTION) + 0.5)
            found[name] = check(name, min(SPP * more, MOST_SPP))
    told = {
        name: f"|z| {abs(c.z).max():.1f}, p {c.p_value:.2g}, resolves {c.resolution:.2g}" for name, c in found.items()
    }
    print(case, told)
    assert all(check.passed and check.resolution < 2 * RESOLUTION for check in found.values()), told


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_no_derivative_is_nan(scene_of, case):
    """For a million paths at the scene's values, and fewer with each constant, or all parameters, at their bounds."""
    scene = scene_of(case)
    known, values = scene.about.parameters, pj.parameters(scene)
    names = [name for name in values if not known[name].moves_paths]
    # Values below `least` are treated as `least`, so they have no derivative.
    least = {name: max(known[name].bounds[0], np.nextafter(np.float32(known[name].least), np.inf)) for name in names}
    ends = {name: [least[name], known[name].bounds[1]] for name in names}
    ends |= {name: [least[name], LARGE_IOR] for name in names if known[name].bounds == (LEAST_IOR, np.inf)}
    ends = {name: [np.full_like(values[name], end) for end in each if np.isfinite(end)] for name, each in ends.items()}
    lowest, highest = ({name: each[i] for name, each in ends.items() if each[i:]} for i in (0, -1))
    single = [{name: end} for name, each in ends.items() for end in each if not known[name].is_texture]
    v = jnp.asarray(np.random.default_rng(1).normal(size=(*image_shape(scene.film), 3)), jnp.float32)

    def wrong(changed, spp, seed):
        at = pj.with_parameters(scene, changed)
        start = {name: jnp.asarray(pj.parameters(at)[name]) for name in names}
        pull = jax.vjp(lambda values: pj.render(pj.with_parameters(at, values), spp, seed), start)[1]
        return [name for name, slope in pull(v)[0].items() if not np.isfinite(slope).all()]

    assert not wrong({}, 4096, 0)
    assert not {str(each): found for each in (lowest, highest, *single) if (found := wrong(each, 64, 1))}


# Mitsuba's spot takes no colour as its texture, and its blend of a mirror loses light, unlike the sum of two images.
ALIKE = [case for case in CASES if case not in ("spot, covered", "bitmap, in a weight")]


@pytest.mark.slow
@pytest.mark.parametrize("case", ALIKE)
def test_images_are_those_of_mitsuba(file_of, scene_of, mitsuba, estimate, agree, case):
    """If both are right, all cases pass, except in one of 1000 runs.

    Rounding shifts edges and contacts between the two programs, which the tolerance allows for.
    """
    theirs = mitsuba(file_of(case), SPP, SEEDS)
    agree(estimate(scene_of(case), SPP, SEEDS), theirs, rounding=1e-3, false_alarm=1e-3 / len(ALIKE))
