"""Bsdfs that hold bsdfs: chances and frames of leaves, light that passes, closed forms of images, refusals."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.bsdfs import BlendBSDF, BumpMap, Conductor, Diffuse, Mask, NormalMap, TwoSided
from pathjax.core.math import to_world
from pathjax.core.types import Frame, Surface
from pathjax.errors import InputError
from pathjax.integrators import vertex
from pathjax.kinds import Parameters

# Chance that a correct tree fails one of the statistical tests here; seeds are fixed.
FALSE_ALARM = 1e-4
COUNT = 1 << 14
RED, GREEN, MIRROR = Diffuse.instance("red"), Diffuse.instance("green"), Conductor.instance("mirror")
X, Y, Z = np.eye(3, dtype=np.float32)
SURFACE = Surface(jnp.zeros(3), jnp.asarray(Z), jnp.zeros(()), jnp.asarray(Z), jnp.full(2, 0.3), jnp.asarray(X))


def blend(weight, *held):
    return BlendBSDF.holding("blend", *held, weight=weight)


def mask(opacity, held):
    return Mask.holding("mask", held, opacity=opacity)


def normals(n, held, **values):
    return NormalMap.holding("normals", held, normalmap=np.array(n) / 2 + 0.5, **values)


def built(instance):
    return jax.device_put(bsdfs.build([instance], np.float32, (), Parameters()))


def walked(materials, wi, differentiated=False):
    """Return the leaves for evenly spaced uniform numbers."""
    u = (jnp.arange(COUNT) + 0.5) / COUNT
    frame = Frame(*map(jnp.asarray, (X, Y, Z)))
    walk = jax.vmap(lambda u: bsdfs.leaf(materials, jnp.int32(0), SURFACE, frame, jnp.asarray(wi), u, differentiated))
    return jax.jit(walk)(u)


def shares(instance, wi=Z):
    """Return {"kind row" of each leaf: share of evenly spaced uniform numbers that reach it}."""
    materials = built(instance)
    leaves = walked(materials, wi)
    found = {}
    for kind, row in set(zip(*(np.asarray(x).tolist() for x in leaves[:2]), strict=True)):
        here = (leaves.kind == kind) & (leaves.row == row)
        name = "nothing" if kind < 0 else f"{bsdfs.name(materials, kind)} {row}"
        found[name] = pytest.approx(float(here.mean()), abs=2 / COUNT)
    return found


def test_one_number_walks_to_a_leaf_as_often_as_its_share():
    tree_of_three = blend(0.25, RED, mask(0.5, blend(0.9, GREEN, MIRROR)))
    assert shares(tree_of_three) == {
        "diffuse 0": 0.75,
        "null 0": 0.125,
        "diffuse 1": 0.0125,
        "conductor 0": 0.1125,
    }
    assert shares(blend(0, RED, MIRROR)) == {"diffuse 0": 1.0}
    assert shares(blend(1, RED, MIRROR)) == {"conductor 0": 1.0}
    assert shares(mask(0, RED)) == {"null 0": 1.0}


@pytest.mark.parametrize(
    "instance, back",
    [
        (mask(0.5, RED), {"null 0": 0.5, "nothing": 0.5}),
        (mask(0.5, TwoSided.of("t", RED, MIRROR)), {"null 0": 0.5, "conductor 0": 0.5}),
        (TwoSided.of("t", RED, blend(0.25, GREEN, MIRROR)), {"diffuse 1": 0.75, "conductor 0": 0.25}),
        # The back of the outer one sees the front of the inner one.
        (blend(1, RED, TwoSided.of("t", RED, TwoSided.of("u", MIRROR, GREEN))), {"conductor 0": 1.0}),
        (blend(0.5, RED, TwoSided.of("t", RED, RED)), {"diffuse 0": 0.5, "nothing": 0.5}),
        (normals(Z, TwoSided.of("t", RED, MIRROR)), {"conductor 0": 1.0}),
    ],
)
def test_each_of_what_a_tree_holds_has_its_own_sides(instance, back):
    assert shares(instance, -Z) == back


def test_what_lies_on_a_back_sees_light_as_on_a_front():
    """The frame is mirrored, and so left-handed, as in Mitsuba."""
    slanted = normals([0.6, 0, 0.8], RED)
    wi = np.float32([0.36, 0.48, -0.8])
    leaf = walked(built(TwoSided.of("t", slanted, slanted)), wi)
    np.testing.assert_allclose(leaf.frame.n[0], [0.6, 0, -0.8], atol=1e-6)
    np.testing.assert_allclose(leaf.wi[0, 2], leaf.frame.n[0] @ wi, rtol=1e-5)
    np.testing.assert_allclose(to_world(jax.tree.map(lambda x: x[0], leaf.frame), leaf.wi[0]), wi, atol=1e-6)


@pytest.mark.parametrize("flips", [True, False])
def test_a_normal_that_points_below_is_turned_the_other_way_or_shows_its_back(flips):
    below = normals([0.6, 0, -0.8], RED, flip_invalid_normals=flips)
    leaf = walked(built(below), np.float32([-0.6, 0, 0.8]))
    if flips:  # tilted the other way, as in Mitsuba; it still points below
        np.testing.assert_allclose(leaf.frame.n[0], [-0.6, 0, -0.8], atol=1e-6)
    assert int(leaf.kind[0]) == -1


def test_heights_turn_the_normal_as_they_slope():
    """Per unit of u and v the surface extends by 2 and 3, and heights grow by 1 and -0.5."""

    class Slope(pj.textures.Texture):
        @staticmethod
        def look_up(p, uv, surface):
            return jnp.full(3, uv[0] - 0.5 * uv[1])

    bumps = BumpMap.holding("bumps", RED, heights=Slope.instance("slope"), scale=2.0)
    surface = SURFACE._replace(along=(2 * X, 3 * Y))
    materials = built(bumps)
    frame = Frame(*map(jnp.asarray, (X, Y, Z)))
    leaf = bsdfs.leaf(materials, jnp.int32(0), surface, frame, jnp.asarray(Z), jnp.float32(0.5))
    expected = np.array([-1, 1 / 3, 1])
    np.testing.assert_allclose(leaf.frame.n, expected / np.linalg.norm(expected), rtol=1e-6)


def test_shares_that_pass_are_those_of_walks():
    instance = mask(0.7, blend(0.25, TwoSided.of("t", RED, RED), mask(0.4, RED)))
    materials = built(instance)
    for wi in (Z, -Z):
        leaves = walked(materials, wi)
        passed = np.asarray(bsdfs.has(materials, jnp.int32(0), "smooth"))  # diffuse comes first
        assert passed
        through = jax.jit(bsdfs.passing)(materials, jnp.int32(0), SURFACE, jnp.bool_(wi[2] > 0))
        assert float(through) == pytest.approx(0.3 + 0.7 * 0.25 * 0.6, abs=1e-6)
        assert float((leaves.kind == 1).mean()) == pytest.approx(float(through), abs=2 / COUNT)


def test_directions_of_a_mixture_follow_its_density():
    """Chi-square for a blend of a diffuse bsdf and a turned one."""
    materials, wi = built(blend(0.4, RED, normals([0.5, 0.3, 0.8], GREEN))), np.float32([0.48, 0.36, 0.8])
    rng = np.random.default_rng(0)
    u, u_leaf = (jnp.asarray(rng.random(shape), jnp.float32) for shape in ((100_000, 2), (100_000,)))
    frame = Frame(*map(jnp.asarray, (X, Y, Z)))

    def here(u_leaf):
        found = bsdfs.leaf(materials, jnp.int32(0), SURFACE, frame, jnp.asarray(wi), u_leaf)
        return vertex.Vertex(None, SURFACE, found.frame, found.wi, found.kind, found.row, found.weight, found.turns)

    class scene:
        pass

    scene.materials = materials

    def draw(u, u_leaf):
        drawn, d = vertex.sample(scene, here(u_leaf), u)
        return d, drawn.pdf

    d, pdf = jax.jit(jax.vmap(draw))(u, u_leaf)
    middles, share = testing._midpoints()
    density = jax.jit(jax.vmap(lambda d: [vertex.evaluate(scene, here(jnp.float32(u)), d)[1] for u in (0.1, 0.9)]))
    turned, plain = (np.asarray(x, float) * share for x in density(middles))
    mixture = 0.4 * turned + 0.6 * plain
    testing._chi_square(np.asarray(d)[np.asarray(pdf) > 0], len(u), mixture, FALSE_ALARM, "a mixture")


# ---- images ---------------------------------------------------------------------------------------------------------

GREY = '<bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.6, 0.3, 0"/></bsdf>'
SKY = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
PLATE = '<shape type="rectangle">{}</shape>'
HALF = f'<bsdf type="mask" id="leaf">{GREY}</bsdf>'


def test_a_masked_plate_under_the_sky(make_scene):
    """opacity * reflectance + 1 - opacity; the derivative in the opacity is correct at its bounds too."""
    scene = make_scene(PLATE.format(HALF) + SKY, res=8, fov=1)
    rho = np.array([0.6, 0.3, 0])
    for opacity in (0, 0.5, 1):
        image, J = pj.jacobian(pj.with_parameters(scene, {"leaf.opacity": opacity}), ["leaf.opacity"], spp=256)
        assert np.asarray(image).mean((0, 1)) == pytest.approx(opacity * rho + 1 - opacity, abs=0.02)
        assert np.asarray(J["leaf.opacity"]).mean((0, 1)) == pytest.approx(rho - 1, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("integrator, lit", [("path", 3), ("volpath", 2)])
def test_light_that_no_ray_meets_comes_through_masks(load_text, integrator, lit):
    """Light from the side reaches a floor through a screen that the camera does not see."""
    screen = (
        '<shape type="rectangle"><transform name="to_world"><scale value="30"/><rotate y="1" angle="-90"/>'
        '<translate x="5"/></transform><bsdf type="mask" id="screen"><float name="opacity" value="0.25"/>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></bsdf></shape>'
    )
    sun = '<emitter type="directional"><vector name="direction" value="-1, 0, -1"/></emitter>'
    scene = load_text(PLATE.format(GREY) + screen + sun, integrator, fov=1)
    direct = np.array([0.6, 0.3, 0]) * 0.75 * np.sqrt(0.5) / np.pi
    for depth in (2, 3):
        image = np.asarray(pj.render_bounces(scene, depth, spp=4).terms)
        assert image.sum(0).mean((0, 1)) == pytest.approx(direct * (depth >= lit), abs=1e-6)
        assert image[depth - 1].any() == (depth == lit)


# Bsdf around a pane -> share of light that the pane may transmit, share that passes beside the pane.
PANES = {
    "{}": (1, 0),
    '<bsdf type="mask"><float name="opacity" value="0.25"/>{}</bsdf>': (0.25, 0.75),
    '<bsdf type="blendbsdf"><float name="weight" value="0.4"/>{}<bsdf type="null"/></bsdf>': (0.6, 0.4),
    '<bsdf type="bumpmap"><texture type="checkerboard"/>{}</bsdf>': (0, 0),
}


@pytest.mark.parametrize("integrator", [pytest.param("path", marks=pytest.mark.slow), "volpath"])
@pytest.mark.parametrize("around", PANES)
def test_light_that_no_ray_meets_comes_through_panes_where_they_are_no_bounce(load_text, around, integrator):
    """They transmit 2 n / (n^2 + 1), the share at normal incidence, as in Mitsuba; the camera sees only the floor."""
    glass = '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'
    pane = around.format(f'<bsdf type="thindielectric" id="pane">{glass}</bsdf>')
    place = '<transform name="to_world"><rotate y="1" angle="45"/><translate x="5" z="5"/></transform>'
    sun = '<emitter type="directional"><vector name="direction" value="-1, 0, -1"/></emitter>'
    scene = load_text(PLATE.format(GREY) + PLATE.format(place + pane) + sun, integrator, fov=1)
    image, J = pj.jacobian(scene, ["pane.int_ior"], spp=4)
    n, direct = 1.5, np.array([0.6, 0.3, 0]) * np.sqrt(0.5) / np.pi
    of_pane, of_rest = PANES[around]
    of_pane = of_pane if integrator == "volpath" else 0
    share, slope = 2 * n / (n**2 + 1), 2 * (1 - n**2) / (n**2 + 1) ** 2
    for pixels, expected in ((image, of_pane * share + of_rest), (J["pane.int_ior"], of_pane * slope)):
        np.testing.assert_allclose(pixels, np.broadcast_to(expected * direct, pixels.shape), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("integrator, told", [("path", False), ("volpath", True)])
def test_info_tells_of_a_pane_that_shadows_what_it_would_let_pass(load_text, integrator, told):
    pane = '<bsdf type="thindielectric"><rgb name="specular_transmittance" value="0.9"/></bsdf>'
    notes = load_text(PLATE.format(pane) + SKY, integrator).about.description.notes
    assert any("specular_transmittance" in note and "light samples pass it" in note for note in notes) == told


@pytest.mark.parametrize("kind, share", [("polarizer", 0.5), ("circular", 0.5), ("retarder", 1)])
def test_sheets_that_polarise_let_a_share_through_and_absorb_the_rest(make_scene, kind, share):
    """In front of the sky, within 5 standard errors; derivatives within 3 %."""
    sheet = f'<bsdf type="{kind}" id="it"><float name="transmittance" value="0.8"/></bsdf>'
    scene = make_scene(PLATE.format(sheet) + SKY, res=8, fov=1)
    image, J = pj.jacobian(scene, ["it.transmittance"], spp=1024)
    p = 0.8 * share
    assert np.asarray(image).mean() == pytest.approx(p, abs=5 * np.sqrt(p * (1 - p) / (64 * 1024)))
    assert np.asarray(J["it.transmittance"]).mean() == pytest.approx(share, rel=0.03)


def test_a_sheet_of_a_colour_is_refused_and_one_of_grey_is_not(make_scene):
    inside = '<rgb name="transmittance" value="{}"/><spectrum name="theta" value="9"/>'
    sheet = f'<bsdf type="polarizer" id="it">{inside}</bsdf>'
    scene = make_scene(PLATE.format(sheet.format("0.4, 0.4, 0.4")) + SKY)
    assert pj.parameters(scene)["it.transmittance"] == pytest.approx(0.4)
    assert any("theta has no effect: light has no polarisation" in note for note in scene.about.description.notes)
    with pytest.raises(InputError, match="transmittance.*has a colour; only a number, or a grey"):
        make_scene(PLATE.format(sheet.format("0.4, 0.5, 0.4")) + SKY)


@pytest.mark.slow
def test_a_furnace_of_masks_stays_white(make_scene):
    white = '<bsdf type="diffuse"><rgb name="reflectance" value="1"/></bsdf>'
    leaf = f'<bsdf type="mask"><float name="opacity" value="0.4"/><bsdf type="twosided">{white}</bsdf></bsdf>'
    ball = '<shape type="sphere"><float name="radius" value="{}"/>{}</shape>'
    scene = make_scene(ball.format(1, leaf) + ball.format(0.5, leaf) + SKY, depth=-1, rr_depth=1000, res=8)
    np.testing.assert_allclose(pj.render(scene, spp=16), 1, rtol=1e-5)


@pytest.fixture(scope="module")
def screened(make_scene):
    """A blend behind a mask of opacity 1/2, under a lamp behind a screen of opacity 1/4."""
    half = '<float name="weight" value="0.4"/><bsdf type="diffuse"/>'
    metal = '<bsdf type="roughconductor"><float name="alpha" value="0.4"/></bsdf>'
    floor = f'<bsdf type="blendbsdf" id="floor">{half}{metal}</bsdf>'
    leaf = f'<transform name="to_world"><scale value="0.5"/><translate z="1"/></transform>{HALF}'
    screen = (
        '<transform name="to_world"><scale value="2"/><translate z="2"/></transform><bsdf type="mask" id="screen">'
        '<float name="opacity" value="0.25"/><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf>'
    )
    lamp = (
        '<transform name="to_world"><rotate y="1" angle="180"/><translate z="3"/></transform>'
        '<emitter type="area"><rgb name="radiance" value="2"/></emitter>'
    )
    return make_scene("".join(map(PLATE.format, (floor, leaf, screen, lamp))), origin="3, 0, 1.3", res=16, depth=6)


@pytest.mark.slow
def test_light_samples_and_bsdf_samples_find_the_same_behind_masks(screened, estimate, agree):
    both, light, bsdf = (estimate(screened, spp=256, strategy=each) for each in ("mis", "light", "bsdf"))
    agree(both, light, rounding=1e-3)
    agree(both, bsdf, rounding=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["floor.weight", "leaf.opacity", "screen.opacity"])
def test_derivatives_in_shares_are_those_of_differences(screened, name):
    assert pj.check_gradient(screened, name, spp=64).passed


@pytest.fixture
def load_text(write_scene):
    """(body, integrator, **camera) -> Scene."""

    def load(body, integrator, **camera):
        path = write_scene(body, **camera)
        path.write_text(path.read_text().replace('<integrator type="path">', f'<integrator type="{integrator}">'))
        return pj.load_scene(path)

    return load


# ---- parameters -----------------------------------------------------------------------------------------------------


def test_weights_and_opacities_are_parameters_and_what_turns_frames_is_not(make_scene):
    bumps = f'<bsdf type="bumpmap" id="bumps"><texture type="checkerboard" id="board"/>{GREY}</bsdf>'
    half = '<float name="weight" value="0.5"/>'
    mixed = f'<bsdf type="blendbsdf" id="mixed">{half}{bumps}<bsdf type="conductor"/></bsdf>'
    scene = make_scene(PLATE.format(f'<bsdf type="mask" id="leaf">{mixed}</bsdf>') + SKY)
    names = {"leaf.opacity", "mixed.weight", "grey.reflectance", "mixed_1.specular_reflectance", "background.radiance"}
    assert set(pj.parameters(scene)) == names
    for name in ("bumps.scale", "board.color0"):
        with pytest.raises(InputError, match=f"{name} turns shading frames"):
            pj.with_parameters(scene, {name: 0.5})
    with pytest.raises(InputError, match="lies outside its bounds"):
        pj.with_parameters(scene, {"mixed.weight": 1.5})
