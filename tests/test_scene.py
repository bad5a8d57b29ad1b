"""Parameters by name: their names, the values they set, and the errors."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.scene import build
from pathjax.scene import parameters as named

ZOO = """
<bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf>
<bsdf type="twosided" id="card">
  <bsdf type="diffuse" id="front"><rgb name="reflectance" value="0.4"/></bsdf>
  <bsdf type="diffuse" id="back"><rgb name="reflectance" value="0.5"/></bsdf>
</bsdf>
<bsdf type="twosided" id="paper"><bsdf type="diffuse"><rgb name="reflectance" value="0.6"/></bsdf></bsdf>
<bsdf type="twosided" id="foil">
  <bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf>
  <bsdf type="conductor"/>
</bsdf>
<bsdf type="diffuse" id="board">
  <texture type="checkerboard" name="reflectance" id="checks">
    <rgb name="color0" value="0.9, 0.8, 0.7"/><rgb name="color1" value="0.2, 0.1, 0"/>
  </texture>
</bsdf>
<bsdf type="diffuse" id="tiles"><texture type="checkerboard" name="reflectance"/></bsdf>
<bsdf type="dielectric" id="glass"><float name="int_ior" value="1.6"/><float name="ext_ior" value="1.1"/></bsdf>
<bsdf type="conductor" id="copper"><rgb name="eta" value="0.2, 0.9, 1.1"/><rgb name="k" value="3.9, 2.5, 2.1"/></bsdf>
<bsdf type="conductor" id="mirror"><rgb name="specular_reflectance" value="0.9"/></bsdf>

<shape type="sphere"><ref id="paint"/></shape>
<shape type="cube"><ref id="paint"/></shape>
<shape type="rectangle"><ref id="card"/></shape>
<shape type="rectangle"><ref id="paper"/></shape>
<shape type="rectangle"><ref id="foil"/></shape>
<shape type="rectangle"><ref id="board"/></shape>
<shape type="rectangle"><ref id="tiles"/></shape>
<shape type="sphere"><ref id="glass"/></shape>
<shape type="sphere"><ref id="copper"/></shape>
<shape type="sphere"><ref id="mirror"/></shape>
<shape type="disk" id="lamp"><emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter></shape>
<shape type="sphere"><emitter type="area" id="bulb"><rgb name="radiance" value="4"/></emitter></shape>
<emitter type="constant" id="sky"><rgb name="radiance" value="0.5"/></emitter>
"""
VALUES = {
    "paint.reflectance": [0.1, 0.2, 0.3],
    "front.reflectance": [0.4] * 3,
    "back.reflectance": [0.5] * 3,
    "paper.reflectance": [0.6] * 3,
    "foil_front.reflectance": [0.7] * 3,
    "foil_back.specular_reflectance": [1.0] * 3,
    "checks.color0": [0.9, 0.8, 0.7],
    "checks.color1": [0.2, 0.1, 0],
    "tiles.color0": [0.4] * 3,
    "tiles.color1": [0.2] * 3,
    "glass.int_ior": 1.6,
    "glass.ext_ior": 1.1,
    "copper.eta": [0.2, 0.9, 1.1],
    "copper.k": [3.9, 2.5, 2.1],
    "copper.specular_reflectance": [1.0] * 3,
    "mirror.specular_reflectance": [0.9] * 3,
    "lamp.radiance": [1, 2, 3],
    "bulb.radiance": [4] * 3,
    "sky.radiance": [0.5] * 3,
}


@pytest.fixture(scope="module")
def zoo(make_scene):
    return make_scene(ZOO)


def arrays(scene):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(scene)]


def values(scene):
    return {name: np.asarray(value) for name, value in pj.parameters(scene).items()}


# ---- names and values -----------------------------------------------------------------------------------------------


def test_parameters_have_the_names_shapes_and_values_of_the_file(zoo):
    found = values(zoo)
    unnamed = {"lamp.reflectance", *(name for name in found if re.match(r"bsdf\d+\.reflectance$", name))}
    assert found.keys() - unnamed == VALUES.keys()  # lights without a bsdf have reflectance 0, which can be changed
    for name, expected in VALUES.items():
        assert found[name].shape == np.shape(expected)
        np.testing.assert_allclose(found[name], expected, rtol=1e-6)


def test_every_parameter_reaches_one_entry_and_no_other(zoo):
    before = values(zoo)
    for name in before:
        after = values(pj.with_parameters(zoo, {name: before[name] * 0.5 + 0.31}))
        assert [other for other in before if not np.array_equal(after[other], before[other])] == [name]
        np.testing.assert_allclose(after[name], before[name] * 0.5 + 0.31, rtol=1e-6)


def textured(*sizes):
    """Return a scene with a rectangle for each texture, with the given sizes in texels along a side."""
    rng = np.random.default_rng(0)
    images = {
        f"b{k}": {"type": "bitmap", "data": rng.random((n, n, 3)).astype(np.float32), "raw": True}
        for k, n in enumerate(sizes)
    }
    bsdfs = {name: {"type": "diffuse", "id": name, "reflectance": image} for name, image in images.items()}
    shapes = {f"s{name}": {"type": "rectangle", "bsdf": {"type": "ref", "id": name}} for name in bsdfs}
    rest = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    return pj.load_dict(rest | bsdfs | shapes)


@pytest.mark.parametrize("names", [["b1"], ["b2", "b0"], ["b2", "b0", "b1"]])
def test_textures_that_are_set_together_are_those_set_one_after_another(names):
    scene = textured(2, 3, 1)
    names = [f"{name}.reflectance" for name in names]
    new = {name: jnp.sqrt(pj.parameters(scene)[name]) for name in names}
    together, alone = pj.with_parameters(scene, new), scene
    for name in names:
        alone = pj.with_parameters(alone, {name: new[name]})
    for a, b in zip(arrays(together), arrays(alone), strict=True):
        np.testing.assert_array_equal(a, b)
    for name, value in values(together).items():
        np.testing.assert_array_equal(value, new[name] if name in new else values(scene)[name])


def test_what_textures_replace_is_not_read():
    """Textures may be most of a scene, and whatever a jitted function reads of a scene is copied to each device."""
    scene = textured(2, 3)
    path = scene.described.parameters["b0.reflectance"].path

    def with_all(texels, new):
        return jax.tree.leaves(pj.with_parameters(named.put(scene, path, texels), new))

    new = {name: x for name, x in pj.parameters(scene).items() if name.startswith("b")}
    program = jax.make_jaxpr(with_all)(named.get(scene, path), new).jaxpr
    read = {id(v) for eqn in program.eqns for v in eqn.invars} | {id(v) for v in program.outvars}
    assert id(program.invars[0]) not in read


def test_with_parameters_leaves_the_scene_as_it_was(zoo):
    before = arrays(zoo)
    pj.with_parameters(zoo, {"paint.reflectance": 0.9, "glass.int_ior": 2.0})
    for a, b in zip(before, arrays(zoo), strict=True):
        np.testing.assert_array_equal(a, b)


def test_setting_what_is_there_changes_nothing(zoo):
    for a, b in zip(arrays(zoo), arrays(pj.with_parameters(zoo, pj.parameters(zoo))), strict=True):
        np.testing.assert_array_equal(a, b)


def test_one_number_stands_for_all_channels(zoo):
    changed = values(pj.with_parameters(zoo, {"paint.reflectance": 0.25, "glass.int_ior": 2}))
    np.testing.assert_array_equal(changed["paint.reflectance"], [0.25] * 3)
    assert changed["glass.int_ior"] == 2


def test_a_shared_bsdf_is_one_row_and_one_parameter(zoo):
    sphere, cube = zoo.materials.sides[0], zoo.materials.sides[1]
    np.testing.assert_array_equal(sphere, cube)
    assert sum(name.startswith("paint") for name in pj.parameters(zoo)) == 1


def test_the_two_sides_of_a_shape_are_apart(zoo):
    card, paper = np.asarray(zoo.materials.sides[2]), np.asarray(zoo.materials.sides[3])
    assert card[0, 1] != card[1, 1]
    np.testing.assert_array_equal(paper[0], paper[1])


def test_the_back_of_a_one_sided_reflector_absorbs_and_glass_has_two_sides(zoo):
    sides = np.asarray(zoo.materials.sides)
    assert sides[0, 1, 0] == -1
    np.testing.assert_array_equal(sides[7, 0], sides[7, 1])


def test_bounds_are_those_of_the_quantity(zoo):
    bounds = {name: p.bounds for name, p in zoo.about.parameters.items()}
    assert bounds["paint.reflectance"] == bounds["checks.color1"] == bounds["mirror.specular_reflectance"] == (0, 1)
    assert bounds["lamp.radiance"] == bounds["copper.k"] == (0, np.inf)
    low, high = bounds["glass.int_ior"]
    assert 0 < low < 5e-3 and high == np.inf  # far below that of any medium


def test_every_shipped_scene_round_trips_its_parameters(root):
    for path in sorted((root / "scenes").glob("*.xml")):
        scene = pj.load_scene(path, res=8)
        assert pj.parameters(scene)
        for a, b in zip(arrays(scene), arrays(pj.with_parameters(scene, pj.parameters(scene))), strict=True):
            np.testing.assert_array_equal(a, b)


# ---- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, offers",
    [
        ("paint.reflectence", "paint.reflectance"),
        ("pant.reflectance", "paint.reflectance"),
        ("glass.ior", "glass.int_ior"),
    ],
)
def test_unknown_names_get_near_ones(zoo, name, offers):
    with pytest.raises(pj.InputError, match=re.escape(name)) as caught:
        pj.with_parameters(zoo, {name: 0.5})
    assert offers in str(caught.value)


def test_trees_of_all_kinds_are_kept(make_scene):
    """A cube's tree too, although a table of rectangles holds the cubes, beside the table of disks."""
    place = '<transform name="to_world"><scale value="0.1"/><translate x="{}"/></transform>'
    cubes = "".join(f'<shape type="cube">{place.format(i)}</shape>' for i in range(40))
    assert list(make_scene(cubes + '<shape type="disk"/>').about.trees) == ["cube"]


def test_a_scene_without_parameters_says_so(make_scene):
    with pytest.raises(pj.InputError, match="none"):
        pj.with_parameters(make_scene(""), {"a.b": 1})


@pytest.mark.parametrize(
    "name, value",
    [
        ("paint.reflectance", [1, 2]),
        ("paint.reflectance", [[0.1, 0.2, 0.3]] * 2),
        ("paint.reflectance", "red"),
        ("paint.reflectance", None),
        ("paint.reflectance", {"r": 1}),
        ("paint.reflectance", 1.01),
        ("paint.reflectance", -0.01),
        ("paint.reflectance", [0.5, np.nan, 0.5]),
        ("lamp.radiance", -1),
        ("lamp.radiance", np.nan),
        ("lamp.radiance", np.inf),
        ("glass.int_ior", 0),
        ("glass.int_ior", [1.5, 1.5, 1.5]),
        ("glass.int_ior", np.inf),
        ("checks.color0", 2),
    ],
)
def test_values_of_the_wrong_shape_or_outside_the_bounds_are_refused_by_name(zoo, name, value):
    with pytest.raises(pj.InputError, match=re.escape(name)):
        pj.with_parameters(zoo, {name: value})


# ---- under tracing --------------------------------------------------------------------------------------------------


def test_values_may_be_traced(zoo):
    @jax.jit
    def change(ior, color):
        scene = pj.with_parameters(zoo, {"glass.int_ior": ior, "checks.color1": color})
        return pj.parameters(scene)

    changed = change(1.9, jnp.asarray([0.3, 0.2, 0.1]))
    np.testing.assert_allclose(changed["glass.int_ior"], 1.9, rtol=1e-6)
    np.testing.assert_allclose(changed["checks.color1"], [0.3, 0.2, 0.1], rtol=1e-6)
    np.testing.assert_allclose(changed["checks.color0"], VALUES["checks.color0"], rtol=1e-6)


def test_traced_values_of_the_wrong_shape_are_refused(zoo):
    with pytest.raises(pj.InputError, match="glass.int_ior"):
        jax.jit(lambda x: pj.parameters(pj.with_parameters(zoo, {"glass.int_ior": x})))(jnp.ones(3))


def test_a_scene_may_pass_through_transformations(zoo):
    """A Scene is a pytree: its names survive `jit` and `jax.tree.map`."""
    again = jax.jit(lambda scene: scene)(zoo)
    assert values(again).keys() == values(zoo).keys()
    doubled = jax.tree.map(lambda x: x * 2, zoo)
    np.testing.assert_allclose(values(doubled)["lamp.radiance"], [2, 4, 6])


def test_derivative_passes_through_with_parameters(zoo):
    def total(color):
        return sum(v.sum() for v in pj.parameters(pj.with_parameters(zoo, {"paint.reflectance": color})).values())

    np.testing.assert_array_equal(jax.grad(total)(jnp.full(3, 0.5)), [1, 1, 1])


def test_scenes_of_other_known_values_have_the_structure_of_the_first(zoo):
    """So they can be stacked and share kernels. Traced values are kept by name beside the tables."""
    changed = pj.with_parameters(zoo, {"glass.int_ior": 1.7, "paint.reflectance": 0.1})
    assert jax.tree.structure(changed) == jax.tree.structure(zoo)

    def inside(color):
        scene = pj.with_parameters(zoo, {"paint.reflectance": color, "glass.int_ior": 1.7})
        assert set(scene.varied) == {"paint.reflectance"}
        known = pj.with_parameters(scene, {"paint.reflectance": 0.1})
        assert jax.tree.structure(known) == jax.tree.structure(zoo)
        return color

    jax.jvp(inside, (jnp.ones(3),), (jnp.ones(3),))


def test_a_scene_made_in_a_jitted_function_holds_its_values(zoo):
    made = jax.jit(lambda color: pj.with_parameters(zoo, {"paint.reflectance": color}))(jnp.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(values(made)["paint.reflectance"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(values(pj.with_parameters(made, {"paint.reflectance": 0.4}))["paint.reflectance"], 0.4)


def test_float64_is_refused_where_jax_would_cut_it_down(zoo, x64):
    with pytest.raises(pj.InputError, match="jax_enable_x64"):
        build(zoo.about.description, jnp.float64)
    with x64():
        assert build(zoo.about.description, jnp.float64).camera.origin.dtype == jnp.float64


# ---- dark scenes ----------------------------------------------------------------------------------------------------

DARK = '<emitter type="constant"><rgb name="radiance" value="0"/></emitter>'


@pytest.mark.parametrize("lights, says", [("", "there is no light"), (DARK, "the radiance of every light is 0")])
def test_a_file_that_renders_black_is_warned_of(write_scene, lights, says):
    path = write_scene('<shape type="sphere"/>' + lights)
    with pytest.warns(pj.InputWarning, match=f"{path}: {says}, so images of it are black"):
        scene = pj.load_scene(path)
    assert not pj.render(scene, spp=1).any()


def test_a_dark_light_beside_a_bright_one_is_no_news(write_scene):
    bright = '<shape type="sphere"><emitter type="area"><rgb name="radiance" value="0, 0, 1e-9"/></emitter></shape>'
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pj.load_scene(write_scene(DARK + bright))
