"""Spectra in scene files become the same linear RGB as in Mitsuba's RGB mode."""

from __future__ import annotations

import numpy as np
import pytest

import pathjax as pj
from pathjax.description import spectra
from pathjax.errors import InputError

# One parameter per way to convert a spectrum: reflectances are bounded, the IORs of metals are not, radiances are not
# seen under an illuminant.
PLACES = {
    "reflectance": '<shape type="sphere"><bsdf type="diffuse" id="it">{}</bsdf></shape>',
    "eta": '<shape type="sphere"><bsdf type="conductor" id="it">{}<float name="k" value="1"/></bsdf></shape>',
    "radiance": '<emitter type="constant" id="it">{}</emitter>',
}
SPECTRA = [
    '<spectrum name="NAME" value="400:0.1, 500:0.2 600:0.3, 700:0.5"/>',
    '<spectrum name="NAME" value="360:0.2, 830:0.2"/>',
    '<spectrum name="NAME" value="200:0.9, 450.5:0.2, 1100:0.7"/>',
    '<spectrum name="NAME" value="550:1, 560:1"/>',
    '<spectrum name="NAME" value="100:0.1, 200:0.3"/>',
    '<spectrum name="NAME" value="400:-0.1, 500:0.2"/>',
    '<spectrum name="NAME" filename="FOLDER/lamp.spd"/>',
    '<spectrum name="NAME" value="0.5"/>',
    '<spectrum name="NAME" type="uniform"><float name="value" value="0.5"/></spectrum>',
    '<spectrum name="NAME" type="d65"/>',
    '<spectrum name="NAME" type="d65"><float name="scale" value="0.25"/></spectrum>',
    '<spectrum name="NAME" type="d65"><rgb name="color" value=".1 .2 .3"/><float name="scale" value="2"/></spectrum>',
    '<spectrum name="NAME" type="srgb"><rgb name="color" value=".1 .2 .3"/></spectrum>',
    '<spectrum name="NAME" type="rawconstant"><float name="value" value="0.5"/></spectrum>',
    '<texture name="NAME" type="rawconstant"><vector name="value" value=".1, .2, .3"/></texture>',
    '<texture name="NAME" type="srgb"><rgb name="color" value=".1 .2 .3"/></texture>',
    '<texture name="NAME" type="d65"><float name="scale" value="0.25"/></texture>',
    '<float name="NAME" value="0.5"/>',
    '<integer name="NAME" value="1"/>',
    '<rgb name="NAME" value="0.5"/>',
]
BRIGHT = ['<spectrum name="NAME" value="400:2, 700:2"/>', '<spectrum name="NAME" value="400:2, 700:9"/>']


@pytest.fixture
def colour(write_scene, tmp_path):
    """(spectrum, name of the parameter that it sets) -> (3,) colour, and notes."""
    (tmp_path / "lamp.spd").write_text("# of a lamp\n400 0.1\n\n 500  0.25 \n600\t0.3\n700 0.5\n")

    def colour(spectrum, name):
        spectrum = spectrum.replace("NAME", name).replace("FOLDER", str(tmp_path))
        sky = "" if name == "radiance" else '<emitter type="constant"/>'
        scene = pj.load_scene(write_scene(PLACES[name].format(spectrum) + sky))
        return np.asarray(pj.parameters(scene)[f"it.{name}"]), scene.about.description.notes

    return colour


@pytest.mark.filterwarnings("ignore::pathjax.errors.InputWarning")  # for a spectrum that is invisible
@pytest.mark.parametrize("name", PLACES)
def test_spectra_are_converted_as_mitsubas(colour, name, tmp_path):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    wrap = {
        "reflectance": '<bsdf version="3.0.0" type="diffuse">{}</bsdf>',
        "eta": '<bsdf version="3.0.0" type="conductor">{}</bsdf>',
        "radiance": '<emitter version="3.0.0" type="constant">{}</emitter>',
    }[name]
    level = mi.logger().log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        for spectrum in SPECTRA + (BRIGHT if name != "reflectance" else BRIGHT[:1]):
            text = wrap.format(spectrum.replace("NAME", name).replace("FOLDER", str(tmp_path)))
            theirs = np.asarray(mi.traverse(mi.load_string(text))[f"{name}.value"])
            ours, _ = colour(spectrum, name)
            np.testing.assert_allclose(ours, theirs * np.ones(3), rtol=1e-4, atol=1e-6, err_msg=text)
    finally:
        mi.set_log_level(level)


def test_textures_of_one_colour_may_stand_elsewhere_and_in_dictionaries():
    """By reference, in place of a scalar, and as Mitsuba's dictionaries name them."""
    raw = {"type": "rawconstant", "value": [0.1, 0.2, 0.3]}
    scene = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": {"type": "d65", "scale": 2.0}},
        "paint": raw,
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": {"type": "ref", "id": "paint"}}},
        "metal": {
            "type": "cube",
            "bsdf": {
                "type": "roughconductor",
                "id": "gold",
                "alpha": {"type": "rawconstant", "value": 0.3},
                "specular_reflectance": {"type": "srgb", "color": [0.4, 0.5, 0.6]},
            },
        },
    }
    found = pj.parameters(pj.load_dict(scene))
    np.testing.assert_allclose(found["sky.radiance"], [2, 2, 2])
    np.testing.assert_allclose(found["ball.reflectance"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(found["gold.alpha"], 0.3)
    np.testing.assert_allclose(found["gold.specular_reflectance"], [0.4, 0.5, 0.6])
    for value in ([0.1, 0.2, 1.3], [-0.1, 0.2, 0.3], 1.5):
        with pytest.raises(InputError, match=r"paint.value"):
            pj.load_dict(scene | {"paint": raw | {"value": value}})


def test_the_tables_have_the_white_points_of_cie():
    """x, y of illuminants E and D65 (CIE 15:2018)."""
    grid, observer, white = spectra._observer()
    for light, expected in ((np.ones_like(grid), (1 / 3, 1 / 3)), (white, (0.31272, 0.32903))):
        xyz = light @ observer
        np.testing.assert_allclose(xyz[:2] / xyz.sum(), expected, atol=1e-4)
        np.testing.assert_allclose(xyz[1] * (grid[1] - grid[0]), 1, rtol=2e-3)


def test_a_colour_outside_of_the_gamut_is_clipped_with_a_note(colour):
    green, notes = colour('<spectrum name="NAME" value="510:1, 530:1"/>', "reflectance")
    assert green[0] == 0 < green[1]
    assert any("has the colour -0." in note and "clipped" in note for note in notes)
    assert not colour(SPECTRA[0], "reflectance")[1][-1].endswith("clipped")


@pytest.mark.parametrize(
    ("spectrum", "words"),
    [
        ('value="500:0.1"', "two wavelengths or more"),
        ('value="500:0.1, 400:0.3"', "in ascending order"),
        ('value="500:0.1, 500:0.3"', "in ascending order"),
        ('value="500:0.1, 600"', "must be pairs"),
        ('value="500:0.1:3, 600:1"', "must be pairs"),
        ('value="500:x, 600:1"', "is not a finite number"),
        ('value="300:2.9e38, 900:2.9e38"', "overflows"),
        ('value="0.1, 0.2"', "has 2 numbers"),
        ('filename="missing.spd"', "no file"),
        ('filename="BAD"', "bad.spd:2: '500 0.2 0.3' must be a wavelength in nm and a value"),
        ('type="blackbody"', "has no colour in Mitsuba's RGB mode"),
        ('type="irregular"', "has no colour in Mitsuba's RGB mode"),
        ('type="blue"', "use one of uniform, d65, srgb, rawconstant"),
        ('type="uniform"', 'needs <float name="value"'),
        ("", 'lacks the attribute "value"'),
    ],
)
def test_spectra_that_make_no_sense_are_refused(write_scene, tmp_path, spectrum, words):
    (tmp_path / "bad.spd").write_text("400 0.1\n500 0.2 0.3\n")
    spectrum = spectrum.replace("BAD", str(tmp_path / "bad.spd"))
    element = f'<spectrum name="radiance" {spectrum}/>'
    with pytest.raises(InputError, match=r"scene\d+.xml:\d+: ") as error:
        pj.load_scene(write_scene(PLACES["radiance"].format(element)))
    assert words in str(error.value)
