"""Lights covered by textures: against the same light cut into pieces, and against Mitsuba."""

import jax
import numpy as np
import pytest

import pathjax as pj
from pathjax import transport
from pathjax.images import write_exr
from pathjax.media.gridvolume import write_vol

FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
  <bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf></shape>"""
VIEW = {"origin": "0, 1, 4", "target": "0, 0.5, 0", "res": 8, "depth": 3}
COLORS = np.array([[[5, 1, 0], [0, 2, 4]], [[0, 0, 0], [3, 3, 30]]], np.float32)


def lamp(inside, x=0.0, z=0.0, half=1.0, name="lamp"):
    """Return a square lamp above the floor that faces down; u grows with x, v with z."""
    return f"""<shape type="rectangle" id="{name}"><transform name="to_world"><rotate x="1" angle="90"/>
      <scale value="{half}"/><translate x="{x}" y="1.5" z="{z}"/></transform>{inside}</shape>"""


def volume_of(file, name="radiance"):
    return f"""<texture type="volume" name="{name}"><volume type="gridvolume" name="volume">
      <string name="filename" value="{file}"/><transform name="to_world"><translate x="-0.5" y="1" z="-0.5"/>
      <scale value="0.9"/></transform></volume></texture>"""


@pytest.fixture(scope="module")
def volume(tmp_path_factory):
    """A texture of twelve colours in space, around the lamp."""
    file = tmp_path_factory.mktemp("volumes") / "twelve.vol"
    write_vol(file, np.random.default_rng(2).random((2, 3, 2, 3)) * 5)
    return volume_of(file)


def area(inside):
    return f'<emitter type="area">{inside}</emitter>'


CHECKS = """<texture type="checkerboard" name="radiance" id="checks"><rgb name="color0" value="1, 0.5, 0"/>
  <rgb name="color1" value="0, 0.1, 0.9"/></texture>"""


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    """A texture of four texels, without interpolation."""
    file = tmp_path_factory.mktemp("pictures") / "four.exr"
    write_exr(file, {channel: COLORS[..., k] for k, channel in enumerate("RGB")}, {})
    return f"""<texture type="bitmap" name="radiance"><string name="filename" value="{file}"/>
      <string name="filter_type" value="nearest"/></texture>"""


def pieces():
    """Return the same light as four lamps of one colour each."""
    colors = ((COLORS[j, i], i, j) for j in (0, 1) for i in (0, 1))
    parts = []
    for color, i, j in colors:
        inside = area(f'<rgb name="radiance" value="{", ".join(map(str, color))}"/>')
        parts.append(lamp(inside, i - 0.5, j - 0.5, 0.5, f"lamp{i}{j}"))
    return "".join(parts)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["mis", "light"])
def test_a_picture_shines_as_its_texels_do(make_scene, picture, estimate, agree, strategy):
    whole, parts = make_scene(FLOOR + lamp(area(picture)), **VIEW), make_scene(FLOOR + pieces(), **VIEW)
    agree(estimate(whole, 64, strategy=strategy), estimate(parts, 64, first_seed=90))


def test_a_picture_is_seen_as_it_is(make_scene, picture):
    """The camera sees it from below."""
    scene = make_scene(lamp(area(picture)), origin="0, 0, 0", target="0, 1, 0", up="0, 0, 1", fov=10, res=2, depth=1)
    image = np.asarray(pj.render(scene, 16))
    expected = {tuple(color) for color in COLORS.reshape(-1, 3).tolist()}
    assert {tuple(color) for color in image.reshape(-1, 3).round(4).tolist()} == expected


def test_lights_are_chosen_by_the_mean_of_what_covers_them(make_scene, picture):
    both = lamp(area(picture)) + lamp(area('<rgb name="radiance" value="1, 1, 1"/>'), 5, name="other")
    (lights,) = make_scene(FLOOR + both).emitters
    power = COLORS.mean((0, 1)) @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(lights.power(), [4 * power, 4], rtol=1e-5)


def test_what_lights_are_chosen_by_follows_the_parameters_of_what_covers_them(make_scene, picture, volume, tmp_path):
    """For checkerboards of colours, numbers, images, volumes or checkerboards: as if the file had the new values."""
    board = '<texture type="checkerboard" name="{}" id="{}">{}</texture>'.format
    uniform = '<texture type="uniform" name="color1" id="even"><float name="value" value="0.25"/></texture>'
    inner = board("color0", "inner", '<rgb name="color0" value="0.5, 0, 0"/>' + uniform)
    outer = board("radiance", "outer", inner + picture.replace("radiance", "color1"))
    mixed = board("radiance", "mixed", volume.replace("radiance", "color0"))
    covers = [CHECKS, outer, picture.replace("nearest", "bilinear"), volume.replace("0.9", "0.8"), mixed]
    scene = make_scene(FLOOR + "".join(lamp(area(each), 3 * k, name=f"l{k}") for k, each in enumerate(covers)))
    about = scene.about.parameters
    names = [name for name in pj.parameters(scene) if about[name].means]
    assert len(names) == 9
    random = np.random.default_rng(1)
    moved = pj.with_parameters(scene, {name: np.float32(random.random(about[name].shape)) for name in names})
    pj.save_scene(moved, tmp_path / "moved.xml")
    (lights,), (loaded,) = moved.emitters, pj.load_scene(tmp_path / "moved.xml").emitters
    np.testing.assert_allclose(lights.power(), loaded.power(), rtol=1e-6)


def test_a_light_that_was_black_is_found_by_light_samples(make_scene):
    """Beside another light, the only one with power when the scene was loaded."""
    black = CHECKS.replace("1, 0.5, 0", "0").replace("0, 0.1, 0.9", "0").replace("radiance", "irradiance")
    aimed = '<transform name="to_world"><lookat origin="0, 2, 0" target="0, 0, 0" up="0, 0, 1"/></transform>'
    projector = f'<emitter type="projector">{aimed}{black}</emitter>'
    point = '<emitter type="point"><point name="position" value="0, 2, 0"/><rgb name="intensity" value="1"/></emitter>'
    scene = make_scene(FLOOR + projector + point, **VIEW)
    moved = pj.with_parameters(scene, {f"checks.color{k}": np.ones(3) for k in (0, 1)})
    dark, lit = (np.asarray(pj.render(each, 16)).mean() for each in (scene, moved))
    assert lit > 1.1 * dark > 0


@pytest.mark.slow
def test_images_are_linear_in_the_colours_of_a_light(make_scene):
    scene = make_scene(FLOOR + lamp(area(CHECKS)), **VIEW)
    names = ["checks.color0", "checks.color1"]
    assert set(names) <= pj.parameters(scene).keys()
    image, J = pj.jacobian(scene, names, 16)
    values = pj.parameters(scene)
    total = sum(np.asarray(J[name]) @ np.asarray(values[name]) for name in names)
    np.testing.assert_allclose(total, image, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_texels_of_a_floor_under_such_a_light_are_differentiated(make_scene, picture):
    """The sweep over paths against differences; images of one bounce are nearly linear in albedos."""
    reflectance = picture.replace("radiance", "reflectance").replace("four", "floor")
    file = reflectance.split('value="')[1].split('"')[0]
    write_exr(file, {channel: np.full((2, 2), 0.5, np.float32) for channel in "RGB"}, {})
    floor = FLOOR.replace('<rgb name="reflectance" value="0.2, 0.5, 0.8"/>', reflectance)
    scene = make_scene(floor + lamp(area(picture)), **VIEW | {"depth": 2})

    def total(texels):
        return pj.render(pj.with_parameters(scene, {"floor.reflectance": texels}), 16).sum()

    texels = pj.parameters(scene)["floor.reflectance"]
    slope = np.asarray(jax.grad(total)(texels))
    np.testing.assert_allclose(np.sum(slope * 0.5), total(texels) - total(0 * texels), rtol=1e-4)


def test_what_cannot_cover_a_light_is_refused(make_scene, tmp_path):
    shared = CHECKS.replace('name="radiance"', "")
    floor = FLOOR.replace('<rgb name="reflectance" value="0.2, 0.5, 0.8"/>', '<ref name="reflectance" id="checks"/>')
    with pytest.raises(pj.InputError, match="of a texture of a bsdf and of a light; give each a texture of its own"):
        make_scene(shared + floor + lamp(area('<ref name="radiance" id="checks"/>')))
    write_exr(tmp_path / "inf.exr", {channel: np.full((2, 2), np.inf, np.float32) for channel in "RGB"}, {})
    inf = f"""<texture type="bitmap" name="radiance"><string name="filename" value="{tmp_path}/inf.exr"/></texture>"""
    with pytest.raises(pj.InputError, match="values below 0, inf or NaN"):
        make_scene(FLOOR + lamp(area(inf)))
    attribute = '<texture type="mesh_attribute" name="radiance"><string name="name" value="vertex_color"/></texture>'
    with pytest.raises(pj.InputError, match="without a mean over uv"):
        make_scene(FLOOR + lamp(area(attribute)))
    with pytest.raises(pj.InputError, match="a light with a texture; a patch has one radiance"):
        transport.operator(make_scene(FLOOR + lamp(area(CHECKS))))


@pytest.mark.slow
@pytest.mark.parametrize("cover", ["picture", "volume"])
def test_light_samples_find_what_bsdf_samples_do(make_scene, request, estimate, agree, cover):
    """For a cube, whose faces share one image."""
    cover = request.getfixturevalue(cover)
    scene = make_scene(FLOOR + lamp(area(cover), half=0.4).replace('"rectangle"', '"cube"'), **VIEW)
    agree(estimate(scene, 256, strategy="bsdf"), estimate(scene, 256, strategy="light", first_seed=90))


@pytest.mark.slow
@pytest.mark.parametrize("kind, inside", [("rectangle", "picture"), ("sphere", "picture"), ("sphere", "volume")])
def test_images_are_mitsubas(make_scene, write_scene, request, estimate, estimate_type, agree, kind, inside):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    turned = '<transform name="to_uv"><rotate z="1" angle="30"/><scale x="2" y="3"/></transform></texture>'
    cover = request.getfixturevalue(inside)
    cover = cover.replace("</texture>", turned) if inside == "picture" else cover
    light = lamp(area(cover), half=0.4).replace('"rectangle"', f'"{kind}"')
    body = FLOOR + light
    theirs = mi.load_file(str(write_scene(body, **VIEW)))
    images = np.stack([np.array(mi.render(theirs, spp=128, seed=seed), float) for seed in range(16)])
    theirs = estimate_type(images.mean(0), images.var(0, ddof=1) / len(images), len(images))
    agree(estimate(make_scene(body, **VIEW), 128), theirs)
