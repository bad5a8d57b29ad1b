"""Padding to the ladder: scenes that differ in counts share kernels, and padded entries are never used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import emitters
from pathjax.compile import SELECTED_ROWS
from pathjax.emitters.selection import choose, probability
from pathjax.media.gridvolume import write_vol
from pathjax.scene.ladder import padded
from pathjax.scene.parameters import nameless


def point(x, y):
    return f"""<emitter type="point"><point name="position" x="{x}" y="{y}" z="1"/>
        <rgb name="intensity" value="{1 + x}"/></emitter>"""


def lamp(x):
    """Return a mesh that emits as a whole."""
    return f"""<shape type="obj"><string name="filename" value="meshes/octahedron.obj"/>
        <transform name="to_world"><scale value="0.2"/><translate x="{x}" y="1" z="0"/></transform>
        <emitter type="area"><rgb name="radiance" value="{1 + x}"/></emitter></shape>"""


SUN = '<emitter type="directional"><vector name="direction" x="0" y="-1" z="0"/></emitter>'


@pytest.fixture
def lit(make_scene):
    """(points, lamps, suns) -> a scene with that many lights."""

    def lit(points, lamps=0, suns=0):
        body = "".join(point(i % 5, i // 5) for i in range(points)) + "".join(lamp(i / 3) for i in range(lamps))
        return make_scene('<shape type="sphere"/>' + body + SUN * suns)

    return lit


def key(scene):
    scene = nameless(scene)
    return jax.tree.structure(scene), [(x.shape, x.dtype) for x in jax.tree.leaves(scene)]


@pytest.mark.parametrize(("one", "other"), [((5, 2, 3), (6, 2, 4)), ((20, 9), (30, 16))])
def test_scenes_that_differ_in_their_numbers_of_lights_share_kernels(lit, one, other):
    a, b = lit(*one), lit(*other)
    assert key(a) != key(b) and key(padded(a)) == key(padded(b))


def test_fogs_that_differ_in_their_cells_share_kernels_and_keep_their_depths(make_scene, tmp_path):
    """One of each filter, side by side."""

    def fog(*size):
        write_vol(tmp_path / "fog.vol", np.random.default_rng(0).random((*size, 1)))
        cubes = (
            f"""<shape type="cube"><transform name="to_world"><translate x="{x}"/></transform><bsdf type="null"/>
            <medium name="interior" type="heterogeneous"><volume name="sigma_t" type="gridvolume">
            <string name="filename" value="{tmp_path}/fog.vol"/><string name="filter_type" value="{filter_type}"/>
            <transform name="to_world"><scale value="2"/><translate x="{x - 1}" y="-1" z="-1"/></transform></volume>
            <rgb name="albedo" value="0"/></medium></shape>"""
            for x, filter_type in ((-1.1, "trilinear"), (1.1, "nearest"))
        )
        return make_scene("".join(cubes) + '<emitter type="constant"/>', res=4, integrator="volpath", fov=60)

    a, b = fog(3, 4, 5), fog(6, 2, 3)
    assert key(a) != key(b) and key(padded(a)) == key(padded(b))
    dark = np.asarray(pj.render(a, spp=1))
    np.testing.assert_allclose(pj.render(padded(a), spp=1), dark, rtol=1e-6)
    assert dark[:, :2].min() < 0.9 and dark[:, 2:].min() < 0.9


@pytest.mark.parametrize("counts", [pytest.param((3, 2, 2), marks=pytest.mark.slow), (11, 10, 3)])
def test_lights_are_chosen_as_without_padding(lit, counts):
    """Each random number, also the least and the largest, chooses the same light with the same probability."""
    scene = lit(*counts)
    # Between the ends, no number is on a border between two lights, where rounding decides.
    u = jnp.concatenate([jnp.arange(1, 100) * 0.6180339887 % 1, jnp.array([0, 2**-24, 1 - 2**-24])])
    refs = jnp.array([[0.0, 0, 3], [4, 2, 1], [-2, 1, 0]])

    @jax.jit
    def found(scene):
        made = emitters.choice(scene.emitters, "mis")
        number, pdf, _ = jax.vmap(lambda ref: jax.vmap(lambda u: choose(made, ref, jnp.stack([u, u])))(u))(refs)
        near = sum(lights.count for lights in scene.emitters if not lights.kind.distant)
        known = jax.vmap(lambda ref: jax.vmap(lambda n: probability(made, ref, n))(jnp.arange(near)))(refs)
        return number, pdf, known

    def chosen(scene):
        return map(np.asarray, found(nameless(scene)))

    (number, pdf, known), (number_padded, pdf_padded, known_padded) = map(chosen, (scene, padded(scene)))
    # Index of each light with padding: added lights come before those of their kind.
    lights, more = scene.emitters, padded(scene).emitters
    ends = np.cumsum([each.count for each in more])
    moved = np.concatenate([np.arange(end - each.count, end) for each, end in zip(lights, ends, strict=True)])
    np.testing.assert_array_equal(number_padded, moved[number])
    np.testing.assert_allclose(pdf_padded, pdf, rtol=1e-6)
    near = moved[: known.shape[1]]
    np.testing.assert_allclose(known_padded[:, near], known, rtol=1e-6)
    # Where one child of a node is empty, the other's share is 1 up to rounding.
    assert np.delete(known_padded, near, 1).max() <= np.finfo(np.float32).eps


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(3, 2, 2), (11, 10, 3)])
def test_images_are_those_without_padding(lit, counts):
    scene = lit(*counts)
    image = np.asarray(pj.render(scene, 16, seed=1))
    np.testing.assert_allclose(pj.render(padded(scene), 16, seed=1), image, rtol=1e-4, atol=1e-5 * image.max())


@pytest.mark.parametrize(("count", "rows"), [(1, 1), (2, 2), (3, 4), (5, 8), (SELECTED_ROWS, SELECTED_ROWS)])
def test_tables_from_which_lanes_select_grow_little(make_scene, count, rows):
    """Gathering from a padded table cost a seventh of a render, and selecting from 8 rows instead of 2 an eighth."""
    scene = make_scene("".join(f'<shape type="sphere"><bsdf type="diffuse" id="b{k}"/></shape>' for k in range(count)))
    assert [len(leaf) for leaf in jax.tree.leaves(padded(scene).materials.tables)] == [rows]


def test_few_lights_stay_few(lit):
    assert [lights.count for lights in padded(lit(2, 1)).emitters] == [1, 2]
