"""A scene file becomes a scene of the requested precision, hierarchies and parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.scene import parameters as named

MESH = """
<default name="dtype" value="0.25"/>
<shape type="rectangle"><bsdf type="diffuse" id="wall"><rgb name="reflectance" value="$dtype"/></bsdf></shape>
<emitter type="constant"/>
"""


def test_float64_reaches_every_real_number(root, x64):
    with x64():
        scene = pj.load_scene(root / "scenes" / "mesh.xml", dtype=np.float64, res=8)
    kinds = {leaf.dtype for leaf in jax.tree.leaves(scene) if jnp.issubdtype(leaf.dtype, jnp.floating)}
    assert kinds == {np.dtype(np.float64)}
    with pytest.raises(pj.InputError, match="float64, which is off in JAX"):
        pj.load_scene(root / "scenes" / "mesh.xml", dtype=np.float64, res=8)


def test_split_rule_reaches_the_hierarchy(root):
    cost = {
        rule: pj.load_scene(root / "scenes" / "mesh.xml", split_rule=rule, res=8).about.trees["triangle"].sah_cost
        for rule in ("sah", "equal")
    }
    assert cost["sah"] < cost["equal"]
    with pytest.raises(pj.InputError, match="split_rule 'luck' is unknown; use one of sah"):
        pj.load_scene(root / "scenes" / "mesh.xml", split_rule="luck")


def test_each_of_several_sensors_gives_a_scene_of_its_own(write_scene):
    second = '<sensor type="perspective" id="near"><float name="fov" value="20"/></sensor>'
    file = write_scene(MESH + second)
    views = [pj.load_scene(file, sensor=which) for which in (0, 1, "near")]
    extents = [float(view.camera.extent[0]) for view in views]
    assert abs(extents[0]) > abs(extents[1]) == abs(extents[2])


SECOND = """<sensor type="perspective" id="near"><float name="fov" value="20"/>
  <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/></film></sensor>"""


def test_a_scene_is_seen_by_each_sensor_of_its_file(write_scene, tmp_path):
    """As if it had been loaded with that sensor, but with the present parameters; all else is shared."""
    file = write_scene(MESH + SECOND)
    scene = pj.with_parameters(pj.load_scene(file), {"wall.reflectance": 0.25})
    assert scene.sensors == ("0", "near")
    for which, name in ((1, "near"), ("near", "near"), (0, "0"), ("0", "0")):
        view = scene.with_sensor(which)
        loaded = pj.with_parameters(pj.load_scene(file, sensor=which), {"wall.reflectance": 0.25})
        assert jax.tree.structure(named.nameless(view)) == jax.tree.structure(named.nameless(loaded))
        for a, b in zip(jax.tree.leaves(view), jax.tree.leaves(loaded), strict=True):
            np.testing.assert_array_equal(a, b)
        assert view.about.description.seen == name and view.geometry is scene.geometry
        assert view.with_sensor(0).about.description.view.camera is scene.about.description.view.camera
    assert scene.with_sensor("near").film.width == 6
    with pytest.raises(pj.InputError, match="there is no sensor 'far'; use 0 to 1 or near"):
        scene.with_sensor("far")
    with pytest.raises(pj.InputError, match="there is no sensor 1; use 0$"):
        pj.load_scene(write_scene(MESH)).with_sensor(1)
    pj.save_scene(scene.with_sensor("near"), tmp_path / "saved.xml")
    assert pj.load_scene(tmp_path / "saved.xml").sensors == ("near", "1")


def test_a_sensor_that_is_not_supported_is_refused_where_it_is_asked_for(write_scene):
    scene = pj.load_scene(write_scene(MESH + '<sensor type="irradiancemeter" id="meter"/>'))
    assert scene.sensors == ("0", "meter")
    with pytest.raises(pj.InputError, match="irradiancemeter"):
        scene.with_sensor("meter")


def test_a_file_parameter_named_like_an_argument_is_set_by_the_mapping(write_scene):
    scene = pj.load_scene(write_scene(MESH), parameters={"dtype": "0.5, 0.25, 0.125"})
    np.testing.assert_array_equal(pj.parameters(scene)["wall.reflectance"], [0.5, 0.25, 0.125])
    assert scene.camera.origin.dtype == np.float32


def test_a_parameter_that_is_given_twice_is_refused(root):
    with pytest.raises(pj.InputError, match="res is given twice"):
        pj.load_scene(root / "scenes" / "furnace.xml", parameters={"res": 8}, res=9)
