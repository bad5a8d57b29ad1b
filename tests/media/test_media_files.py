"""Media in scene files, and errors with place, cause and remedy."""

from __future__ import annotations

import numpy as np
import pytest

import pathjax as pj
from pathjax import transport
from pathjax.io.mitsuba.loader import load

NULL = '<bsdf type="null"/>'
FOG = '<medium type="homogeneous" id="fog"><rgb name="albedo" value=".1, .2, .3"/></medium>'


@pytest.fixture
def file(tmp_path):
    """(body) -> path of a scene file; the body begins in line 2."""

    def write(body, inside="", integrator="volpath"):
        sensor = f'<sensor type="perspective">{inside}</sensor>'
        text = f'<scene version="3.0.0"><integrator type="{integrator}"/>{sensor}\n{body}</scene>'
        (tmp_path / "scene.xml").write_text(text)
        return tmp_path / "scene.xml"

    return write


@pytest.fixture
def read(file):
    return lambda *what, **how: load(file(*what, **how))


def ball(inside="", medium=""):
    interior = f'<medium name="interior" type="homogeneous">{medium}</medium>'
    return f'<shape type="sphere" id="ball">{inside or NULL}{interior}</shape>'


def test_defaults_are_those_of_mitsuba(read):
    (shape,) = read(ball()).shapes
    values = shape.interior.values
    np.testing.assert_array_equal(values["sigma_t"], [1, 1, 1])
    np.testing.assert_array_equal(values["albedo"], [0.75] * 3)
    assert values["scale"] == 1 and values["phase"].kind.__name__ == "Isotropic" and shape.exterior is None


def test_named_media_are_shared(read):
    refs = '<ref name="interior" id="fog"/><ref name="exterior" id="fog"/>'
    scene = read(f'{FOG}<shape type="cube">{NULL}{refs}</shape>', inside='<ref id="fog"/>')
    assert scene.view.medium is scene.shapes[0].interior is scene.shapes[0].exterior and scene.view.medium.name == "fog"


def test_parameters_are_named_after_the_shape_or_the_id(file):
    phase = '<phase type="hg" id="forwards"/>'
    inside = f'<medium name="exterior" type="homogeneous">{phase}</medium>'
    body = ball(inside=NULL + inside) + '<emitter type="constant"/>'
    names = set(pj.parameters(pj.load_scene(file(body))))
    of_media = {f"ball_{side}.{field}" for side in ("interior", "exterior") for field in ("sigma_t", "albedo", "scale")}
    assert names == {"background.radiance", "forwards.g", *of_media}


def test_a_volume_of_one_value_stands_for_the_value(read):
    volume = '<volume type="constvolume" name="albedo"><rgb name="value" value=".1, .2, .3"/></volume>'
    np.testing.assert_array_equal(read(ball(medium=volume)).shapes[0].interior.values["albedo"], [0.1, 0.2, 0.3])


def test_older_files_name_the_extinction_in_their_way(tmp_path):
    medium = '<medium type="homogeneous" name="interior"><float name="sigmaT" value="3"/></medium>'
    rest = f'<integrator type="volpath"/><sensor type="perspective"/><shape type="sphere">{medium}</shape>'
    (tmp_path / "old.xml").write_text(f'<scene version="0.6.0">{rest}</scene>')
    assert load(tmp_path / "old.xml").shapes[0].interior.values["sigma_t"][0] == 3


TABLE = '<phase type="tabphase"><string name="values" value="{}"/></phase>'
HG, WEIGHT = '<phase type="hg"/>', '<float name="weight" value="0.5"/>'
BLEND = f'<phase type="blendphase">{WEIGHT}{2 * HG}</phase>'


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (ball(medium='<rgb name="albedo" value="1.5, 0, 0"/>'), '"albedo" of .* must lie between 0 and 1'),
        (ball(medium='<float name="sigma_t" value="-1"/>'), '"sigma_t" of .* must not be negative'),
        (ball(medium='<float name="scale" value="-1"/>'), '"scale" of .* must be at least 0'),
        (ball(medium='<phase type="blendphase"><phase type="hg"/></phase>'), "needs two <phase>s inside, and has 1"),
        (ball(medium=f'<phase type="blendphase">{2 * HG}</phase>'), 'needs <float name="weight"'),
        (ball(medium=f'<phase type="blendphase">{WEIGHT}{HG}{BLEND}</phase>'), "blend two that are no blends"),
        (ball(medium='<phase type="hg"><float name="g" value="1"/></phase>'), '"g" of .*must be above -1 and below 1'),
        (ball(medium='<phase type="tabphase"/>'), 'needs <string name="values"'),
        (ball(medium=TABLE.format("1")), '"values" of .* must be two numbers or more, none negative, and not all 0'),
        (ball(medium=TABLE.format("1, -1, 2")), "must be two numbers or more"),
        (ball(medium=TABLE.format("0 0")), "must be two numbers or more"),
        (ball(medium=TABLE.format("1, nan")), "'nan' is not a finite number"),
        (ball(medium='<phase type="sggx"/>'), "sggx.*not supported yet; use one of isotropic"),
        (ball(medium='<phase type="isotropc"/>'), 'did you mean "isotropic"'),
        (ball(medium='<volume name="albedo" type="gridvolume"/>'), 'needs <string name="filename"'),
        (ball(medium='<rgb name="sigma_s" value="1, 1, 1"/>'), "sigma_s.* is not a parameter of .*homogeneous"),
        (
            ball(medium='<rgb name="sigma_t" value="1, 2, 3"/><boolean name="has_spectral_extinction" value="false"/>'),
            "has_spectral_extinction.* is false, but sigma_t has a colour",
        ),
        ('<shape type="sphere"><ref name="interior" id="smoke"/></shape>' + FOG, 'there is no id "smoke"'),
        ('<shape type="sphere"><ref id="fog"/></shape>' + FOG, 'takes one <medium name="interior"> and one'),
        (ball().replace("homogeneous", "hetero"), "hetero.*not supported; use one of homogeneous"),
        (ball(inside='<bsdf type="diffuse"><volume name="reflectance" type="constvolume"/></bsdf>'), "be a <volume>"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_its_place(file, body, says):
    with pytest.raises(pj.InputError, match=rf"scene.xml:2: .*{says}"):
        load(file(body))


def test_a_medium_without_a_shape_never_ends(file):
    with pytest.raises(pj.InputError, match="scene.xml:1: .*without a shape around it never ends"):
        load(file("", inside='<medium type="homogeneous"/>'))


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (ball(inside='<bsdf type="diffuse"/>'), 'lets no light in; <bsdf type="null"/>'),
        (ball().replace("sphere", "rectangle"), "bounds a medium and is open"),
        ('<emitter type="point"><medium type="homogeneous"/></emitter>', "has no effect inside"),
        (ball(medium='<boolean name="sample_emitters" value="false"/>'), "sample_emitters has no effect"),
    ],
)
def test_what_looks_like_an_oversight_is_told(read, body, says):
    assert any(says in note for note in read(body).notes)


@pytest.mark.parametrize("bounded", [True, False])
def test_light_of_a_sky_does_not_get_through_fog_without_end_which_is_told(file, bounded):
    """In Mitsuba its light samples are attenuated over a finite distance."""
    inside = '<bsdf type="null"/><ref name="interior" id="fog"/>' if bounded else ""
    body = f"""<medium type="homogeneous" id="fog"/><emitter type="constant" id="sky"/>
        <shape type="sphere"><float name="radius" value="9"/>{inside}</shape>"""
    notes = load(file(body, inside='<ref id="fog"/>')).notes
    assert any("sky is infinitely far" in note for note in notes) != bounded


def test_meshes_are_open_where_an_edge_has_one_triangle_alone():
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    whole, cut = ({"vertices": box.vertices, "faces": box.faces[first:]} for first in (0, 1))
    fog = {"type": "homogeneous"}
    for arrays, is_open in ((whole, False), (cut, True)):
        mesh = {"type": "mesh", **arrays, "bsdf": {"type": "null"}, "interior": fog}
        sensor, integrator = {"type": "perspective"}, {"type": "volpath"}
        sky = {"type": "constant"}
        scene = pj.load_dict({"type": "scene", "sensor": sensor, "integrator": integrator, "mesh": mesh, "sky": sky})
        assert any("is open" in note for note in scene.about.description.notes) == is_open


def test_a_scene_with_media_is_written_and_read_again(file, tmp_path):
    phase = '<phase type="hg"><float name="g" value="0.25"/></phase>'
    volume = '<volume type="constvolume" name="albedo"><float name="value" value="0.5"/></volume>'
    body = FOG + ball(medium=phase + volume) + f'<shape type="cube">{NULL}<ref name="exterior" id="fog"/></shape>'
    scene = pj.load_scene(file(body + '<emitter type="constant"/>', inside='<ref id="fog"/>'))
    values = {
        "fog.sigma_t": [0.1, 0.2, 0.3],
        "fog.scale": 3,
        "ball_interior.albedo": [0.3, 0.4, 0.5],
        "ball_interior.g": -0.5,
    }
    changed = pj.with_parameters(scene, values)
    pj.save_scene(changed, tmp_path / "again.xml")
    again = pj.load_scene(tmp_path / "again.xml")
    assert pj.parameters(again).keys() == pj.parameters(scene).keys()
    for name, value in pj.parameters(changed).items():
        np.testing.assert_array_equal(pj.parameters(again)[name], value)
    np.testing.assert_array_equal(again.media.sides, scene.media.sides)
    assert again.media.camera == scene.media.camera


def test_light_between_patches_goes_through_no_medium(file):
    body = (
        f'<shape type="cube"><emitter type="area"/><bsdf type="diffuse"/><ref name="exterior" id="fog"/></shape>{FOG}'
    )
    with pytest.raises(pj.InputError, match="the scene has participating media, and light between patches"):
        transport.operator(pj.load_scene(file(body)), 6)
