"""Hard cases that float32 renders must survive."""

import itertools
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import pathjax as pj
from pathjax import emitters
from pathjax.compile import native_map
from pathjax.integrators import path
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import Bounce
from pathjax.rendering.render import render_pixels

NO_LIMIT = 1 << 30
UNIFORM = '<emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>'
GREY = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
RHO = np.array([0.2, 0.5, 0.8])
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'


def glass(int_ior=1.5, ext_ior=1.0, name="glass"):
    ior = f'<float name="int_ior" value="{int_ior}"/><float name="ext_ior" value="{ext_ior}"/>'
    return f'<bsdf type="dielectric" id="{name}">{ior}</bsdf>'


def lamp(radiance=1):
    return f'{BLACK}<emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter>'


def shape(kind, transform="", inside=""):
    return f'<shape type="{kind}"><transform name="to_world">{transform}</transform>{inside}</shape>'


def without_roulette(scene, max_depth=NO_LIMIT):
    return replace(scene, max_depth=jnp.int32(max_depth), rr_depth=jnp.int32(NO_LIMIT))


def reflectance_of_glass(cos_i, eta):
    """Fresnel's equations in textbook form, in float64; 1 under total internal reflection."""
    cos_i = np.asarray(cos_i, float)
    sin2_t = (1 - cos_i**2) / eta**2
    cos_t = np.sqrt(np.maximum(1 - sin2_t, 0))
    s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return np.where(sin2_t >= 1, 1, (s**2 + p**2) / 2)


# ---- size and place -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still_life(make_scene):
    """(scale, shift) -> a ball, a mesh with a tree and a cube on a floor under a lamp, all scaled and then moved."""

    def make(scale, shift=0.0):
        place = f'<scale value="{scale!r}"/><translate x="{shift!r}" y="{-shift!r}" z="{shift!r}"/>'

        def at(x, y, z):
            return ", ".join(repr(scale * c + sign * shift) for c, sign in ((x, 1), (y, -1), (z, 1)))

        ball = '<string name="filename" value="meshes/ball.ply"/>'
        return make_scene(
            shape("rectangle", f'<scale value="3"/><rotate x="1" angle="-90"/>{place}', GREY)
            + shape("sphere", f'<scale value="0.5"/><translate x="-0.8" y="0.5"/>{place}', GREY)
            + shape("ply", f'<scale value="0.5"/><translate x="0.9" y="0.6"/>{place}', ball + GREY)
            + shape("cube", f'<scale value="0.3"/><rotate y="1" angle="30"/><translate y="0.3" z="1"/>{place}', GREY)
            + shape("rectangle", f'<rotate x="1" angle="90"/><translate y="3"/>{place}', lamp("3, 4, 5"))
            + '<emitter type="constant"><rgb name="radiance" value="0.2, 0.2, 0.3"/></emitter>',
            origin=at(0.5, 2, 4),
            target=at(0, 0.4, 0),
            near=0.01 * scale,
            far=100 * scale,
        )

    return make


@pytest.fixture(scope="module")
def still_life_image(still_life, estimate):
    return estimate(still_life(1.0), spp=32)


@pytest.mark.parametrize("power", [-10, 17])
def test_scaled_by_a_power_of_2_the_image_is_the_same_to_the_bit(still_life, power):
    """Such a scale causes no rounding, so any difference comes from an absolute length in the code."""
    np.testing.assert_array_equal(pj.render(still_life(2.0**power), 8), pj.render(still_life(1.0), 8))


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_scaled_by_any_number_the_image_is_the_same(still_life, still_life_image, estimate, agree, scale):
    agree(estimate(still_life(scale), spp=32, first_seed=101), still_life_image, rounding=1e-3)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_moved_by_1e4_of_its_size_the_image_is_the_same(still_life, still_life_image, estimate, agree, scale):
    """Up to the coordinates' ulp, 1e-3 of the scene's size: 1 % of a pixel at silhouettes, more in contact shadows."""
    moved = estimate(still_life(scale, shift=1e4 * scale), spp=32, first_seed=101)
    agree(moved, still_life_image, rounding=0.03)


def test_walls_of_radius_1e5_stand_where_float64_has_them(shipped, x64):
    """Distances of 40 to 200 to walls whose coordinates are about 1e5, with an ulp of 0.008."""
    rng = np.random.default_rng(0)
    origins = rng.uniform([5, 5, 5], [95, 75, 160], (4096, 3))
    directions = rng.normal(size=(4096, 3))
    single = pj.closest_hit(shipped("nine_spheres", res=16), origins, directions)
    with x64():
        double = pj.closest_hit(shipped("nine_spheres", jnp.float64, res=16), origins, directions)
        t, which = np.asarray(double.t), np.asarray(double.primitive)
    same = np.asarray(single.primitive) == which
    assert same.mean() > 0.998
    # At 3 degrees to a wall, an error of 0.008 across the wall becomes 0.15 along the ray.
    error = np.abs(single.t - t)[same]
    assert np.quantile(error, 0.9) < 0.02
    assert error.max() < 1


def test_walls_of_radius_1e5_show_no_speckles(shipped, x64):
    """float32 and float64 renders follow the same paths, so their difference is nearly free of noise."""

    def images(dtype):
        scene = shipped("nine_spheres", dtype, res=16)
        return np.stack([np.asarray(pj.render(scene, 64, seed), float) for seed in range(8)])

    single = images(jnp.float32)
    with x64():
        double = images(jnp.float64)
    difference, reference = (single - double).mean(0), double.mean(0)
    np.testing.assert_allclose(single.mean((0, 1, 2)), double.mean((0, 1, 2)), rtol=0.01)
    spread = (single - double).std(0, ddof=1) / np.sqrt(8)
    # 768 values with 7 degrees of freedom: by chance one exceeds 12 standard errors once in 200 runs.
    assert (np.abs(difference) < 12 * spread + 0.02 * reference + 1e-4).all()


# ---- glass ----------------------------------------------------------------------------------------------------------

TILTED = '<rotate x="0.8" y="0.6" angle="37"/>'
# Out of sight; no two share a place, since coincident surfaces give the scene another structure.
AWAY = [f'<scale value="1e-3"/><translate x="{place}" y="1e4"/>' for place in range(5)]


@pytest.fixture(scope="module")
def glassware(make_scene):
    """A ball, a ball inside it, a slab and a plane of glass, a square lamp and a sky: one structure, so one kernel.

    Each shape is placed by its transform, or out of sight; lights are dark by default.
    """

    def make(ball=AWAY[0], core=AWAY[1], slab=AWAY[2], plane=AWAY[3], square=AWAY[4], sky=0, radiance=0, **camera):
        ref = '<ref id="glass"/>'
        return make_scene(
            glass()
            + shape("sphere", ball, ref)
            + shape("sphere", core, glass(2.0, 1.5, "core"))
            + shape("cube", slab, ref)
            + shape("rectangle", plane, ref)
            + shape("rectangle", square, lamp(radiance))
            + f'<emitter type="constant"><rgb name="radiance" value="{sky}"/></emitter>',
            **camera,
        )

    return make


SPLIT = {"fresnel": "schlick", "split_depth": 4}


@pytest.mark.parametrize(
    "body, how", [("ball", {}), ("slab", {}), pytest.param("ball", SPLIT, marks=pytest.mark.slow)]
)
def test_glass_in_uniform_light_is_invisible(glassware, body, how):
    scene = without_roulette(glassware(**{body: ""}, sky=1, origin="1.2, 1.5, 4"))
    # About 10 refractions by reciprocal factors, each off by an ulp or two.
    np.testing.assert_allclose(pj.render(scene, 16, **how), 1, rtol=1e-5)


def test_glass_under_roulette_stays_as_bright(glassware, estimate, agree):
    scene = glassware(ball="", sky=1, origin="1.2, 1.5, 4")
    agree(estimate(replace(scene, max_depth=jnp.int32(NO_LIMIT), rr_depth=jnp.int32(1))), 1)


@pytest.mark.parametrize("tilt", ["", TILTED])
@pytest.mark.parametrize("thickness", [0.1, 1e-4, 1e-7])
def test_slab_of_glass_has_both_its_faces(glassware, estimate, agree, thickness, tilt):
    """Light bounces between the faces: T = (1 - R) / (1 + R), which is 2 eta / (eta^2 + 1) at normal incidence."""
    slab, far = f'<scale x="1" y="1" z="{thickness / 2}"/>{tilt}', '<scale value="5"/><translate z="-6"/>'
    scene = without_roulette(glassware(slab=slab, square=far, radiance=1, fov=0.2))
    normal = scene.about.description.shapes[2].geometry.to_world[:3, 2]
    r = reflectance_of_glass(abs(normal[2]) / np.linalg.norm(normal), 1.5)
    agree(estimate(scene, spp=64), (1 - r) / (1 + r), pixelwise=False, rounding=1e-3)


def test_thin_slab_reflects_what_it_does_not_transmit(glassware, estimate, agree):
    behind_camera = '<scale value="5"/><rotate y="1" angle="180"/><translate z="6"/>'
    slab = '<scale x="1" y="1" z="5e-8"/>'
    scene = without_roulette(glassware(slab=slab, square=behind_camera, radiance=1, fov=0.2))
    agree(estimate(scene, spp=64), (1.5 - 1) ** 2 / (1.5**2 + 1), pixelwise=False, rounding=1e-3)


@pytest.fixture(scope="module")
def water_level(glassware):
    """A plane of glass with its normal up, in uniform light above and below."""
    return partial(glassware, plane='<scale value="1e4"/><rotate x="1" angle="-90"/>', sky=1)


def cosines_in_pixels(scene, samples=64):
    """Return the cosines (H, W, K) to the y axis of rays through a grid of points in each pixel."""
    side = int(samples**0.5)
    height, width = scene.film.height, scene.film.width
    grid = (np.arange(side) + 0.5) / side
    y, x, v, u = np.meshgrid(np.arange(height), np.arange(width), grid, grid, indexing="ij")
    position = np.stack([(x + u) / width, (y + v) / height], -1)
    xy = np.asarray(scene.camera.corner, float) + position * np.asarray(scene.camera.extent, float)
    d = np.concatenate([xy, np.ones_like(xy[..., :1])], -1) @ np.asarray(scene.camera.axes, float)
    return np.abs(d[..., 1] / np.linalg.norm(d, axis=-1)).reshape(height, width, -1)


def test_total_reflection_around_the_critical_angle(water_level, estimate, agree):
    """Snell's window seen from below the surface, with radiance 1 on both sides: L = R + eta^2 (1 - R)."""
    scene = water_level(origin="0, -1, 0", target="1, -0.1, 0", fov=60)
    cos, critical = cosines_in_pixels(scene), np.sqrt(1 - 1 / 1.5**2)
    expected = 1 + (1 - reflectance_of_glass(cos, 1 / 1.5)) * (1.5**2 - 1)
    agree(estimate(scene, spp=64), expected.mean(-1, keepdims=True), rounding=3e-3)  # the grid's own error
    window, beyond = cos.min(-1) > critical, cos.max(-1) < critical
    assert window.any() and beyond.any()
    np.testing.assert_allclose(np.asarray(pj.render(scene, 16))[beyond], 1, rtol=1e-6)


def test_grazing_incidence_on_glass(water_level, estimate, agree):
    """From 10 degrees down to 1e-4 degrees above the horizon: R goes to 1."""
    scene = water_level(origin="0, 1e-2, 0", target="1, 0.0099, 0", fov=1)
    r = reflectance_of_glass(cosines_in_pixels(scene), 1.5)
    below_horizon = np.arange(16) >= 8
    image = estimate(scene, spp=64)
    expected = np.where(below_horizon[:, None, None], (1 - (1 - r) * (1 - 1.5**-2)).mean(-1, keepdims=True), 1)
    agree(image, expected, rounding=3e-3)


@pytest.mark.parametrize("d_y", [-1e-3, -1e-6, -1e-9])
def test_rays_that_graze_glass_stay_finite(water_level, d_y):
    scene = without_roulette(water_level(), 8)
    camera = replace(scene.camera, origin=jnp.asarray([0, -d_y, 0], jnp.float32))
    camera = replace(camera, axes=jnp.asarray([[0, 0, 1], [0, 1, 0], [1, d_y, 0]], jnp.float32))
    camera = replace(camera, corner=camera.corner * 0, extent=camera.extent * 0, near=camera.near * 0)
    image = np.asarray(pj.render(replace(scene, camera=camera), 16))
    assert np.isfinite(image).all()
    assert abs(image - 1).max() <= 1 - 1.5**-2 + 1e-6


def test_ior_of_1_is_invisible(glassware):
    """A ball of air before a bright square: the same image, except at the square's edges, which rounding may move."""
    square = '<rotate z="1" angle="20"/><translate z="-2"/>'
    scene, out_of_view = (glassware(ball=ball, square=square, radiance=1) for ball in ("", '<translate x="100"/>'))
    air = without_roulette(pj.with_parameters(scene, {"glass.int_ior": 1.0}))
    image, plain = pj.render(air, 16), pj.render(out_of_view, 16)
    assert np.isclose(image, plain, atol=1e-5).mean() > 0.99
    assert not np.isclose(pj.render(scene, 16), plain, atol=1e-5).all()  # with an IOR of 1.5 it is visible


def test_camera_inside_glass_sees_eta_squared(glassware):
    scene = without_roulette(glassware(ball="", sky=1, origin="0, 0, 0", target="1, 2, 3"))
    np.testing.assert_allclose(pj.render(scene, 16), 1.5**2, rtol=1e-5)


def test_light_caught_in_glass_is_dark_and_its_paths_end(glassware):
    """Near the wall of a glass ball, rays along the wall are totally reflected for ever."""
    scene = glassware(ball="", sky=1, origin="0, 0, 0.95", target="1, 0, 0.95", fov=10)
    assert not np.asarray(pj.render(without_roulette(scene, 1000), 4)).any()
    assert not np.asarray(pj.render(replace(scene, max_depth=jnp.int32(NO_LIMIT)), 4)).any()


@pytest.mark.parametrize("origin, expected", [("0, 0, 0.01", 4.0), ("0, 0, 0.75", 1.5**2), ("0, 0, 4", 1.0)])
def test_glass_in_glass_scales_radiance_both_ways(glassware, origin, expected):
    """eta = 2 in 1.5 in 1. The views avoid rays caught by total reflection, which would be dark."""
    scene = glassware(ball="", core='<scale value="0.5"/>', sky=1, origin=origin, fov=10)
    image = np.asarray(pj.render(without_roulette(scene, 10_000), 16))
    np.testing.assert_allclose(image, expected, rtol=3e-5)  # about 20 interfaces


# ---- reflectance and light at their limits --------------------------------------------------------------------------


def test_reflectance_0_leaves_emission(shipped):
    scene = pj.with_parameters(shipped("furnace", res=16), {"wall.reflectance": 0.0})
    np.testing.assert_array_equal(pj.render(scene, 4), 1)


def test_reflectance_1_counts_every_bounce_and_ends_at_max_depth(shipped):
    scene = pj.with_parameters(shipped("furnace", res=16), {"wall.reflectance": 1.0})
    np.testing.assert_allclose(pj.render(without_roulette(scene, 50), 4, strategy="bsdf"), 50, rtol=1e-6)


def test_reflectance_1_ends_by_roulette(shipped):
    """Without escape the emission adds up without limit, yet every path ends."""
    scene = pj.with_parameters(shipped("furnace", res=16), {"wall.reflectance": 1.0})
    image = np.asarray(pj.render(replace(scene, max_depth=jnp.int32(NO_LIMIT)), 16))
    assert np.isfinite(image).all() and image.min() > 1


@pytest.fixture(scope="module")
def floor_and_lamps(make_scene):
    """(transform of a square lamp, of a ball lamp) -> a floor of albedo RHO and the lamps under a sky of radiance 1."""

    def make(square, ball, **looks):
        floor = shape("rectangle", '<scale value="2"/><rotate x="1" angle="-90"/>', GREY)
        lamps = shape("rectangle", square, lamp(3)) + shape("sphere", ball, lamp(3))
        return make_scene(floor + lamps + UNIFORM, **({"origin": "0, 1.5, 3", "fov": 30} | looks))

    return make


FAR = '<scale value="1e-3"/><translate y="-5"/>'  # under the floor


@pytest.mark.parametrize("strategy", ["mis", "light"])
@pytest.mark.parametrize("size", [1e-6, 1e-12, 1e-18])
def test_lamps_of_hardly_any_area_add_nothing(floor_and_lamps, size, strategy):
    tiny = f'<scale value="{size}"/><rotate x="1" angle="90"/><translate y="1"/>'
    ball = f'<scale value="{size}"/><translate x="1" y="1"/>'
    image = np.asarray(pj.render(floor_and_lamps(tiny, ball), 64, strategy=strategy))
    assert np.isfinite(image).all()
    without = np.asarray(pj.render(floor_and_lamps(FAR, FAR), 64, strategy=strategy))
    # With "light", other lights change the random numbers of the sky; the lamps themselves contribute at most 1e-12.
    tolerance = 1e-4 if strategy == "mis" else 0.05
    np.testing.assert_allclose(image.mean((0, 1)), without.mean((0, 1)), rtol=tolerance)


@pytest.mark.parametrize("strategy", ["mis", "light"])
def test_lamp_seen_edge_on_adds_nothing(floor_and_lamps, strategy):
    """The lamp lies in the plane of the floor, beside it, so every point of the floor sees it edge-on."""
    beside = '<rotate x="1" angle="-90"/><translate x="4"/>'
    image = np.asarray(pj.render(floor_and_lamps(beside, FAR), 64, strategy=strategy))
    without = np.asarray(pj.render(floor_and_lamps(FAR, FAR), 64, strategy=strategy))
    assert np.isfinite(image).all()
    # With "light", other lights change the random numbers of the sky.
    np.testing.assert_allclose(image.mean((0, 1)), without.mean((0, 1)), rtol=1e-4 if strategy == "mis" else 0.05)


TOUCHING = {
    "a square stands on the floor": ('<translate y="1" z="-0.5"/>', FAR),
    "a ball stands on the floor": (FAR, '<scale value="0.5"/><translate y="0.5"/>'),
    "a square pierces the floor": ('<rotate x="1" angle="-20"/><rotate y="1" angle="50"/>', FAR),
    "a ball pierces the floor": (FAR, '<scale value="0.7"/><translate y="0.3"/>'),
    "a square lies on the floor": ('<scale value="0.5"/><rotate x="1" angle="-90"/>', FAR),
}


@pytest.mark.parametrize("case", TOUCHING)
def test_lamps_that_touch_the_floor(floor_and_lamps, estimate, agree, case):
    """Images are finite, and both techniques agree. Light sampling alone has unbounded noise at the contact."""
    scene = floor_and_lamps(*TOUCHING[case])
    agree(estimate(scene, spp=64), estimate(scene, spp=128, strategy="bsdf", first_seed=101))
    assert np.isfinite(np.asarray(pj.render(scene, 64, strategy="light"))).all()


# ---- numbers --------------------------------------------------------------------------------------------------------

EXTREMES = (0.0, 1 - 2**-24)


@pytest.mark.parametrize(
    "name, strategy",
    [
        pytest.param("glass_and_mirror", "mis", marks=pytest.mark.slow),
        ("cornell_box", "mis"),
        pytest.param("glass_and_mirror", "light", marks=pytest.mark.slow),
        pytest.param("shapes_and_filters", "light", marks=pytest.mark.slow),
        pytest.param("conductors", "mis", marks=pytest.mark.slow),
        pytest.param("normals", "mis", marks=pytest.mark.slow),
    ],
)
def test_random_numbers_at_their_ends_give_finite_light(shipped, name, strategy):
    """All combinations of 0 and 1 - 2^-24 for the random numbers of a vertex, from many points of the film."""
    scene = shipped(name, res=16)
    choice = emitters.choice(scene.emitters, strategy)
    draws = np.array(list(itertools.product(EXTREMES, repeat=6)), np.float32)
    places = np.array(list(itertools.product(np.linspace(0, 1, 13), repeat=2)), np.float32)
    lenses = np.array(list(itertools.product(EXTREMES, repeat=2)), np.float32)
    items = [np.repeat(places, len(draws), 0), np.tile(draws, (len(places), 1))]
    items.append(lenses[np.arange(len(items[0])) % 4])

    @jax.jit
    def radiances(items, scene, choice):
        def one(item, scene, choice):
            position, u, u_lens = item
            bounce, options = Bounce(u[0:2], u[2:4], u[4], u[5]), Options(strategy)
            start = path.start(scene, scene.camera.sample_ray(position, u_lens), options)
            return lax.while_loop(
                lambda now: now.alive, lambda now: path.extend(scene, choice, now, bounce, options), start
            ).L

        return native_map(one, items, scene, choice)

    L = np.asarray(radiances(tuple(map(jnp.asarray, items)), replace(scene, about=None), choice))
    assert np.isfinite(L).all()
    assert L.min() >= 0
    assert L.max() > 0


def test_film_samples_at_the_ends_of_random_numbers_are_finite(shipped):
    from pathjax.sensors import film

    for name in ("cornell_box", "shapes_and_filters", "conductors"):  # box, tent, gaussian
        table = shipped(name, res=16).film
        u = jnp.asarray(list(itertools.product(EXTREMES, repeat=2)), jnp.float32)
        sample = jax.jit(jax.vmap(lambda u, table=table: film.sample_position(table, jnp.int32(5), u)))
        position, weight = map(np.asarray, sample(u))
        assert np.isfinite(position).all() and np.isfinite(weight).all() and (weight >= 0).all()


@pytest.mark.parametrize("spp", [1 << 17, pytest.param(10**6, marks=pytest.mark.slow)])
def test_a_million_samples_keep_their_digits(shipped, spp):
    """With bsdf sampling every furnace sample is exact, so only the sum can err. A plain sum loses 1e-4 to 1e-3."""
    scene = shipped("furnace", res=16, max_depth=3)
    image = render_pixels(scene, jnp.arange(4, dtype=jnp.int32), 0, spp, 1, Options("bsdf"))
    expected = (1 - RHO**3) / (1 - RHO)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=2e-6)


@pytest.mark.slow
def test_a_million_noisy_samples_have_the_right_mean(shipped):
    """The tolerance is 1e-5 plus four standard errors of 32 pixels, which are about as large."""
    scene = shipped("furnace", res=16, max_depth=3)
    pixels = np.asarray(render_pixels(scene, jnp.arange(32, dtype=jnp.int32), 0, 10**6, 1), float)
    expected, error = (1 - RHO**3) / (1 - RHO), pixels.std(0, ddof=1) / 32**0.5
    assert (error < 2e-5 * expected).all()
    assert (np.abs(pixels.mean(0) - expected) < 1e-5 * expected + 4 * error).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_one_bad_number_spoils_no_other_pixel(make_scene, value):
    """Two lamps side by side, one of them broken."""
    left, right = (shape("sphere", f'<translate x="{x}"/>', lamp(2)) for x in (-1.2, 1.2))
    scene = make_scene(left + right, depth=1, fov=60)
    (lights,) = scene.emitters
    radiance = lights.table.column("radiance").values.at[0].set(value)
    spoiled_scene = replace(scene, emitters=(replace(lights, table=lights.table.with_column("radiance", radiance)),))
    good, bad = (np.asarray(pj.render(each, 16)) for each in (scene, spoiled_scene))
    spoiled = ~np.isfinite(bad).all(-1)
    np.testing.assert_array_equal(spoiled[:, 8:], False)
    np.testing.assert_array_equal(spoiled[:, :8], good[:, :8].any(-1))
    np.testing.assert_array_equal(bad[~spoiled], good[~spoiled])
