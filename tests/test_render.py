"""Images of whole scenes against closed forms, and against each other where only the computation differs."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.rendering.render import render_pixels

NO_LIMIT = 1 << 30
GREY = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
RHO = np.array([0.2, 0.5, 0.8])
UNIFORM = '<emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>'
MIRROR = '<bsdf type="conductor"><rgb name="specular_reflectance" value="0.9, 0.5, 0.25"/></bsdf>'
OCTAHEDRON = '<string name="filename" value="meshes/octahedron.obj"/><boolean name="face_normals" value="true"/>'


def shape(kind, inside=""):
    return f'<shape type="{kind}">{inside}</shape>'


def with_depth(scene, max_depth, rr_depth=None):
    from dataclasses import replace

    rr_depth = scene.rr_depth if rr_depth is None else jnp.int32(rr_depth)
    return replace(scene, max_depth=jnp.int32(max_depth), rr_depth=rr_depth)


def pixel_count(scene):
    return scene.film.crop[2] * scene.film.crop[3]


# ---- furnaces: the same light from everywhere -----------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cube", "sphere"])
def test_furnace_is_the_truncated_geometric_series(shipped, estimate, agree, kind):
    scene = shipped("furnace", shape=kind, res=16)
    for depth in (1, 2, 3, 8):
        agree(estimate(with_depth(scene, depth, NO_LIMIT)), (1 - RHO**depth) / (1 - RHO))


def test_furnace_by_bsdf_sampling_has_no_noise(shipped):
    """Every path meets Le = 1 at every vertex, so only rounding is left."""
    scene = shipped("furnace", res=16)
    for depth in (1, 2, 3, 8):
        image = pj.render(with_depth(scene, depth, NO_LIMIT), 4, strategy="bsdf")
        np.testing.assert_allclose(image, np.broadcast_to((1 - RHO**depth) / (1 - RHO), image.shape), rtol=2e-6)


@pytest.mark.parametrize("rr_depth", [1, 5])
def test_furnace_without_limit_under_roulette(shipped, estimate, agree, rr_depth):
    scene = with_depth(shipped("furnace", res=16), NO_LIMIT, rr_depth)
    agree(estimate(scene, spp=64), 1 / (1 - RHO))


def test_mirror_ball_in_uniform_light_shows_its_reflectance(make_scene):
    scene = make_scene(shape("sphere", MIRROR) + UNIFORM, fov=5)
    np.testing.assert_allclose(pj.render(scene, 4), np.broadcast_to([0.9, 0.5, 0.25], (16, 16, 3)), rtol=1e-6)


# ---- direct and indirect light --------------------------------------------------------------------------------------


# A plate at the origin that faces up, and a light of each kind around it.
LIGHTS = {
    "disk": '<transform name="to_world"><scale value="0.5"/><lookat origin="0, 2, 0" target="0, 0, 0" up="1, 0, 0"/>'
    "</transform>",
    "sphere": '<point name="center" x="2" y="2" z="0"/><float name="radius" value="0.6"/>',
    "rectangle": '<transform name="to_world"><scale x="0.4" y="0.7" z="1"/>'
    '<lookat origin="0, 1.5, 2" target="0.2, 0.3, 0" up="1, 0, 0"/></transform>',
    "obj": '<transform name="to_world"><scale value="0.5"/><rotate y="1" angle="20"/>'
    f'<translate x="-1.5" y="1.4" z="-0.3"/></transform>{OCTAHEDRON}',
}


# Out of sight; no two share a place, since coincident surfaces give the scene another structure.
AWAY = {
    kind: f'<transform name="to_world"><scale value="1e-3"/><translate x="{place}" y="1e4"/></transform>'
    for place, kind in enumerate(["plate", *LIGHTS])
}
AWAY["obj"] += OCTAHEDRON


@pytest.fixture(scope="module")
def plate_and_lamps(make_scene):
    """A plate, a lamp of each kind and a sky: one structure, so one kernel for many tests.

    Lamps that a test does not place are dark and out of sight.
    """

    def make(plate=AWAY["plate"], sky=0, **camera_and_lamps):
        lamps = {kind: camera_and_lamps.pop(kind, (AWAY[kind], GREY, 0)) for kind in LIGHTS}
        lamps = "".join(
            f'<shape type="{kind}" id="lamp-{kind}">{inside}{bsdf}'
            f'<emitter type="area" id="{kind}"><rgb name="radiance" value="{radiance}"/></emitter></shape>'
            for kind, (inside, bsdf, radiance) in lamps.items()
        )
        sky = f'<emitter type="constant" id="sky"><rgb name="radiance" value="{sky}"/></emitter>'
        return make_scene(shape("rectangle", plate + GREY) + lamps + sky, **camera_and_lamps)

    return make


@pytest.fixture(scope="module")
def lit_plate(plate_and_lamps):
    """All lights at once, with the sky; tests turn them off by `with_parameters`."""
    upwards = '<transform name="to_world"><scale value="3"/><rotate x="1" angle="-90"/></transform>'
    lamps = {kind: (inside, GREY, "2, 3, 4") for kind, inside in LIGHTS.items()}
    return plate_and_lamps(upwards, 1, **lamps, origin="0.5, 1.2, -2", fov=25)


def at_the_origin(scene):
    """Return the scene seen through so long a lens that only the origin is in view."""
    from dataclasses import replace

    camera = scene.camera
    return replace(scene, camera=replace(camera, corner=camera.corner * 1e-4, extent=camera.extent * 1e-4))


def lambert(polygon):
    """Return the irradiance at the origin, normal y, from a polygon of radiance 1 above the horizon (Lambert)."""
    v = polygon / np.linalg.norm(polygon, axis=-1, keepdims=True)
    w = np.roll(v, -1, axis=0)
    angle = np.arccos((v * w).sum(-1))
    edges = np.cross(v, w)
    return abs((angle * edges[:, 1] / np.linalg.norm(edges, axis=-1)).sum() / 2)


def irradiance(scene, kind):
    """Return the closed form of the irradiance at the origin from one light of radiance 1."""
    if kind == "sphere":
        return np.pi * 0.6**2 / 8 * np.sqrt(0.5)
    if kind == "disk":
        return np.pi * 0.5**2 / (0.5**2 + 2**2)
    shapes = scene.about.description.shapes
    geometry = next(s.geometry for s in shapes if s.name == f"lamp-{kind}")
    if kind == "rectangle":
        corners = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]])
        return lambert((corners @ geometry.to_world.T)[:, :3])
    triangles = geometry.vertices[geometry.faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return sum(lambert(t) for t, n in zip(triangles, normals, strict=True) if n @ t[0] < 0)


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf"])
@pytest.mark.parametrize("kind", LIGHTS)
def test_direct_light_is_the_form_factor(lit_plate, estimate, agree, kind, strategy):
    dark = {f"{other}.radiance": 0.0 for other in LIGHTS if other != kind} | {"sky.radiance": 0.0}
    scene = at_the_origin(with_depth(pj.with_parameters(lit_plate, dark), 2))
    expected = RHO / np.pi * np.array([2, 3, 4]) * irradiance(lit_plate, kind)
    agree(estimate(scene, spp=64, strategy=strategy), expected, pixelwise=False)


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf"])
def test_spherical_cavity_with_uneven_emission_is_lit_evenly(plate_and_lamps, estimate, agree, strategy):
    """A disk spans a cap of the unit sphere and emits as the cap would; all other wall points see the cap alike.

    With f the cap's share of the sphere: E = pi Le f / (1 - rho (1 - f)), truncated at max_depth.
    """
    alpha, depth = 0.7, 5
    f = (1 - np.cos(alpha)) / 2
    place = f'<scale value="{np.sin(alpha)}"/><translate z="{-np.cos(alpha)}"/>'
    black = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
    scene = plate_and_lamps(
        sphere=('<boolean name="flip_normals" value="true"/>', GREY, 0),
        disk=(f'<transform name="to_world">{place}</transform>', black, 3),
        **{"depth": depth, "rr_depth": 3, "origin": "0.1, 0.2, -0.3", "target": "0.3, 0.1, 1", "fov": 90},
    )
    series = sum((RHO * (1 - f)) ** k for k in range(depth - 1))
    agree(estimate(scene, spp=64, strategy=strategy), 3 * RHO * f * series)


@pytest.mark.parametrize("strategy", ["light", "bsdf"])
def test_strategies_agree_under_lights_of_every_kind(lit_plate, estimate, agree, strategy):
    agree(estimate(lit_plate, spp=64), estimate(lit_plate, spp=128, strategy=strategy, first_seed=101))


@pytest.mark.parametrize("kind, inside", [("sphere", ""), ("obj", OCTAHEDRON)])
def test_convex_diffuse_object_under_uniform_light_reflects_its_albedo(plate_and_lamps, kind, inside):
    """Every sampled direction escapes, so the estimate has no noise."""
    scene = plate_and_lamps(sky=1, **{kind: (inside, GREY, 0)}, origin="1.2, 1.5, 4", fov=5)
    np.testing.assert_allclose(pj.render(scene, 16), np.broadcast_to(RHO, (16, 16, 3)), rtol=2e-6)


def test_one_triangle_covers_half_of_a_square(plate_and_lamps, write_scene, agree, estimate):
    """The triangle (-1,-1) (1,-1) (-1,1) fills the view up to its hypotenuse, a diagonal of the image.

    The mesh has as many triangles as an octahedron; the others are far away.
    """
    file = write_scene("").with_name("one.obj")
    corners = "v -1 -1 0\nv 1 -1 0\nv -1 1 0\nv 0 0 1e4\nv 1 0 1e4\nv 0 1 1e4\n"
    file.write_text(corners + "f 1 2 3\n" + "f 4 5 6\n" * 7)
    triangle = f'<string name="filename" value="{file}"/><boolean name="face_normals" value="true"/>'
    scene = plate_and_lamps(obj=(triangle, GREY, 1), origin="0, 0, 1", fov=90, depth=1)
    y, x = np.mgrid[:16, :16]
    covered = np.where(x < y, 1.0, np.where(x == y, 0.5, 0.0))
    # The diagonal misses the pixel corners by a few ulps.
    agree(estimate(scene, spp=64), covered[..., None], rounding=1e-4)


def test_roulette_changes_noise_only(lit_plate, estimate, agree):
    early, never = with_depth(lit_plate, 8, 1), with_depth(lit_plate, 8, 1000)
    agree(estimate(early, spp=64), estimate(never, spp=64, first_seed=101))


def test_image_is_linear_in_emission(lit_plate):
    """A power of 2 scales every intermediate value exactly."""
    names = [name for name in pj.parameters(lit_plate) if name.endswith("radiance")]
    brighter = pj.with_parameters(lit_plate, {name: 4 * pj.parameters(lit_plate)[name] for name in names})
    np.testing.assert_array_equal(pj.render(brighter, 4), 4 * pj.render(lit_plate, 4))


def test_depth_1_is_emission_alone(shipped):
    scene = pj.with_parameters(shipped("furnace", res=16), {"glow.radiance": [3, 2, 1]})
    np.testing.assert_array_equal(pj.render(with_depth(scene, 1), 4), np.broadcast_to([3, 2, 1], (16, 16, 3)))


# ---- the same image, computed differently ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cornell(shipped):
    return shipped("cornell_box", res=16)


def test_same_seed_same_image_and_other_seed_another(cornell):
    first = np.asarray(pj.render(cornell, 4, seed=7))
    np.testing.assert_array_equal(first, pj.render(cornell, 4, seed=7))
    different = (first != np.asarray(pj.render(cornell, 4, seed=8))).any(-1)
    assert different.mean() > 0.9


@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="needs two devices")
def test_one_device_and_two_give_the_same_bits(cornell):
    pixels = jnp.arange(255, dtype=jnp.int32)
    one, two = (render_pixels(cornell, pixels, 0, 4, 3, devices=devices) for devices in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_vectorised_form_gives_the_same_image(cornell):
    """Up to rounding: vectorised code is contracted to multiply-adds in other places. Where rounding tips a decision
    (a grazing hit, roulette) a path takes another course, so a few pixels may differ completely."""
    pixels = jnp.arange(pixel_count(cornell), dtype=jnp.int32)
    loop, lanes = (render_pixels(cornell, pixels, 0, 4, 3, form=form, devices=1) for form in ("loop", "vmap"))
    far = ~np.isclose(loop, lanes, rtol=1e-4, atol=1e-5).all(-1)
    assert far.mean() < 0.03


def test_two_halves_of_the_samples_average_to_the_whole(cornell):
    """The same samples, added in another order: only rounding differs."""
    pixels = jnp.arange(pixel_count(cornell), dtype=jnp.int32)
    part = partial(render_pixels, cornell, pixels)
    halves = (3 * part(0, 12, 5) + part(12, 4, 5)) / 4
    np.testing.assert_allclose(halves, part(0, 16, 5), rtol=3e-6, atol=1e-7)


def test_chosen_pixels_are_those_of_the_whole_image(cornell):
    pixels = jnp.asarray([3, 203, 117, 117], jnp.int32)
    chosen = render_pixels(cornell, pixels, 0, 4, 5)
    # Another pixel count is another kernel, which may round differently.
    np.testing.assert_allclose(chosen, pj.render(cornell, 4, 5).reshape(-1, 3)[pixels], rtol=1e-5)


def test_samples_and_seeds_that_differ_from_pixel_to_pixel(cornell):
    """One call with arrays of samples and seeds equals separate calls of the same kernel."""
    pixels = jnp.asarray([3, 203, 117, 117], jnp.int32)
    first, spp, seed = np.array([0, 5, 7, 7]), np.array([4, 1, 16, 16]), np.array([2, 2, 9, 2**32 - 1], np.uint32)
    together = render_pixels(cornell, pixels, first, spp, seed)
    for i in range(len(pixels)):
        alone = render_pixels(cornell, pixels, int(first[i]), int(spp[i]), seed[i])
        np.testing.assert_array_equal(together[i], alone[i])


def test_float64_agrees_with_float32_path_by_path(cornell, kernel_of, x64):
    """Both use the same random numbers, so all paths agree except those that rounding tips."""
    single = np.asarray(pj.render(cornell, 4, seed=2))
    with x64():
        double = kernel_of("cornell_box", jnp.float64).image(4, seed=2)
    assert double.dtype == np.float64
    far = ~np.isclose(single, double, rtol=1e-3, atol=1e-5).all(-1)
    assert far.mean() < 0.03


def test_render_inside_the_users_jit(cornell):
    @jax.jit
    def mean_of(radiance):
        return pj.render(pj.with_parameters(cornell, {"light.radiance": radiance}), 4).mean()

    radiance = pj.parameters(cornell)["light.radiance"]
    np.testing.assert_allclose(mean_of(radiance), pj.render(cornell, 4).mean(), rtol=1e-5)
    assert mean_of(2 * radiance) > mean_of(radiance)


# ---- small scenes ---------------------------------------------------------------------------------------------------


def test_empty_scene_shows_its_background(make_scene):
    sky = '<emitter type="constant"><rgb name="radiance" value="0.1, 0.2, 0.3"/></emitter>'
    image = pj.render(make_scene(sky), 3)
    np.testing.assert_allclose(image, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), image.shape), rtol=1e-6)


def test_scene_of_nothing_at_all_is_black(make_scene):
    assert not np.asarray(pj.render(make_scene(""), 2)).any()


def test_hidden_emitters_light_the_scene_and_let_the_camera_through(make_scene, estimate, agree):
    """A hidden lamp of 5 between camera and plate covers a share f of the sky of 1, seen from the point in view."""
    plate = shape("rectangle", GREY)
    lamp = shape(
        "rectangle",
        '<transform name="to_world"><scale value="0.5"/><rotate y="1" angle="180"/><translate z="1"/></transform>'
        '<emitter type="area"><rgb name="radiance" value="5"/></emitter>',
    )
    point, square = np.array([0.2, 0.1]), np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    f = lambert(np.insert(square - point, 1, 1, axis=1)) / np.pi
    hidden = make_scene(plate + lamp + UNIFORM, hide="true", fov=0.01, depth=2, target="0.2, 0.1, 0")
    agree(estimate(hidden, spp=64), RHO * (5 * f + 1 - f), pixelwise=False)
    beside = make_scene(plate + lamp + UNIFORM, hide="true", origin="4, 0, 0.2", target="4, 0, 5", fov=10)
    assert not np.asarray(pj.render(beside, 2)).any()  # the sky is hidden too


@pytest.mark.parametrize("wrong", [{"spp": 0}, {"spp": -1}, {"seed": -1}, {"strategy": "mix"}])
def test_arguments_out_of_range_are_refused(root, wrong):
    scene = pj.load_scene(root / "scenes" / "cornell_box.xml", res=4)
    with pytest.raises(pj.InputError, match=next(iter(wrong))):
        pj.render(scene, **wrong)


def test_depth_0_is_black(cornell):
    assert not np.any(pj.render(replace(cornell, max_depth=jnp.int32(0)), spp=1))
