"""Scene files: their meaning, and what is refused. Values that Mitsuba defines are compared with Mitsuba itself."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

import pathjax as pj
from pathjax import description as d
from pathjax.bsdfs.ior import IOR
from pathjax.errors import InputError
from pathjax.images import write_exr, write_png
from pathjax.io.mitsuba.loader import load
from pathjax.kinds import Instance
from pathjax.scene import build
from pathjax.sensors.filters import Box, Gaussian
from pathjax.shapes import Cube, Disk, Rectangle

CORNELL = Path(__file__).parents[2] / "scenes" / "cornell_box.xml"
SENSOR = '<sensor type="perspective"/>'
PATH = '<integrator type="path"/>'


@pytest.fixture
def read(tmp_path):
    """(body, sensor, **parameters) -> Description; the sensor is on line 1 of the file, `body` starts on line 2."""

    def read(body: str, sensor: str = SENSOR, **parameters) -> d.Description:
        path = tmp_path / "scene.xml"
        path.write_text(f'<scene version="3.0.0">{sensor}\n{body}</scene>')
        return load(path, **parameters)

    return read


@pytest.fixture
def refused(read):
    """(body, line, **keywords) -> the error message, which must name the line."""

    def refused(body: str, line: int = 2, **keywords) -> str:
        with pytest.raises(InputError) as caught:
            read(body, **keywords)
        assert f"scene.xml:{line}: " in str(caught.value)
        return str(caught.value)

    return refused


@pytest.fixture
def mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def shape(inside: str = "", kind: str = "sphere", attributes: str = "") -> str:
    return f'<shape type="{kind}" {attributes}>{inside}</shape>'


def with_bsdf(kind: str, inside: str = "", attributes: str = "") -> str:
    return shape(f'<bsdf type="{kind}" {attributes}>{inside}</bsdf>')


def first_bsdf(scene: d.Description) -> Instance:
    return scene.shapes[0].bsdf


# --- a scene as users write it


def test_cornell_box_is_read_as_written():
    box = load(CORNELL, res=32, spp=4)
    assert (box.view.film.width, box.view.film.height, box.view.spp, box.view.film.filter) == (32, 32, 4, Box())
    assert box.integrator == d.Integrator(max_depth=8, rr_depth=5)
    assert [shape.name for shape in box.shapes][:3] == ["lamp", "floor", "ceiling"]
    lamp, floor = box.shapes[0], box.shapes[1]
    assert lamp.bsdf is floor.bsdf and lamp.bsdf.name == "white"
    np.testing.assert_allclose(lamp.emitter.values["radiance"], [18.387, 13.9873, 6.75357])
    assert lamp.emitter.name == "light" and floor.emitter is None
    assert (box.view.camera.fov, box.view.camera.fov_axis) == (39.3077, "smaller")
    np.testing.assert_allclose(box.view.camera.to_world[:3, 3], [0, 0, 3.9])
    np.testing.assert_allclose(floor.geometry.to_world @ [0, 0, 0, 1], [0, -1, 0, 1], atol=1e-15)


# --- $parameters, includes, references


def test_keyword_overrides_default_and_a_default_needs_no_use(read):
    body = '<default name="r" value="2"/><default name="unused" value="0"/>'
    body += shape('<float name="radius" value="$r"/>')
    assert read(body).shapes[0].geometry.radius == 2
    assert read(body, r=3).shapes[0].geometry.radius == 3
    assert read(body, r=3, unused=1).shapes[0].geometry.radius == 3


def test_first_default_wins_and_defaults_compose(read):
    body = '<default name="a" value="2"/><default name="a" value="9"/><default name="b" value="1$a"/>'
    assert read(body + shape('<float name="radius" value="$b"/>')).shapes[0].geometry.radius == 12


def test_keyword_serves_a_name_without_default_even_one_called_path(read):
    assert read(shape('<float name="radius" value="$path"/>'), path=0.5).shapes[0].geometry.radius == 0.5


def test_keywords_that_are_lists_and_booleans_become_xml(read):
    color = '<bsdf type="diffuse"><rgb name="reflectance" value="$c"/></bsdf>'
    scene = read(shape(f'<boolean name="flip_normals" value="$flip"/>{color}'), flip=True, c=np.array([0.1, 0.2, 0.3]))
    assert scene.shapes[0].flip_normals
    np.testing.assert_array_equal(first_bsdf(scene).values["reflectance"], [0.1, 0.2, 0.3])


def test_unknown_keyword_lists_those_that_exist(read):
    with pytest.raises(InputError, match=r'no parameter "rse"; it has: res; did you mean "res"\?'):
        read('<default name="res" value="1"/>', rse=3)


def test_undefined_name_is_refused_at_its_line(refused):
    body = '\n<default name="radius" value="1"/>\n' + shape('<float name="radius" value="$raduis"/>')
    message = refused(body, line=4)
    assert "$raduis is not defined" in message and 'did you mean "radius"?' in message


def test_defaults_that_grow_without_bound_are_refused(refused):
    defaults = ['<default name="a0" value="0123456789"/>']
    defaults += [f'<default name="a{k}" value="{f"$a{k - 1}" * 10}"/>' for k in range(1, 20)]
    assert "grows" in refused("".join(defaults))


def test_included_files_are_found_beside_the_scene_beside_the_includer_and_in_paths(read, tmp_path):
    (tmp_path / "sub" / "deep").mkdir(parents=True)
    (tmp_path / "sub" / "a.xml").write_text('<scene version="3.0.0"><include filename="b.xml"/></scene>')
    (tmp_path / "sub" / "b.xml").write_text('<scene version="3.0.0"><shape type="cube" id="b"/></scene>')
    (tmp_path / "sub" / "deep" / "c.xml").write_text('<scene version="3.0.0"><shape type="cube"/></scene>')
    scene = read('<include filename="sub/a.xml"/><path value="sub/deep"/><include filename="c.xml"/>')
    assert [shape.name for shape in scene.shapes] == ["b", "shape0"]


@pytest.mark.parametrize(
    "body",
    [
        shape('<include filename="part.xml"/>'),
        shape('<bsdf type="twosided"><include filename="part.xml" name="it"/></bsdf>'),
        shape('<include filename="outer.xml"/>'),
        shape('<include filename="part.xml"/>') + shape('<ref id="red"/>', "cube"),
    ],
)
def test_objects_of_files_that_are_included_anywhere_stand_there(read, tmp_path, body):
    """As in Mitsuba, which ignores the values of an included file that belong to none of its objects."""
    red = '<bsdf type="diffuse" id="red"><rgb name="reflectance" value="$red, 0, 0"/></bsdf>'
    (tmp_path / "part.xml").write_text(
        f'<scene version="3.0.0"><default name="red" value="0.9"/>{red}<float name="radius" value="9"/></scene>'
    )
    (tmp_path / "outer.xml").write_text('<scene version="3.0.0"><include filename="part.xml"/></scene>')
    scene = read('<default name="red" value="0.5"/>' + body)
    front = scene.shapes[0].bsdf.kind.sides(scene.shapes[0].bsdf)[0]
    np.testing.assert_array_equal(front.values["reflectance"], [0.5, 0, 0])
    assert scene.shapes[0].geometry.radius == 1
    assert any("part.xml:1" in note and "radius" in note and "has no effect" in note for note in scene.notes)


def test_defaults_and_aliases_stand_anywhere(read):
    inside = '<alias id="red" as="rot"/><default name="r" value="2"/><float name="radius" value="$r"/><ref id="rot"/>'
    scene = read('<bsdf type="diffuse" id="red"/>' + shape(inside))
    assert scene.shapes[0].geometry.radius == 2 and scene.shapes[0].bsdf.name == "red"


@pytest.mark.parametrize("tag", ['include filename="part.xml"', 'default name="a" value="1"', 'path value="."'])
def test_what_is_for_reading_takes_nothing_inside(refused, tmp_path, tag):
    (tmp_path / "part.xml").write_text('<scene version="3.0.0"/>')
    assert "takes nothing inside" in refused(f'<{tag}><float name="a" value="1"/></{tag.split()[0]}>')


def test_error_in_an_included_file_names_that_file(read, tmp_path):
    (tmp_path / "part.xml").write_text('<scene version="3.0.0">\n\n<shape type="spere"/></scene>')
    with pytest.raises(InputError, match=r'part\.xml:3: <shape type="spere"> is not supported.* mean "sphere"'):
        read('<include filename="part.xml"/>')


def test_include_cycle_is_refused(read, tmp_path):
    (tmp_path / "a.xml").write_text('<scene version="3.0.0">\n\n<include filename="scene.xml"/></scene>')
    with pytest.raises(InputError, match=r"a\.xml:3: .* includes itself"):
        read('<include filename="a.xml"/>')


def test_includes_that_multiply_are_refused_quickly(read, tmp_path):
    for k in range(20):
        twice = f'<include filename="{k + 1}.xml"/>' * 2
        (tmp_path / f"{k}.xml").write_text(f'<scene version="3.0.0">{twice}</scene>')
    (tmp_path / "20.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(InputError, match="more than 1000 included files"):
        read('<include filename="0.xml"/>')


def test_a_reference_may_come_before_its_object_and_shares_it(read):
    ref = '<ref id="m"/>'
    scene = read(shape(ref) + shape(ref) + '<bsdf type="diffuse" id="m"/>')
    assert scene.shapes[0].bsdf is scene.shapes[1].bsdf


@pytest.mark.parametrize(
    ("body", "line", "words"),
    [
        ('<bsdf type="diffuse" id="grey"/>\n' + shape('<ref id="gray"/>'), 3, 'no id "gray"; did you mean "grey"?'),
        (shape(attributes='id="a"') + "\n" + shape(attributes='id="a"'), 3, 'id "a" is taken already'),
        ('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>', 2, "cannot stand inside itself"),
        ('<integrator type="moment" id="a"><ref id="a"/></integrator>', 2, "cannot stand inside itself"),
        (shape('<ref id="b"/>') + shape('<ref id="x"/>', attributes='id="b"'), 2, "has no place inside"),
        (shape('<ref name="radius" id="r"/><float id="r" name="q" value="1"/>'), 2, "which is not an object"),
        ('<include filename="nowhere.xml"/>', 2, 'no file "nowhere.xml"'),
        ('<path value="nowhere"/>', 2, 'no folder "nowhere"'),
        ('<alias id="gray" as="b"/><bsdf type="diffuse" id="grey"/>', 2, 'no id "gray"; did you mean "grey"?'),
        ('<bsdf type="diffuse" id="a"/>\n<alias id="a" as="a"/>', 3, 'id "a" is taken already'),
    ],
)
def test_references_that_cannot_be_followed_are_refused(refused, body, line, words):
    assert words in refused(body, line)


def test_an_alias_is_another_name_of_an_object(read):
    scene = read('<bsdf type="diffuse" id="a"/><alias id="a" as="b"/><alias id="b" as="c"/>' + shape('<ref id="c"/>'))
    assert first_bsdf(scene).name == "a"


# --- names


def test_names_come_from_ids_then_from_what_encloses(read):
    light = '<emitter type="area"/>'
    scene = read(
        shape('<bsdf type="diffuse"/>' + light, attributes='id="lamp"')
        + shape('<bsdf type="diffuse" id="paint"/><emitter type="area" id="glow"/>')
        + shape('<bsdf type="diffuse"/>' + light)
        + shape()
        + '<emitter type="constant"/>'
    )
    assert [shape.name for shape in scene.shapes] == ["lamp", "shape0", "shape1", "shape2"]
    assert [shape.bsdf.name for shape in scene.shapes] == ["lamp", "paint", "bsdf0", "bsdf1"]
    assert [shape.emitter and shape.emitter.name for shape in scene.shapes] == ["lamp", "glow", "shape1", None]
    assert [light.name for light in scene.emitters] == ["background"]


def test_names_that_the_file_uses_are_not_given_again(read):
    scene = read(shape() + shape(attributes='id="shape0"') + shape(attributes='id="bsdf0"'))
    assert [shape.name for shape in scene.shapes] == ["shape1", "shape0", "bsdf0"]
    assert first_bsdf(scene).name == "bsdf1"


def test_thousands_of_shapes_without_ids_have_names_of_their_own(read):
    names = [shape.name for shape in read(shape() * 3000).shapes]
    assert names[-1] == "shape2999" and len(set(names)) == 3000


def test_twosided_hands_its_name_down(read):
    inner = '<bsdf type="diffuse"/>'
    one = first_bsdf(read(with_bsdf("twosided", inner, 'id="wall"')))
    assert one.name == one.values["front"].name == "wall" and one.values["front"] is one.values["back"]
    two = first_bsdf(read(with_bsdf("twosided", inner + '<bsdf type="conductor" id="metal"/>', 'id="wall"')))
    assert (two.values["front"].name, two.values["back"].name) == ("wall_front", "metal")


def test_a_texture_without_id_is_named_after_its_bsdf(read):
    texture = '<texture name="reflectance" type="checkerboard"/>'
    assert first_bsdf(read(with_bsdf("diffuse", texture, 'id="floor"'))).values["reflectance"].name == "floor"


# --- transforms

TRANSFORMS = [
    '<translate x="1" y="-2"/>',
    '<translate value="1, 2 3"/>',
    '<scale value="2"/><translate z="1"/>',
    '<translate z="1"/><scale x="2" y="3"/>',
    '<rotate x="1" angle="90"/>',
    '<rotate value="0.6, 0, 0.8" angle="-385"/><translate y="1"/>',
    '<rotate x="1" y="1" angle="90"/><rotate z="2" angle="-30"/>',  # not unit: no rotations
    '<matrix value="1 2 3 4  0 1 5 6  0 0 1 7  0 0 0 1"/>',
    '<matrix value="1 2 3 4 5 6 7 8 10"/>',
    '<lookat origin="1, 2, 3" target="4, 5, 7" up="0, 1, 0"/>',
    '<lookat origin="1, 2, 3" target="4, 5, 7"/>',
    '<lookat origin="0, 0, 3" target="1, 2, -4"/>',
    '<lookat origin="0, 0, 3" target="0, 0, 0"/><scale x="-1"/>',
]


@pytest.mark.parametrize("steps", TRANSFORMS)
def test_transforms_agree_with_mitsuba(read, mitsuba, steps):
    body = shape(f'<transform name="to_world">{steps}</transform>', "rectangle")
    theirs = mitsuba.traverse(mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>').shapes()[0])["to_world"]
    np.testing.assert_allclose(read(body).shapes[0].geometry.to_world, np.array(theirs.matrix), atol=2e-6)


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ('<scale value="0"/>', "singular"),
        ('<scale x="1e-20"/>', "singular"),
        ('<matrix value="1 2 3 2 4 6 0 0 1"/>', "singular"),
        ('<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1"/>', "last row"),
        ('<matrix value="1 2 3"/>', "9 or 16"),
        ('<translate x="nan"/>', "not a finite number"),
        ('<translate x="1e400"/>', "not a finite number"),
        ('<scale value="1e30"/><scale value="1e30"/>', "overflow"),
        ('<translate x="one"/>', "'one' is not a finite number"),
        ('<translate value="1 2"/>', "1 or 3"),
        ('<translate value="1" x="1"/>', "mixes value"),
        ('<translate q="1"/>', 'no attribute "q"'),
        ('<rotate angle="90"/>', "the axis is the zero vector"),
        ('<rotate x="1"/>', 'lacks the attribute "angle"'),
        ('<lookat origin="1, 2, 3" target="1, 2, 3"/>', "coincide"),
        ('<lookat origin="0, 0, 0" target="0, 1, 0" up="0, 2, 0"/>', "parallel"),
        ('<lookat target="0, 0, 1"/>', 'lacks the attribute "origin"'),
        ('<shear x="1"/>', "use one of: translate, rotate, scale, lookat, matrix"),
        ('<translate x="1"><scale value="2"/></translate>', "nothing inside"),
    ],
)
def test_transforms_without_meaning_are_refused(refused, steps, words):
    assert words in refused(shape(f'<transform name="to_world">\n{steps}</transform>', "cube"), line=3)


# --- shapes


def test_sphere_composes_center_radius_and_transform(read):
    moved = '<scale value="2"/><rotate z="1" angle="90"/><translate x="10"/>'
    inside = '<point name="center" x="1" y="2" z="3"/><float name="radius" value="0.5"/>'
    sphere = read(shape(inside + f'<transform name="to_world">{moved}</transform>')).shapes[0].geometry
    np.testing.assert_allclose(sphere.center, [6, 2, 6])
    assert sphere.radius == pytest.approx(1)
    np.testing.assert_allclose(sphere.to_world[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize(
    ("step", "radius"),
    [('<scale x="2"/>', 2), ('<scale x="2" y="-3"/>', 2), ('<matrix value="1 .5 0 0 1 0 0 0 1"/>', 1)],
)
def test_a_sphere_stays_a_sphere_of_the_scale_along_x_as_in_mitsuba(read, step, radius):
    made = read(shape(f'<transform name="to_world">{step}<translate y="7"/></transform>'))
    sphere = made.shapes[0].geometry
    assert sphere.radius == pytest.approx(radius) and sphere.mirrored == ("-" in step)
    np.testing.assert_allclose(sphere.center, [0, 7, 0])
    assert any("as in Mitsuba it stays a sphere" in note for note in made.notes)


def test_a_sphere_that_is_not_finite_is_refused(refused):
    small = '<float name="radius" value="1e-40"/><transform name="to_world"><scale x="1e-10"/></transform>'
    assert "too large or too small" in refused(shape(small))


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_an_axis_of_three_digits_leaves_a_sphere_round(read, kind):
    turned = '<transform name="to_world"><rotate value="0.577, 0.577, 0.577" angle="180"/></transform>'
    assert read(shape(turned, kind)).shapes


@pytest.mark.parametrize("mirror", ["1", "-1"])
@pytest.mark.parametrize("flip", ["false", "true"])
def test_a_mirrored_sphere_is_inside_out_as_in_mitsuba(read, mitsuba, mirror, flip):
    mirrored = f'<transform name="to_world"><scale x="{mirror}"/></transform>'
    body = shape(f'<boolean name="flip_normals" value="{flip}"/>{mirrored}')
    scene = mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>')
    hit = scene.ray_intersect(mitsuba.Ray3f([0, 0, 5], [0, 0, -1]))
    assert read(body).shapes[0].flip_normals == (hit.sh_frame.n.z < 0)


@pytest.mark.parametrize(("kind", "made"), [("rectangle", Rectangle), ("cube", Cube), ("disk", Disk)])
def test_plain_shapes_carry_their_transform(read, kind, made):
    scene = read(shape('<transform name="to_world"><scale x="-2"/></transform>', kind))
    assert isinstance(scene.shapes[0].geometry, made) and not scene.shapes[0].flip_normals
    np.testing.assert_array_equal(scene.shapes[0].geometry.to_world, np.diag([-2, 1, 1, 1]))


def test_a_shape_without_bsdf_is_grey_and_a_light_without_bsdf_is_black(read, mitsuba):
    for body, expected in [(shape(), 0.5), (shape('<emitter type="area"/>'), 0.0)]:
        theirs = mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>').shapes()[0].bsdf()
        assert f"value={expected:f}" in str(theirs)
        np.testing.assert_array_equal(first_bsdf(read(body)).values["reflectance"], np.full(3, expected))


# --- bsdfs


def test_a_mesh_without_any_area_is_left_out_with_its_light_and_noted(read, tmp_path):
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 3 2 1\n")
    file, light = '<string name="filename" value="line.obj"/>', '<emitter type="area"/>'
    scene = read(shape(file, "obj", 'id="crack"') + shape() + "\n" + shape(file + light, "obj") + shape(light))
    assert [s.name for s in scene.shapes] == ["shape0", "shape2"]  # the other shapes keep their names
    assert [s.emitter is None for s in scene.shapes] == [True, False]
    left_out = [note for note in scene.notes if "is left out, as no triangle has an area" in note]
    assert ["scene.xml:2: " in note and "light" not in note for note in left_out] == [True, False]
    assert "scene.xml:3: " in left_out[1] and left_out[1].endswith("and its light too")
    assert sum("2 degenerate triangles" in note for note in scene.notes) == 2


def test_what_stands_in_a_mesh_without_any_area_is_still_checked(refused, tmp_path):
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    file = '<string name="filename" value="line.obj"/>'
    assert "frosted" in refused(shape(file + '<bsdf type="frosted"/>', "obj"))


def test_ior_names_are_mitsubas(mitsuba):
    for name, value in IOR.items():
        body = with_bsdf("dielectric", f'<string name="int_ior" value="{name}"/><float name="ext_ior" value="1"/>')
        scene = mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>')
        assert mitsuba.traverse(scene.shapes()[0].bsdf())["eta"] == pytest.approx(value, rel=1e-6), name


def test_dielectric_takes_numbers_and_names(read):
    glass = first_bsdf(read(with_bsdf("dielectric")))
    assert (glass.values["int_ior"], glass.values["ext_ior"]) == (IOR["bk7"], IOR["air"])
    ice = '<string name="int_ior" value="Water Ice"/><integer name="ext_ior" value="1"/>'
    assert first_bsdf(read(with_bsdf("dielectric", ice))).values["int_ior"] == 1.31


def test_conductor_is_an_ideal_mirror_unless_told_otherwise(read):
    for inside in ("", '<string name="material" value="none"/>'):
        mirror = first_bsdf(read(with_bsdf("conductor", inside)))
        assert mirror.values["eta"] is None and mirror.values["k"] is None
        assert (mirror.values["specular_reflectance"] == 1).all()
    metal = first_bsdf(read(with_bsdf("conductor", '<rgb name="eta" value="1,2,3"/><spectrum name="k" value="4"/>')))
    np.testing.assert_array_equal([metal.values["eta"], metal.values["k"]], [[1, 2, 3], [4, 4, 4]])
    metal = first_bsdf(read(with_bsdf("conductor", '<rgb name="eta" value="1"/>')))
    np.testing.assert_array_equal(metal.values["k"], np.ones(3))


@pytest.mark.parametrize(
    ("kind", "inside", "words"),
    [
        ("hair", "", "is not supported: it stands on curves, which no ray is tested against; use one of diffuse, "),
        ("measured", "", "is not supported: files of measured reflectance are not read; use one of diffuse, "),
        ("difuse", "", 'did you mean "diffuse"?'),
        ("diffuse", '<rgb name="reflectence" value="1"/>', 'it has: reflectance; did you mean "reflectance"?'),
        ("diffuse", '<rgb name="reflectance" value="1.1"/>', "between 0 and 1"),
        ("diffuse", '<float name="reflectance" value="-0.1"/>', "between 0 and 1"),
        ("diffuse", '<rgb name="reflectance" value="nan"/>', "not a finite number"),
        ("diffuse", '<rgb name="reflectance" value="0.1, 0.2"/>', "has 2 numbers"),
        ("diffuse", '<rgb name="reflectance" value=""/>', "not a finite number"),
        ("diffuse", '<rgb name="reflectance" value="#ff8000"/>', "hexadecimal"),
        ("diffuse", '<string name="reflectance" value="red"/>', "cannot be a <string>"),
        ("diffuse", '<rgb name="reflectance"/>', 'lacks the attribute "value"'),
        ("diffuse", '<rgb name="reflectance" value="1" unit="m"/>', 'no attribute "unit"'),
        ("diffuse", '<rgb value="1"/>', "lacks name="),
        ("diffuse", '<rgb name="reflectance" value="1"/><rgb name="reflectance" value="1"/>', "given twice"),
        ("diffuse", '<rgb name="reflectance" value="1"><float name="a" value="1"/></rgb>', "has no place inside"),
        ("diffuse", '<bsdf type="diffuse"/>', "has no place inside"),
        ("diffuse", '<texture type="checkerboard"/>', "lacks name="),
        ("diffuse", "<colour/>", "<colour> is not supported inside"),
        ("dielectric", '<float name="int_ior" value="0"/>', "must be at least 0.0042598, is 0"),
        ("dielectric", '<float name="ext_ior" value="-1"/>', "must be at least 0.0042598, is -1"),
        ("dielectric", '<float name="int_ior" value="1e-3"/>', "must be at least 0.0042598, is 0.001"),
        ("dielectric", '<string name="int_ior" value="1.5"/>', "use a number or one of vacuum"),
        ("dielectric", '<string name="int_ior" value="diamonds"/>', 'did you mean "diamond"?'),
        ("dielectric", '<rgb name="specular_transmittance" value="1.1"/>', "between 0 and 1"),
        (
            "roughdielectric",
            '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1.5"/>',
            "must differ from",
        ),
        ("conductor", '<string name="material" value="V_palic"/>', 'did you mean "V_palik"'),
        (
            "conductor",
            '<string name="material" value="Au"/><rgb name="k" value="1"/>',
            "give either eta and k, or material",
        ),
        ("roughconductor", '<float name="alpha" value="-0.1"/>', "at least 0"),
        ("roughconductor", '<float name="alpha" value="1.5"/>', "at most 1, is 1.5"),
        ("roughconductor", '<float name="alpha_u" value="0.1"/>', "needs alpha_v beside it"),
        (
            "roughconductor",
            '<float name="alpha" value="0.1"/><float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.1"/>',
            "give either alpha, or alpha_u and alpha_v",
        ),
        ("roughconductor", '<string name="distribution" value="phong"/>', "use beckmann or ggx"),
        ("conductor", '<rgb name="k" value="-1"/>', "not be negative"),
        ("twosided", "", "needs a <bsdf> inside"),
        ("twosided", '<bsdf type="dielectric"/>', "cannot stand inside"),
        ("twosided", '<bsdf type="frosted"/>', '<bsdf type="frosted"> is not supported; use one of'),
        ("twosided", '<bsdf type="mask"><bsdf type="diffuse"/></bsdf>', "lets light through; <bsdf"),
        ("twosided", '<bsdf type="mask"><bsdf type="dielectric"/></bsdf>', "cannot stand inside"),
        ("mask", "", "needs a <bsdf> inside, and has 0"),
        ("mask", '<bsdf type="diffuse"/>' * 2, "at most 1 <bsdf>"),
        ("mask", '<bsdf type="diffuse"/><float name="opacity" value="1.1"/>', "at least 0 and at most 1, is 1.1"),
        ("mask", '<bsdf type="diffuse"/><rgb name="opacity" value="0, 2, 0"/>', "must lie between 0 and 1"),
        ("blendbsdf", '<bsdf type="diffuse"/><float name="weight" value="0.5"/>', "needs 2 <bsdf>s inside, and has 1"),
        ("blendbsdf", '<bsdf type="diffuse"/>' * 3, "at most 2 <bsdf>"),
        ("blendbsdf", '<bsdf type="diffuse"/>' * 2, 'needs <float name="weight" ...>'),
        ("blendbsdf", '<bsdf type="diffuse"/>' * 2 + '<float name="weight" value="-0.1"/>', "must be at least 0"),
        ("bumpmap", '<bsdf type="diffuse"/>', "needs one <texture> inside, and has 0"),
        ("bumpmap", '<bsdf type="diffuse"/>' + '<texture type="checkerboard"/>' * 2, "needs one <texture>"),
        ("normalmap", '<bsdf type="diffuse"/>', 'needs <rgb name="normalmap" ...>, or a texture of that name'),
        ("normalmap", '<bsdf type="diffuse"/><texture type="checkerboard"/>', "needs <rgb name="),
        ("null", '<rgb name="reflectance" value="1"/>', "is not a parameter"),
        ("twosided", '<bsdf type="diffuse"/>' * 3, "at most 2 <bsdf>"),
    ],
)
def test_bsdfs_that_are_not_modelled_are_refused(refused, kind, inside, words):
    assert words in refused(with_bsdf(kind, inside))


# --- textures


@pytest.fixture
def picture(tmp_path):
    """A 4 x 2 PNG whose pixels all differ."""
    y, x = np.mgrid[0:2, 0:4]
    write_png(tmp_path / "picture.png", np.stack([(x + 1) / 5, (y + 1) / 3, 0.2 + 0 * x], axis=-1))
    return '<string name="filename" value="picture.png"/>'


def evaluated(mitsuba, body, uv):
    """Return Mitsuba's reflectance of the first shape's bsdf at uv."""
    si = mitsuba.SurfaceInteraction3f()
    si.uv, si.wi = uv, [0, 0, 1]
    scene = mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>')
    return np.array(scene.shapes()[0].bsdf().eval_diffuse_reflectance(si))


@pytest.mark.parametrize("raw", ["true", "false"])
@pytest.mark.parametrize("to_uv", ["", '<scale x="0.5"/><translate x="0.25" y="0.5"/>', '<rotate z="1" angle="90"/>'])
def test_texels_lie_where_mitsuba_finds_them(read, mitsuba, picture, tmp_path, raw, to_uv):
    inside = (
        f'<texture name="reflectance" type="bitmap">{picture}<string name="filter_type" value="nearest"/>'
        f'<boolean name="raw" value="{raw}"/><transform name="to_uv">{to_uv}</transform></texture>'
    )
    bitmap = first_bsdf(read(with_bsdf("diffuse", inside))).values["reflectance"]
    assert bitmap.values["nearest"] and bitmap.values["wrap"] == "repeat"
    there = with_bsdf("diffuse", inside).replace("picture.png", str(tmp_path / "picture.png"))
    height, width, _ = bitmap.values["texels"].shape
    for uv in [(0.1, 0.1), (0.9, 0.1), (0.1, 0.9), (0.6, 0.7)]:
        u, v = bitmap.values["to_uv"] @ [*uv, 1]
        ours = bitmap.values["texels"][int(v % 1 * height), int(u % 1 * width)]
        np.testing.assert_allclose(ours, evaluated(mitsuba, there, uv), atol=2e-5)


def test_checkerboard_defaults_are_mitsubas(read, mitsuba):
    body = with_bsdf("diffuse", '<texture name="reflectance" type="checkerboard"/>')
    board = first_bsdf(read(body)).values["reflectance"]
    np.testing.assert_allclose(evaluated(mitsuba, body, (0.1, 0.1)), board.values["color0"])
    np.testing.assert_allclose(evaluated(mitsuba, body, (0.6, 0.1)), board.values["color1"])


def test_a_texture_that_is_referenced_twice_is_read_once(read, picture):
    scene = read(
        f'<texture type="bitmap" id="t">{picture}</texture>'
        + 2 * with_bsdf("diffuse", '<ref name="reflectance" id="t"/>')
    )
    assert scene.shapes[0].bsdf.values["reflectance"] is scene.shapes[1].bsdf.values["reflectance"]
    assert first_bsdf(scene).values["reflectance"].name == "t"


def test_a_board_that_stands_for_a_number_and_for_a_colour_is_refused(read):
    """It would be two boards, and the names of its parameters are those of one."""
    board = '<texture type="checkerboard" id="board"/>'
    twice = with_bsdf("plastic", '<ref name="diffuse_reflectance" id="board"/>')
    both = twice + with_bsdf("mask", '<ref name="opacity" id="board"/><bsdf type="diffuse"/>')
    build(read(board + twice + twice))
    build(read(board + both.replace(twice, "") * 2))
    with pytest.raises(InputError, match='"board" stands for a colour and for a number'):
        build(read(board + both))


@pytest.mark.parametrize(
    ("kind", "inside", "words"),
    [
        ("wood", "", "use one of bitmap, checkerboard"),
        ("bitmap", "", 'needs <string name="filename"'),
        ("bitmap", '<string name="filenme" value="a.png"/>', '...>; is it <string name="filenme"> at'),
        ("bitmap", '<string name="filename" value="no.png"/>', 'no file "no.png"'),
        ("bitmap", '<string name="filename" value="picture.png"/><string name="wrap_mode" value="none"/>', "repeat or"),
        ("checkerboard", '<rgb name="color0" value="2"/>', "between 0 and 1"),
        ("checkerboard", '<texture name="color1" type="wood"/>', "use one of bitmap, checkerboard"),
    ],
)
def test_textures_that_are_not_modelled_are_refused(refused, picture, kind, inside, words):
    texture = f'<texture name="reflectance" type="{kind}">{inside}</texture>'
    assert words in refused(with_bsdf("diffuse", texture))


@pytest.mark.parametrize(("kind", "misspelt", "held"), [("blendbsdf", "weght", 2), ("normalmap", "normal_map", 1)])
def test_a_misspelt_parameter_that_a_bsdf_needs_is_told(refused, kind, misspelt, held):
    message = refused(with_bsdf(kind, f'<rgb name="{misspelt}" value="0.5"/>' + '<bsdf type="diffuse"/>' * held))
    assert f'is it <rgb name="{misspelt}"> at' in message


@pytest.mark.parametrize("inside", ["{}", '<texture type="checkerboard" name="reflectance">{}</texture>'])
def test_images_below_0_are_no_reflectance(refused, tmp_path, inside):
    dark = np.full((2, 2), -0.5, np.float32)
    write_exr(tmp_path / "dark.exr", {"R": dark, "G": dark, "B": dark}, {})
    name = "reflectance" if inside == "{}" else "color0"
    texture = f'<texture name="{name}" type="bitmap"><string name="filename" value="dark.exr"/></texture>'
    assert "values below 0, inf or NaN" in refused(with_bsdf("diffuse", inside.format(texture)))


def test_images_above_1_are_kept_with_a_note_as_mitsuba_keeps_them(read, tmp_path):
    """As parameters they may be set again. Values that are shares, such as an opacity, may not exceed 1."""
    bright = np.full((2, 2), 1.5, np.float32)
    write_exr(tmp_path / "bright.exr", {"R": bright, "G": bright, "B": bright}, {})
    texture = '<texture name="{}" type="bitmap"><string name="filename" value="bright.exr"/></texture>'
    sky = '<emitter type="constant"/>'
    notes = read(sky + with_bsdf("diffuse", texture.format("reflectance"), 'id="a"')).notes
    assert any("has colours up to 1.5, above 1, which are kept" in note for note in notes)
    scene = pj.load_scene(tmp_path / "scene.xml")
    scene = pj.with_parameters(scene, pj.parameters(scene))
    assert pj.parameters(scene)["a.reflectance"].max() == 1.5
    with pytest.raises(InputError, match="above 1"):
        read(shape(f'<bsdf type="mask">{texture.format("opacity")}<bsdf type="diffuse"/></bsdf>'))


def test_of_to_uv_what_is_of_z_has_no_effect_as_in_mitsuba(read):
    turn = '<scale value="5"/><rotate x="1" angle="40"/>'
    for inside in (turn, '<matrix value="4 0 .3 0 6 .2 0 0 1"/>'):
        to_uv = f'<transform name="to_uv">{inside}</transform>'
        scene = read(with_bsdf("diffuse", f'<texture name="reflectance" type="checkerboard">{to_uv}</texture>'))
        assert any("mixes z with u and v, which has no effect" in note for note in scene.notes)
        board = first_bsdf(scene).values["reflectance"]
        expected = np.diag([5, 5 * np.cos(np.radians(40))]) if inside == turn else np.diag([4, 6])
        np.testing.assert_allclose(board.values["to_uv"], np.pad(expected, ((0, 0), (0, 1))))


# --- emitters


@pytest.mark.parametrize(("tag", "value"), [("rgb", "3, 2, 1"), ("rgb", "3"), ("float", "3"), ("spectrum", "2")])
def test_radiance_agrees_with_mitsuba(read, mitsuba, tag, value):
    body = shape(f'<emitter type="area"><{tag} name="radiance" value="{value}"/></emitter>', "rectangle")
    si = mitsuba.SurfaceInteraction3f()
    si.wi, si.uv = [0, 0, 1], [0.5, 0.5]
    theirs = mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>').shapes()[0].emitter().eval(si)
    np.testing.assert_allclose(read(body).shapes[0].emitter.values["radiance"], np.array(theirs), rtol=1e-5)


def test_constant_emitters_stand_in_the_scene_in_any_number(read):
    sky = '<emitter type="constant" id="sky"><rgb name="radiance" value="1, 2, 3"/></emitter>'
    scene = read(sky + '<emitter type="constant"/>' * 2)
    np.testing.assert_array_equal([light.values["radiance"] for light in scene.emitters], [[1, 2, 3], [1] * 3, [1] * 3])
    assert [light.name for light in scene.emitters] == ["sky", "background", "background0"] and scene.shapes == ()
    assert read("").emitters == ()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<emitter type="timed_sunsky"/>', '<emitter type="timed_sunsky"> is not supported: light does not change'),
        ('<emitter type="pint"/>', '<emitter type="pint"> is not supported; use one of constant'),
        ('<emitter type="area"><rgb name="intensity" value="1"/></emitter>', "sampling_weight, radiance"),
        (shape('<emitter type="constant"/>'), "shines from no surface; it stands directly in <scene>"),
        (shape('<emitter type="point"/>'), "shines from no surface; it stands directly in <scene>"),
        (shape('<emitter type="projector"/>'), "shines from no surface; it stands directly in <scene>"),
        (shape('<emitter type="area" id="a"/>') + shape('<ref id="a"/>'), "shines from <shape"),
        ('<emitter type="constant"><float name="sampling_weight" value="-1"/></emitter>', "at least 0"),
        (shape('<emitter type="area"/>' * 2), "at most 1 <emitter>"),
        (shape('<emitter type="area"><rgb name="radiance" value="-1"/></emitter>'), "not be negative"),
        (shape('<emitter type="area"><texture name="radiance" type="bitmap"/></emitter>'), "needs <string name="),
        (shape('<emitter type="area"><rgb name="intensity" value="1"/></emitter>'), "sampling_weight, radiance"),
    ],
)
def test_emitters_that_are_not_modelled_are_refused(refused, body, words):
    assert words in refused(body)


# --- sensor, film, sampler, integrator


def test_defaults_of_sensor_film_and_integrator_are_mitsubas(read, mitsuba):
    scene = read("")
    sensor = mitsuba.load_string(f'<scene version="3.0.0">{SENSOR}</scene>').sensors()[0]
    params = mitsuba.traverse(sensor)
    assert (scene.view.film.width, scene.view.film.height) == tuple(sensor.film().size())
    assert scene.view.spp == sensor.sampler().sample_count()
    camera = scene.view.camera
    assert (camera.near_clip, camera.far_clip) == pytest.approx((params["near_clip"], params["far_clip"]))
    assert str(sensor.film().rfilter()) == f"GaussianFilter[stddev={scene.view.film.filter.stddev:.2f}, radius=2.00]"
    assert scene.view.film.filter == Gaussian(0.5, 2)
    # 50 mm on 36 x 24 mm film, measured along the diagonal; Mitsuba stores the resulting angle along x
    assert scene.view.camera.fov_axis == "diagonal"
    x_fov = 2 * math.degrees(math.atan(math.tan(math.radians(scene.view.camera.fov / 2)) * 4 / 5))
    assert x_fov == pytest.approx(params["x_fov"], rel=1e-5)
    path = mitsuba.load_string('<scene version="3.0.0"><integrator type="path"/></scene>').integrator()
    assert f"rr_depth = {scene.integrator.rr_depth}\n" in str(path)
    assert scene.integrator.max_depth == -1 and any("<integrator>" in note for note in scene.notes)


def test_thin_lens_focuses_at_the_far_clip_unless_told(read, mitsuba):
    lens = '<float name="aperture_radius" value="0.1"/><float name="far_clip" value="9"/>'
    lens = f'<sensor type="thinlens">{lens}</sensor>'
    camera = read("", sensor=lens).view.camera
    theirs = mitsuba.traverse(mitsuba.load_string(f'<scene version="3.0.0">{lens}</scene>').sensors()[0])
    assert camera.aperture_radius == 0.1
    assert camera.focus_distance == pytest.approx(theirs["focus_distance"]) == 9


def test_direct_is_one_bounce_without_roulette(read):
    integrator = read('<integrator type="direct"><boolean name="hide_emitters" value="true"/></integrator>').integrator
    assert (integrator.max_depth, integrator.hide_emitters) == (2, True)
    assert integrator.rr_depth > 2


def test_film_crop_filter_and_settings_without_effect(read):
    film = """<film type="hdrfilm"><integer name="width" value="40"/><integer name="height" value="30"/>
      <integer name="crop_offset_x" value="4"/><integer name="crop_width" value="20"/>
      <string name="pixel_format" value="rgb"/><string name="component_format" value="float16"/>
      <rfilter type="gaussian"><float name="stddev" value="0.7"/></rfilter></film>"""
    scene = read("", sensor=f'<sensor type="perspective">{film}</sensor>')
    assert scene.view.film.crop == (4, 0, 20, 30)
    assert (scene.view.film.filter.stddev, scene.view.film.filter.radius) == (0.7, pytest.approx(2.8))
    assert any("component_format has no effect" in note for note in scene.notes)


@pytest.mark.parametrize("kind", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"])
def test_any_sampler_sets_spp_and_is_noted(read, kind):
    inside = '<integer name="sample_count" value="9"/><integer name="seed" value="4000000000"/>'
    scene = read("", sensor=f'<sensor type="perspective"><sampler type="{kind}">{inside}</sampler></sensor>')
    assert (scene.view.spp, scene.view.sampler) == (9, kind)
    assert any(kind in note for note in scene.notes)


FILM = '<film type="hdrfilm">{}</film>'


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ('<float name="fov" value="180"/>', "below 180"),
        ('<float name="fov" value="0"/>', "above 0"),
        ('<float name="fov" value="30"/><string name="focal_length" value="50mm"/>', "excludes fov"),
        ('<string name="focal_length" value="5cm"/>', 'like "50mm"'),
        ('<string name="fov_axis" value="z"/><float name="fov" value="30"/>', "use x or y"),
        ('<string name="fov_axis" value="y"/>', "needs fov beside it"),
        ('<float name="fv" value="30"/>', 'did you mean "fov"?'),
        ('<float name="near_clip" value="0"/>', "above 0"),
        ('<float name="near_clip" value="5"/><float name="far_clip" value="2"/>', "smaller than far_clip"),
        ('<float name="aperture_radius" value="1"/>', "is not a parameter of"),
        ('<transform name="to_world"><scale value="2"/></transform>', "turned and moved only"),
        (FILM.format('<integer name="width" value="0"/>'), "must be from 1"),
        (FILM.format('<integer name="width" value="40000"/><integer name="height" value="40000"/>'), "pixels"),
        (FILM.format('<integer name="width" value="99999999999999999999999"/>'), "not an integer"),
        (FILM.format('<string name="width" value="10"/>'), "cannot be a <string>; give it as <integer>"),
        (FILM.format('<float name="width" value="10"/>'), "cannot be a <float>"),
        (FILM.format('<integer name="widht" value="10"/>'), 'did you mean "width"'),
        (FILM.format('<integer name="crop_offset_x" value="10"/>'), "beyond the film"),
        (FILM.format('<string name="pixel_format" value="rbg"/>'), 'did you mean "rgb"'),
        (FILM.format('<string name="banner" value="no"/>'), "cannot be a <string>; give it as <boolean>"),
        ('<string name="shutter_open" value="0"/>', "cannot be a <string>; give it as <float>"),
        (FILM.format('<rfilter type="gaussian"><float name="radius" value="2"/></rfilter>'), "it has: stddev"),
        ('<film type="specfilm"/>', "use one of hdrfilm"),
        ('<sampler type="independent"><integer name="sample_count" value="0"/></sampler>', "must be from 1"),
        ('<sampler type="random"/>', "use one of independent"),
        ("<film/>", 'lacks the attribute "type"'),
    ],
)
def test_sensors_that_are_not_modelled_are_refused(refused, inside, words):
    assert words in refused("", line=1, sensor=f'<sensor type="perspective">{inside}</sensor>')


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<integrator type="depth"/>', "is not supported: it shows distances, which `pathjax render --aov depth`"),
        ('<integrator type="pth"/>', 'did you mean "path"'),
        ('<integrator type="moment"/>', "needs an <integrator> inside"),
        (f'<integrator type="moment">{2 * PATH}</integrator>', "takes at most 1"),
        (2 * PATH, "one <integrator> is supported here"),
        ('<integer name="embree_use_robust_intersections" value="1"/>', "cannot be a <integer>; give it as <boolean>"),
        ('<integrator type="path"><integer name="max_depth" value="-2"/></integrator>', "from -1"),
        ('<integrator type="path"><integer name="rr_depth" value="0"/></integrator>', "from 1"),
        ('<integrator type="direct"><integer name="emitter_samples" value="-1"/></integrator>', "must be from 0"),
        ('<float name="x" value="1"/>', "not supported directly in <scene>"),
        ('<sensr type="perspective"/>', 'did you mean "sensor"?'),
    ],
)
def test_top_level_elements_that_are_not_modelled_are_refused(refused, body, words):
    assert words in refused(body)


def test_a_scene_without_sensor_is_seen_by_one_that_frames_it(tmp_path):
    """The same holds after the scene is saved and loaded."""
    place = '<transform name="to_world"><scale value="3"/><translate x="40" z="7"/></transform>'
    body = shape(place, "cube") + '<emitter type="constant"/>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    scene = pj.load_scene(tmp_path / "scene.xml")
    assert any("has no <sensor>; one that frames its shapes is used" in note for note in scene.about.description.notes)
    pj.save_scene(scene, tmp_path / "again.xml")
    for each in (scene, pj.load_scene(tmp_path / "again.xml")):
        corners = np.array(list(itertools.product((37, 43), (-3, 3), (4, 10)))) - each.camera.origin
        x, y, z = each.camera.axes @ corners.T
        on_film = (np.stack([x / z, y / z], 1) - each.camera.corner) / each.camera.extent
        assert 0 < on_film.min() < on_film.max() < 1 and np.ptp(on_film, 0).max() > 0.5


def test_what_holds_nothing_to_be_seen_has_a_camera_at_the_origin(read):
    scene = read("", sensor="")
    np.testing.assert_array_equal(scene.view.camera.to_world, np.eye(4))
    assert any("one at the origin is used" in note for note in scene.notes)


def test_a_sensor_on_a_shape_is_used_where_there_is_no_other(read, refused):
    film = '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/></film>'
    meter = shape(f'<sensor type="irradiancemeter">{film}</sensor>', "rectangle")
    assert any("is left out, as the sensor at" in note for note in read(meter).notes)
    assert read(meter, sensor="").view.camera.shape.geometry.closed is False
    assert "measures one number" in refused(meter.replace(film, ""), sensor="")


def test_films_and_samplers_may_be_referred_to(read):
    film = '<film type="hdrfilm" id="film"><integer name="width" value="12"/></film>'
    drawn = '<sampler type="independent" id="drawn"><integer name="sample_count" value="9"/></sampler>'
    scene = read(film + drawn, sensor='<sensor type="perspective"><ref id="film"/><ref id="drawn"/></sensor>')
    assert scene.view.film.width == 12 and scene.view.spp == 9
    assert any('<film type="hdrfilm"> is used by nothing' in note for note in read('<film type="hdrfilm"/>').notes)


def test_what_is_no_xml_to_the_letter_is_read_as_mitsuba_does(tmp_path):
    """Comments with -- and bytes of other encodings, a declaration after an empty line, a bare ampersand."""
    inside = (
        '<!-- ---- a\n-- b -- --><bsdf type="diffuse" id="a &amp; b & c"/><!-- \xe9 --><shape type="cube" wrong=""/>'
    )
    text = f'\n<?xml version="1.0"?>\n<scene version="3.0.0">{SENSOR}{inside}</scene>'
    (tmp_path / "scene.xml").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r'scene\.xml:4: <shape type="cube"> has no attribute "wrong"'):
        load(tmp_path / "scene.xml")
    (tmp_path / "scene.xml").write_bytes(text.replace('wrong=""', "").encode("latin-1"))
    assert "a & b & c" in load(tmp_path / "scene.xml").document.ids


DECLARED = "scene [\n<!ELEMENT a ANY><!ATTLIST a b ']>'>\n]"


@pytest.mark.parametrize("kind", ["scene", 'scene SYSTEM "a>.dtd"', 'scene PUBLIC "-//[" "b"', DECLARED])
def test_a_document_type_is_skipped(tmp_path, kind):
    """As in Mitsuba; line numbers stay right."""
    text = f'<?xml version="1.0"?>\n<!-- a -->\n<!DOCTYPE {kind}>\n<scene version="3.0.0">{SENSOR}\n<shape/></scene>'
    (tmp_path / "scene.xml").write_text(text)
    line = text[: text.index("<shape")].count("\n") + 1
    with pytest.raises(InputError, match=rf"scene\.xml:{line}: <shape> "):
        load(tmp_path / "scene.xml")
    (tmp_path / "scene.xml").write_text(text.replace("<shape/>", shape()))
    assert len(load(tmp_path / "scene.xml").shapes) == 1


@pytest.mark.parametrize("version", ["2.0.0", "3.99.1", "4.0.0", "10.2.0"])
def test_newer_versions_are_read_as_they_stand(tmp_path, version):
    """As in Mitsuba: the rules for old files apply to major versions 0 and 1, and 10 is neither."""
    (tmp_path / "scene.xml").write_text(f'<scene version="{version}">{SENSOR}{shape()}</scene>')
    assert len(load(tmp_path / "scene.xml").shapes) == 1


@pytest.mark.parametrize(
    ("kind", "depth"), [("path", 0), ("volpath", 0), ("ptracer", 0), ("prb", 1), ("prbvolpath", 1)]
)
def test_a_depth_of_0_is_what_mitsuba_makes_of_it(tmp_path, kind, depth):
    inside = f'<integrator type="{kind}"><integer name="max_depth" value="0"/></integrator><emitter type="constant"/>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{SENSOR}{inside}</scene>')
    scene = pj.load_scene(tmp_path / "scene.xml")
    assert any("max_depth" in note for note in scene.about.description.notes)
    assert scene.max_depth == depth and (np.asarray(pj.render(scene, spp=1)).max() > 0) == (depth > 0)


@pytest.mark.parametrize(("before", "encoding"), [("", "utf-16"), ("", "latin-1"), ("\n\n", "latin-1"), ("", "utf-8")])
def test_the_declared_encoding_is_that_of_the_file(tmp_path, before, encoding):
    text = f'{before}<?xml version="1.0" encoding="{encoding}"?><scene version="3.0.0">{SENSOR}'
    text += '<!-- c --><bsdf type="diffuse" id="\xe9 &amp; b"/></scene>'
    (tmp_path / "scene.xml").write_bytes(text.encode(encoding))
    assert "\xe9 & b" in load(tmp_path / "scene.xml").document.ids


def test_text_between_elements_is_noted_at_its_line(read):
    notes = read(f"{shape()}>\n{shape()} word").notes
    assert [note[note.index("scene.xml") :] for note in notes if "text between" in note] == [
        "scene.xml:2: text between elements has no effect: '>'",
        "scene.xml:3: text between elements has no effect: 'word'",
    ]


def test_merged_shapes_stand_for_themselves(read):
    inside = shape(kind="cube", attributes='id="box"') + shape('<emitter type="area"/>', "rectangle", 'id="lamp"')
    scene = read(shape(inside, "merge"))
    assert [each.name for each in scene.shapes] == ["box", "lamp"] and scene.shapes[1].emitter is not None


def test_objects_that_nothing_uses_are_checked_and_noted_but_may_be_of_any_kind_of_mitsuba(read, refused):
    spare = '<bsdf type="{}" id="spare"/>'
    for each in (spare.format("diffuse"), spare.format("hair"), f'<bsdf type="twosided">{spare.format("hair")}</bsdf>'):
        assert any("is used by nothing" in note for note in read(each + shape()).notes)
    assert "hairy" in refused(spare.format("hairy"))
    assert "roughness" in refused('<bsdf type="diffuse" id="spare"><float name="roughness" value="1"/></bsdf>')


# --- what Mitsuba's plugins take, and no image depends on

PICTURE = '<string name="filename" value="picture.png"/>'
FOV = '<float name="fov" value="40"/>'
HALF = '<float name="value" value="0.5"/>'
WITHOUT_EFFECT = [
    (
        "perspective",
        f'<sensor type="perspective">{FOV}{{}}</sensor>',
        ["focus_distance", "shutter_open", "shutter_close"],
    ),
    (
        "thinlens",
        f'<sensor type="thinlens">{FOV}<float name="aperture_radius" value="1"/>{{}}</sensor>',
        ["shutter_open", "shutter_close"],
    ),
    (
        "hdrfilm",
        '<sensor type="perspective"><film type="hdrfilm">{}</film></sensor>',
        ["file_format", "component_format", "compensate", "banner"],
    ),
    ("path", '<integrator type="path">{}</integrator>', ["block_size", "samples_per_pass", "timeout"]),
    ("volpath", '<integrator type="volpath">{}</integrator>', ["block_size", "samples_per_pass", "timeout"]),
    ("volpathmis", '<integrator type="volpathmis">{}</integrator>', ["use_spectral_mis"]),
    ("direct", '<integrator type="direct">{}</integrator>', ["emitter_samples", "bsdf_samples", "timeout"]),
    ("direct of both", '<integrator type="direct">{}</integrator>', ["shading_samples"]),
    (
        "moment",
        '<integrator type="moment">{}<integrator type="path"/></integrator>',
        ["block_size", "samples_per_pass", "timeout", "hide_emitters"],
    ),
    ("aov", '<integrator type="aov">{}<integrator type="path"/></integrator>', ["aovs", "timeout"]),
    ("independent", '<sensor type="perspective"><sampler type="independent">{}</sampler></sensor>', ["seed"]),
    (
        "orthogonal",
        '<sensor type="perspective"><sampler type="orthogonal">{}</sampler></sensor>',
        ["jitter", "strength"],
    ),
    ("sphere", shape("{}"), ["silhouette_sampling_weight"]),
    ("rectangle", shape("{}", "rectangle"), ["silhouette_sampling_weight", "face_normals"]),
    ("cube", shape("{}", "cube"), ["face_normals"]),
    ("constant", '<emitter type="constant">{}</emitter>', ["to_world"]),
    ("envmap", f'<emitter type="envmap">{PICTURE}{{}}</emitter>', ["mis_compensation"]),
    (
        "bitmap",
        with_bsdf("diffuse", f'<texture type="bitmap" name="reflectance">{PICTURE}{{}}</texture>'),
        ["accel", "format"],
    ),
    *(
        (
            f"uniform {tag}",
            with_bsdf("diffuse", f'<{tag} type="uniform" name="reflectance">{HALF}{{}}</{tag}>'),
            ["wavelength_min", "wavelength_max"],
        )
        for tag in ("texture", "spectrum")
    ),
    ("scene", "{}", ["embree_use_robust_intersections", "allow_thread_reordering"]),
    (
        "scene's tree",
        "{}",
        ["kd_clip", "kd_retract_bad_splits", "kd_traversal_cost", "kd_intersection_cost", "kd_empty_space_bonus"]
        + ["kd_max_depth", "kd_min_max_bins", "kd_stop_prims", "kd_exact_primitive_threshold"],
    ),
]
VALUE_OF = {
    **dict.fromkeys(("focus_distance", "shutter_open", "shutter_close", "timeout"), ("float", "1")),
    "silhouette_sampling_weight": ("float", "0.5"),
    **dict.fromkeys(("wavelength_min", "wavelength_max"), ("float", "400")),
    **dict.fromkeys(("kd_traversal_cost", "kd_intersection_cost", "kd_empty_space_bonus"), ("float", "0.5")),
    **dict.fromkeys(("block_size", "samples_per_pass", "seed", "strength"), ("integer", "2")),
    **dict.fromkeys(("shading_samples", "emitter_samples", "bsdf_samples"), ("integer", "4")),
    **dict.fromkeys(("kd_max_depth", "kd_min_max_bins", "kd_stop_prims"), ("integer", "8")),
    "kd_exact_primitive_threshold": ("integer", "8"),
    "file_format": ("string", "openexr"),
    "component_format": ("string", "float32"),
    "aovs": ("string", "dd:depth"),
    "format": ("string", "fp16"),
}


def given(name: str) -> str:
    if name == "to_world":
        return '<transform name="to_world"><rotate y="1" angle="30"/></transform>'
    tag, value = VALUE_OF.get(name, ("boolean", "true"))
    return f'<{tag} name="{name}" value="{value}"/>'


def loaded(read, place: str, inside: str) -> d.Description:
    """Return a scene with `inside` put into the element `place`, which may be the sensor."""
    made = place.format(inside)
    return read("", sensor=made) if made.startswith("<sensor") else read(made)


@pytest.mark.parametrize(("place", "names"), [case[1:] for case in WITHOUT_EFFECT], ids=[c[0] for c in WITHOUT_EFFECT])
def test_what_has_no_effect_is_taken_and_noted(read, picture, place, names):
    def told(scene):
        return {name for note in scene.notes for name in names if f": {name} has no effect" in note}

    with_it, without = (loaded(read, place, inside) for inside in ("".join(map(given, names)), ""))
    assert told(with_it) == set(names) and not told(without)
    assert with_it.integrator == without.integrator and with_it.view.spp == without.view.spp
    assert repr(with_it.view.camera) == repr(without.view.camera) and with_it.view.film == without.view.film


@pytest.mark.parametrize(("place", "names"), [case[1:] for case in WITHOUT_EFFECT], ids=[c[0] for c in WITHOUT_EFFECT])
def test_mitsuba_takes_what_has_no_effect(mitsuba, picture, tmp_path, place, names):
    inside = "".join(map(given, names))
    body = place.format(inside).replace("picture.png", str(tmp_path / "picture.png"))
    mitsuba.load_string(f'<scene version="3.0.0">{body}</scene>')  # raises where a parameter is unknown


@pytest.mark.parametrize(
    ("integrator", "words"),
    [
        ('<integrator type="volpath">{}</integrator>', "without media is the same as path"),
        ('<integrator type="volpathmis">{}</integrator>', "without media is the same as path"),
        ('<integrator type="prb">{}</integrator>', "its image is that of path"),
        ('<integrator type="prb_basic">{}</integrator>', "which finds lights of no size, too"),
        (
            '<integrator type="prb_projective"><string name="guiding" value="grid"/>{}</integrator>',
            "its image is that of path",
        ),
        ('<integrator type="ptracer">{}</integrator>', "traces from the lights; path is used"),
        (
            '<integrator type="aov"><string name="aovs" value="a:depth"/>'
            '<integrator type="path">{}</integrator></integrator>',
            "output variables are those of render_aovs",
        ),
        ('<integrator type="moment"><integrator type="path">{}</integrator></integrator>', "--aov error"),
        ('<integrator type="stokes"><integrator type="volpath">{}</integrator></integrator>', "no polarisation"),
        (
            '<integrator type="moment"><integrator type="volpath">{}</integrator></integrator>',
            '<integrator type="volpath"> without media',
        ),
    ],
)
def test_integrators_that_estimate_the_same_are_path_and_noted(read, integrator, words):
    limits = '<integer name="max_depth" value="3"/><integer name="rr_depth" value="2"/>'
    scene = read(integrator.format(limits))
    volume = "volpath" in integrator
    assert scene.integrator == d.Integrator(max_depth=3, rr_depth=2, free_passes=volume, media=volume)
    assert any(words in note for note in scene.notes)


def test_output_variables_alone_go_with_path(read):
    scene = read('<integrator type="aov"><string name="aovs" value="a:depth"/></integrator>')
    assert scene.integrator == d.Integrator() and any("holds no integrator, so path is used" in x for x in scene.notes)


def test_a_scene_may_have_an_id(write_scene):
    path = write_scene('<emitter type="constant"/>')
    path.write_text(path.read_text().replace("<scene ", '<scene id="all" ', 1))
    pj.load_scene(path)


def test_direct_light_with_derivatives_of_edges_is_direct(read):
    inside = '<integer name="max_depth" value="-1"/><integer name="sppi" value="9"/>'
    inside += '<boolean name="hide_emitters" value="true"/>'
    scene = read(f'<integrator type="direct_projective">{inside}</integrator>')
    assert scene.integrator == d.Integrator(max_depth=2, hide_emitters=True)
    assert any("its image is that of direct" in note for note in scene.notes)


def test_prb_ends_at_its_own_depth(read):
    assert read('<integrator type="prb"/>').integrator == d.Integrator(max_depth=6)


def test_the_first_of_several_sensors_is_used(read):
    second = '<sensor type="orthographic" id="other"/>'
    scene = read(second, sensor=f'<sensor type="perspective">{FOV}</sensor>')
    assert scene.view.camera.fov == 40
    assert any('scene.xml:2: <sensor type="orthographic"> is left out' in note for note in scene.notes)


@pytest.mark.parametrize("which", [1, "1", "right"])
def test_another_sensor_is_chosen_by_its_number_or_id(tmp_path, which):
    views = "".join(
        f'<sensor type="perspective" id="{name}"><float name="fov" value="{fov}"/></sensor>'
        for name, fov in (("left", 30), ("right", 50))
    )
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{views}</scene>')
    assert load(tmp_path / "scene.xml", which).view.camera.fov == 50
    with pytest.raises(InputError, match=r"scene.xml: there is no sensor \'rihgt\'; use 0 to 1 or left, right; did"):
        load(tmp_path / "scene.xml", "rihgt")
    with pytest.raises(InputError, match="there is no sensor 2; use 0 to 1"):
        load(tmp_path / "scene.xml", 2)


@pytest.mark.parametrize("pixels", ["RGBA", "luminance", "luminance_alpha", "xyz", "xyza"])
def test_images_are_linear_rgb_whatever_the_pixel_format(read, pixels):
    film = f'<film type="hdrfilm"><string name="pixel_format" value="{pixels}"/></film>'
    scene = read("", sensor=f'<sensor type="perspective">{film}</sensor>')
    assert any(f"asks for {pixels.lower()}; images are linear RGB here" in note for note in scene.notes)


def test_a_light_may_be_referred_to_by_its_shape(read):
    light = '<emitter type="area" id="glow"><rgb name="radiance" value="1, 2, 3"/></emitter>'
    scene = read(light + shape('<ref id="glow"/>'))
    assert scene.emitters == () and scene.shapes[0].emitter.name == "glow"
    np.testing.assert_array_equal(scene.shapes[0].emitter.values["radiance"], [1, 2, 3])


def test_a_light_that_no_shape_refers_to_is_noted(read):
    scene = read('<emitter type="area" id="glow"/>' + shape())
    assert scene.emitters == () and scene.shapes[0].emitter is None
    assert any('<emitter type="area"> is used by nothing' in note for note in scene.notes)


def test_a_medium_that_nothing_uses_is_noted(read):
    scene = read('<medium type="homogeneous" id="fog"/>' + shape())
    assert any('<medium type="homogeneous"> is used by nothing' in note for note in scene.notes)


# --- older files

OLD = """<scene version="0.6.0">
  <integrator type="path"><integer name="maxDepth" value="7"/><integer name="rrDepth" value="3"/></integrator>
  <sensor type="perspective">
    <float name="nearClip" value="0.5"/><float name="farClip" value="20"/>
    <string name="fovAxis" value="smaller"/><float name="fov" value="30"/>
    <transform name="toWorld"><lookAt origin="0, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
    <sampler type="independent"><integer name="sampleCount" value="16"/></sampler>
    <film type="hdrfilm"><integer name="width" value="40"/><boolean name="banner" value="false"/></film>
  </sensor>
  <bsdf type="dielectric" id="glass"><float name="intIOR" value="1.7"/><float name="extIOR" value="1.1"/></bsdf>
  <bsdf type="diffuse" id="board">
    <texture type="checkerboard" name="diffuseReflectance">
      <float name="uscale" value="4"/><float name="vscale" value="2"/><float name="uoffset" value="0.25"/>
    </texture>
  </bsdf>
  <shape type="sphere"><boolean name="flipNormals" value="true"/><ref id="glass"/></shape>
  <shape type="rectangle"><transform name="toWorld"><translate x="1"/></transform><ref id="board"/></shape>
</scene>
"""


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "old.xml"
    path.write_text(OLD)
    return path


def test_older_files_have_older_names(old):
    scene = load(old)
    assert scene.integrator == d.Integrator(max_depth=7, rr_depth=3) and scene.view.spp == 16
    assert (scene.view.camera.near_clip, scene.view.camera.far_clip, scene.view.camera.fov_axis) == (0.5, 20, "smaller")
    np.testing.assert_allclose(scene.view.camera.to_world[:3, 3], [0, 1, 5])
    glass, board = (shape.bsdf.values for shape in scene.shapes)
    assert (glass["int_ior"], glass["ext_ior"]) == (1.7, 1.1) and scene.shapes[0].flip_normals
    np.testing.assert_array_equal(board["reflectance"].values["to_uv"], [[4, 0, 1], [0, 2, 0]])  # shifts, then scales
    np.testing.assert_array_equal(scene.shapes[1].geometry.to_world[:3, 3], [1, 0, 0])


def test_older_files_mean_what_they_mean_to_mitsuba(mitsuba, old):
    old.write_text(OLD.replace("lookAt", "lookat"))  # Mitsuba 3.9 no longer renames this one
    ours, theirs = load(old), mitsuba.load_file(str(old))
    sensor = mitsuba.traverse(theirs.sensors()[0])
    np.testing.assert_allclose(ours.view.camera.to_world, np.array(sensor["to_world"].matrix), atol=1e-6)
    assert sensor["far_clip"] == ours.view.camera.far_clip
    glass, board = (mitsuba.traverse(shape.bsdf()) for shape in theirs.shapes())
    assert glass["eta"] == pytest.approx(1.7 / 1.1)
    to_uv = np.array(board["reflectance.to_uv"].matrix)
    np.testing.assert_allclose(ours.shapes[1].bsdf.values["reflectance"].values["to_uv"], to_uv[:2, :3], atol=1e-6)


def test_names_of_older_files_are_no_names_of_newer_ones(old):
    old.write_text(OLD.replace("0.6.0", "3.0.0"))
    with pytest.raises(InputError, match=r'old\.xml:2: <integer name="maxDepth"> is not a parameter'):
        load(old)


def test_an_older_file_may_be_included_by_a_newer_one(read, tmp_path):
    inside = '<scene version="0.5.0"><shape type="sphere"><boolean name="flipNormals" value="true"/></shape></scene>'
    (tmp_path / "part.xml").write_text(inside)
    assert read('<include filename="part.xml"/>').shapes[0].flip_normals


# --- files that are no scenes


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", ":1: not well-formed XML: no element found"),
        (b"\x00\xff\xfe garbage", ":1: not well-formed"),
        (b'<scene version="3.0.0">\n<shape>\n</scene>', ":3: not well-formed XML: mismatched tag"),
        (b'<!DOCTYPE scene [<!ENTITY a "aaaa">]>\n<scene version="3.0.0">&a;</scene>', ":2: not well-formed XML: und"),
        (b'<!DOCTYPE scene SYSTEM "a\n<scene version="3.0.0"/>', ":2: not well-formed"),
        ('<!DOCTYPE scene>\n<scene version="3.0.0"/>'.encode("utf-16"), ":1: a document type (<!DOCTYPE>) is not"),
        (b"<scene/>", 'lacks the attribute "version"'),
        (b'<scene version="4.0"/>', 'version "4.0" is not of the form'),
        (b'<scene version="0.6"/>', 'version "0.6" is not of the form'),
        (b'<scene version="3.0.0" type="x"/>', 'no attribute "type"'),
        (b'<shape type="sphere"/>', "the outermost element is"),
        (b"<a>" * 100_000, "nested more than"),
        (b'<?xml version="1.0" encoding="klingon"?><scene/>', ":1: "),
    ],
)
def test_files_that_are_no_scenes_are_refused(tmp_path, data, words):
    (tmp_path / "bad.xml").write_bytes(data)
    with pytest.raises(InputError) as caught:
        load(tmp_path / "bad.xml")
    assert f"{tmp_path}/bad.xml:" in str(caught.value) and words in str(caught.value)


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"none\.xml: no such file"):
        load(tmp_path / "none.xml")
    with pytest.raises(InputError, match="not a file"):
        load(tmp_path)
    with pytest.raises(InputError, match="cannot be read|no such file"):
        load(tmp_path / ("x" * 5000))


def test_a_scene_file_of_gigabytes_is_refused_unread(tmp_path):
    with open(tmp_path / "huge.xml", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="larger than"):
        load(tmp_path / "huge.xml")
