"""Derivatives of images against closed forms, differences of independent images, and each other."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.derivatives import ior_difference, ior_step, jacobian
from pathjax.images import write_exr
from pathjax.integrators.options import DEFAULTS
from pathjax.scene import parameters as named
from pathjax.sensors.film import pixel_count

ROOT = Path(__file__).resolve().parents[1]
NO_LIMIT = 1 << 30
RHO = np.array([0.2, 0.5, 0.8])
IOR = 1.5


def without_roulette(scene, max_depth=NO_LIMIT):
    return replace(scene, max_depth=jnp.int32(max_depth), rr_depth=jnp.int32(NO_LIMIT))


def shape(kind, transform="", inside=""):
    return f'<shape type="{kind}"><transform name="to_world">{transform}</transform>{inside}</shape>'


def diffuse(name, reflectance):
    return f'<bsdf type="diffuse" id="{name}"><rgb name="reflectance" value="{reflectance}"/></bsdf>'


def area_light(name, radiance):
    return f'<emitter type="area" id="{name}"><rgb name="radiance" value="{radiance}"/></emitter>'


def sky(radiance=1):
    return f'<emitter type="constant" id="sky"><rgb name="radiance" value="{radiance}"/></emitter>'


# ---- colours: closed forms ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def furnace(shipped):
    """Inside a closed sphere of radiance 1."""
    return shipped("furnace", shape="sphere", res=8)


def series(rho, depth):
    """Return the radiance in the furnace truncated at `depth`, and its derivative in the albedo."""
    k = np.arange(1, depth)[:, None]
    return 1 + np.sum(rho**k, 0), np.sum(k * rho ** (k - 1), 0)


FURNACE_NAMES = ["wall.reflectance", "glow.radiance"]


@pytest.mark.parametrize("depth", [1, 2, 3, 8])
def test_closed_diffuse_sphere_per_sample(furnace, derivatives, depth):
    """Every vertex sees radiance 1, so each sample is the truncated series, and so is its derivative."""
    image, slopes = derivatives(without_roulette(furnace, depth), FURNACE_NAMES, 1, 2, strategy="bsdf")
    L, dL = series(RHO, depth)
    for estimate, exact in ((image, L), (slopes["wall.reflectance"], dL), (slopes["glow.radiance"], L)):
        assert (estimate.variance <= 1e-10).all()
        # An ulp or two for each of up to 8 vertices.
        np.testing.assert_allclose(estimate.mean, np.broadcast_to(exact, (8, 8, 3)), rtol=2e-6)


def test_many_samples_keep_their_digits(furnace):
    """All samples are equal, so plain float32 sums would always round the same way: off by 1 % after a million."""
    scene = without_roulette(furnace, 2)
    _, J = pj.jacobian(scene, FURNACE_NAMES, 1 << 16, strategy="bsdf")
    L, dL = series(RHO, 2)
    np.testing.assert_allclose(J["glow.radiance"], np.broadcast_to(np.diag(L), (8, 8, 3, 3)), rtol=2e-6)
    np.testing.assert_allclose(J["wall.reflectance"], np.broadcast_to(np.diag(dL), (8, 8, 3, 3)), rtol=2e-6)


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf"])
def test_strategies_agree_with_the_closed_form(furnace, derivatives, agree, strategy):
    """Depth 6, with roulette from the second vertex on and without."""
    L, dL = series(RHO, 6)
    for rr_depth in (1, NO_LIMIT):
        scene = replace(furnace, max_depth=jnp.int32(6), rr_depth=jnp.int32(rr_depth))
        image, slopes = derivatives(scene, FURNACE_NAMES, 32, 16, strategy=strategy)
        agree(image, L)
        agree(slopes["wall.reflectance"], dL)
        agree(slopes["glow.radiance"], L)


def test_black_walls_and_dark_lamps_keep_their_derivatives(furnace, derivatives, agree):
    """An albedo of exactly 0 has dL/drho = 1; a radiance of exactly 0 gives a black image with a derivative."""
    for rr_depth in (1, NO_LIMIT):
        scene = replace(furnace, max_depth=jnp.int32(6), rr_depth=jnp.int32(rr_depth))
        black = pj.with_parameters(scene, {"wall.reflectance": 0.0})
        image, slopes = derivatives(black, FURNACE_NAMES, 32)
        agree(image, 1)
        agree(slopes["wall.reflectance"], 1)
        agree(slopes["glow.radiance"], 1)
        dark = pj.with_parameters(scene, {"glow.radiance": 0.0})
        image, slopes = derivatives(dark, FURNACE_NAMES, 32)
        assert not image.mean.any() and not slopes["wall.reflectance"].mean.any()
        agree(slopes["glow.radiance"], series(RHO, 6)[0])


def test_emission_scales(furnace):
    """The image is linear in its one light, sample by sample: s dI/ds = I."""
    scene = pj.with_parameters(furnace, {"glow.radiance": [0.5, 2.0, 7.0]})
    image, J = pj.jacobian(scene, FURNACE_NAMES, 16)
    np.testing.assert_allclose(J["glow.radiance"] @ pj.parameters(scene)["glow.radiance"], image, rtol=1e-5)


PLATE = "plate.reflectance"


@pytest.fixture(scope="module")
def plane(make_scene):
    """A diffuse plate that fills the view, under radiance 1."""
    return make_scene(shape("rectangle", inside=diffuse("plate", "0.2, 0.5, 0.8")) + sky(), res=8, fov=20, depth=2)


def test_diffuse_plane_under_uniform_light(plane):
    image, J = pj.jacobian(plane, ["plate.reflectance"], 4)
    np.testing.assert_allclose(image, np.broadcast_to(RHO, (8, 8, 3)), rtol=1e-6)
    np.testing.assert_allclose(J["plate.reflectance"], np.broadcast_to(np.eye(3), (8, 8, 3, 3)), rtol=1e-6)


# Radiances and albedos of two facing plates; the camera looks at the first.
E1, E2 = np.array([0.5, 1.0, 2.0]), np.array([3.0, 2.0, 1.0])
RHO1, RHO2 = np.array([0.3, 0.6, 0.9]), np.array([0.8, 0.5, 0.2])
PLATES = ["one.reflectance", "two.reflectance", "glow-one.radiance", "glow-two.radiance"]


def listed(values):
    return ", ".join(map(str, values))


@pytest.fixture(scope="module")
def plates(make_scene):
    """(half width, depth) -> plates at z = 0 and z = 1; a camera between them sees the middle of the first."""

    def make(size, depth):
        first = diffuse("one", listed(RHO1)) + area_light("glow-one", listed(E1))
        second = diffuse("two", listed(RHO2)) + area_light("glow-two", listed(E2))
        return make_scene(
            shape("rectangle", f'<scale value="{size}"/>', first)
            + shape("rectangle", f'<scale value="{size}"/><rotate y="1" angle="180"/><translate z="1"/>', second),
            res=8,
            depth=depth,
            rr_depth=4,
            origin="0, 0, 0.9",
            fov=0.01,
        )

    return make


def plate_series(f, depth):
    """Return B1 = E1 + rho1 f B2, B2 = E2 + rho2 f B1, truncated at `depth` vertices, and its four derivatives."""

    def radiosity(rho1, rho2, e1, e2):
        b1, b2 = 0, 0
        for _ in range(depth):
            b1, b2 = e1 + rho1 * f * b2, e2 + rho2 * f * b1
        return b1

    at = (RHO1, RHO2, E1, E2)
    # A polynomial with real coefficients: complex steps give its derivatives to full precision.
    steps = np.eye(4)[:, :, None] * 1e-30j
    return radiosity(*at), [radiosity(*(a + s for a, s in zip(at, step, strict=True))).imag / 1e-30 for step in steps]


def test_two_infinite_plates(plates, derivatives, agree):
    """f = 1 gives (E1 + rho1 E2) / (1 - rho1 rho2); at 64 vertices the rest of the series is below 1e-8."""
    f = 1
    B1, partials = plate_series(f, 64)
    np.testing.assert_allclose(B1, (E1 + RHO1 * f * E2) / (1 - RHO1 * RHO2 * f**2))
    # Light sampling over such large plates would seldom sample the region that matters.
    image, slopes = derivatives(plates(1e3, 64), PLATES, 64, strategy="bsdf")
    # Beyond 1e3 plate distances lies 1e-6 of the light.
    agree(image, B1, pixelwise=False)
    for name, partial in zip(PLATES, partials, strict=True):
        agree(slopes[name], partial, pixelwise=False)


@pytest.mark.parametrize("strategy", ["mis", pytest.param("bsdf", marks=pytest.mark.slow)])
def test_two_finite_plates_with_their_form_factor(plates, derivatives, agree, strategy):
    """One bounce: the point's form factor to the other plate, a rectangle whose middle faces it."""
    # Four quarters, each 1 / (2 pi) (a / A atan(b / A) + b / B atan(a / B)), A^2 = 1 + a^2 (Howell's catalogue, B-3).
    root = np.sqrt(2)
    f = 4 / (2 * np.pi) * 2 * (1 / root) * np.arctan(1 / root)
    B1, partials = plate_series(f, 2)
    image, slopes = derivatives(plates(1.0, 2), PLATES, 64, strategy=strategy)
    agree(image, B1, pixelwise=False)
    for name, partial in zip(PLATES, partials, strict=True):
        agree(slopes[name], partial, pixelwise=False)


METAL = ["metal.eta", "metal.k", "metal.specular_reflectance"]  # the same in all tests, which share one kernel


def metal_sheet(make_scene, angle):
    """Return a sheet of metal that fills the view, seen at an angle under radiance 2."""
    metal = (
        '<bsdf type="conductor" id="metal"><rgb name="eta" value="0.2, 0.924, 1.102"/>'
        '<rgb name="k" value="3.912, 2.452, 2.142"/><rgb name="specular_reflectance" value="0.9, 0.8, 0.7"/></bsdf>'
    )
    tilted = f'<scale value="9"/><rotate y="1" angle="{angle}"/>'
    return make_scene(shape("rectangle", tilted, metal) + sky(2), res=8, fov=1e-3)


def conductor_reflectance(cos_i, eta, k):
    """Return the reflectance from complex amplitudes, in float64."""
    n = eta + 1j * k
    cos_t = np.sqrt(1 - (1 - cos_i**2) / n**2)
    r_s, r_p = (cos_i - n * cos_t) / (cos_i + n * cos_t), (n * cos_i - cos_t) / (n * cos_i + cos_t)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


@pytest.mark.parametrize("angle", [0, 40, 75])
def test_metals(make_scene, angle):
    """I = 2 s F(eta, k), and all three derivatives."""
    eta, k, s = np.array([0.2, 0.924, 1.102]), np.array([3.912, 2.452, 2.142]), np.array([0.9, 0.8, 0.7])
    image, J = pj.jacobian(metal_sheet(make_scene, angle), METAL, 1)

    def F(eta, k):
        return conductor_reflectance(np.cos(np.radians(angle)), eta, k)

    h = 1e-5
    exact = (
        2 * s * (F(eta + h, k) - F(eta - h, k)) / (2 * h),
        2 * s * (F(eta, k + h) - F(eta, k - h)) / (2 * h),
        2 * F(eta, k),
    )
    np.testing.assert_allclose(image, np.broadcast_to(2 * s * F(eta, k), (8, 8, 3)), rtol=1e-5)
    for name, slope in zip(METAL, exact, strict=True):
        # In float32 some digits of 1 - F cancel, and the view is 1e-5 wide.
        wanted = np.broadcast_to(np.diag(slope), (8, 8, 3, 3))
        np.testing.assert_allclose(J[name], wanted, rtol=1e-4, atol=2e-6)


@pytest.mark.parametrize("angle", [0, 40, 75])
def test_metals_of_next_to_no_eta(make_scene, angle):
    """Such metals reflect nearly all light; dI/deta is that at eta = 0, where 1 - F = eta times a closed form."""
    k, s = np.array([0.5, 2, 30]), np.array([0.9, 0.8, 0.7])
    scene = metal_sheet(make_scene, angle)
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    b = np.hypot(k, sin)
    slope = -2 * k * cos / (b * (cos**2 + b**2)) * (1 + (b**2 + sin**2) / (sin**4 + (b * cos) ** 2))
    for eta in (0, 1e-9, 1e-4):
        changed = pj.with_parameters(scene, {"metal.eta": [eta] * 3, "metal.k": k})
        image, J = pj.jacobian(changed, METAL, 1)
        np.testing.assert_allclose(image, np.broadcast_to(2 * s * (1 + eta * slope), (8, 8, 3)), rtol=1e-5)
        # Pixels see the sheet at slightly different angles, and the slope itself changes by a few eta.
        expected = np.broadcast_to(np.diag(2 * s * slope), (8, 8, 3, 3))
        np.testing.assert_allclose(J["metal.eta"], expected, rtol=1e-4 + 10 * eta, atol=1e-9)


def test_checkerboard_colours(shipped):
    """Up to depth 5 a path meets the screen at most twice, so a sample is quadratic in the screen's colours and
    central differences with the same seed are exact."""
    scene = without_roulette(shipped("glass_ball", res=8), 5)
    names = ["pattern.color0", "pattern.color1", "sky.radiance"]
    image, J = pj.jacobian(scene, names, 16)
    h = 0.1
    for name in names[:2]:
        value = pj.parameters(scene)[name]
        up, down = (pj.jacobian(pj.with_parameters(scene, {name: value + s * h}), names, 16)[0] for s in (1, -1))
        slope = np.diagonal(J[name], axis1=-2, axis2=-1)
        assert slope.max() > 0.1
        np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(J["sky.radiance"] @ pj.parameters(scene)["sky.radiance"], image, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_second_derivatives_of_some_colours(shipped):
    """Samples are quadratic in the screen's colours, as above, so slopes differ by exactly the second derivative."""
    scene = without_roulette(shipped("glass_ball", res=8), 5)
    names = ["pattern.color0", "pattern.color1", "sky.radiance"]
    values = {name: pj.parameters(scene)[name] for name in names}

    def brightness(values):
        return pj.render(pj.with_parameters(scene, values), 16).sum()

    slope = jax.grad(brightness)
    change = {name: jnp.full(3, 0.5) for name in names[:2]} | {"sky.radiance": jnp.zeros(3)}
    curved = jax.jvp(slope, (values,), (change,))[1]
    assert jacobian.takes_sweep(scene, [scene.about.parameters[name] for name in names])
    up, down = (slope(jax.tree.map(lambda x, dx, h=h: x + h * dx, values, change)) for h in (0.1, -0.1))
    assert curved["sky.radiance"].min() > 10
    for name in names:
        np.testing.assert_allclose(curved[name], (up[name] - down[name]) / 0.2, rtol=1e-3, atol=1e-3)


# ---- glass: closed forms --------------------------------------------------------------------------------------------

GRID = 12
# Slope of the ramp over the screen, per channel, in albedo per half width.
RAMP = np.array([0.4, 0.2, -0.3])
PICTURES = {
    "black": np.zeros((GRID, GRID, 3)),
    "ramp": 0.5 + RAMP * ((np.arange(GRID) + 0.5) / GRID * 2 - 1)[None, :, None] * np.ones((GRID, 1, 1)),
    "edge": np.where(np.arange(GRID) < GRID // 2, 0.1, 0.8)[None, :, None] * np.ones((GRID, 1, 3)),
    "checkerboard": np.where(np.sum(np.indices((GRID, GRID)), 0) % 2, 0.1, 0.8)[..., None] * np.ones(3),
}
AWAY = '<scale value="1e-3"/><translate y="1e5"/>'


@pytest.fixture(scope="module")
def stage(make_scene, tmp_path_factory):
    """A ball, a slab and an octahedron of one glass, and a screen with an image, under radiance 1.

    Each shape is placed by its transform, or out of sight: one structure, so one kernel for all tests.
    """
    file = tmp_path_factory.mktemp("stage") / "picture.exr"
    write_exr(file, {c: np.zeros((GRID, GRID), np.float32) for c in "RGB"}, {})

    def make(ball=AWAY, slab=AWAY, gem=AWAY, screen=AWAY, picture="black", **camera):
        glass = (
            '<bsdf type="dielectric" id="glass"><float name="int_ior" value="1.5"/>'
            '<float name="ext_ior" value="1"/></bsdf>'
        )
        texture = (
            '<bsdf type="diffuse" id="screen"><texture type="bitmap" name="reflectance">'
            f'<string name="filename" value="{file}"/><boolean name="raw" value="true"/>'
            '<string name="wrap_mode" value="clamp"/></texture></bsdf>'
        )
        octahedron = (
            '<string name="filename" value="meshes/octahedron.obj"/><boolean name="face_normals" value="true"/>'
        )
        ref = '<ref id="glass"/>'
        scene = make_scene(
            glass
            + shape("sphere", ball, ref)
            + shape("cube", slab, ref)
            + shape("obj", gem, octahedron + ref)
            + shape("rectangle", screen, texture)
            + sky(),
            **camera,
        )
        return with_picture(scene, picture)

    return make


def with_picture(scene, picture):
    """Return the scene with its only texture set to one of PICTURES."""
    (table,) = scene.materials.textures.tables
    table = table.with_column("texels", jnp.asarray(PICTURES[picture].reshape(-1, 3), jnp.float32))
    table = table.with_column("nearest", jnp.asarray([picture != "ramp"]))
    return named.put(scene, ("materials", "textures", "tables", 0), table)


GLASS = "glass.int_ior"
SCREEN = '<scale value="6"/><translate z="-3"/>'


def reflectance(eta):
    """Return the reflectance at normal incidence, and its derivative."""
    return ((eta - 1) / (eta + 1)) ** 2, 4 * (eta - 1) / (eta + 1) ** 3


def difference(f, step):
    """Return the central difference of f (eta -> value) at IOR, which the difference method estimates without bias."""
    return (f(IOR + step) - f(IOR - step)) / (2 * step)


BODIES = {
    "ball": '<scale value="0.8"/>',
    "slab": '<scale value="0.6"/><rotate y="1" angle="30"/><rotate x="1" angle="20"/>',
    "gem": '<rotate y="1" angle="20"/>',
}


@pytest.mark.parametrize("body", BODIES)
def test_glass_in_uniform_light_stays_invisible(stage, derivatives, agree, body):
    """The image is 1 and the derivative 0 for a ball, a cube and a mesh, if paths are followed to their end."""
    scene = without_roulette(stage(**{body: BODIES[body]}))
    image, slopes = derivatives(scene, [GLASS], 32, step=0.01)
    agree(image, 1)
    agree(slopes[GLASS], 0)
    assert slopes[GLASS].variance.max() > 0


def test_truncated_glass_shows_what_is_cut_off(stage, derivatives, agree):
    """Two vertices leave only the front reflection, I = R and dI/deta = dR/deta: the effect of a small max_depth."""
    scene = without_roulette(stage(ball="", fov=1e-3), 2)
    image, slopes = derivatives(scene, [GLASS], 64, step=0.01)
    R, dR = reflectance(IOR)
    agree(image, R)
    agree(slopes[GLASS], difference(lambda eta: reflectance(eta)[0], 0.01))
    np.testing.assert_allclose(slopes[GLASS].mean.mean(), dR, rtol=0.05)
    assert dR == pytest.approx(0.128)


def test_clear_slab_with_all_its_internal_reflections(stage, derivatives, agree):
    """Before a black screen under radiance 1 a slab shows 1 - T, with T = 2 eta / (eta^2 + 1)."""
    slab, screen = '<scale x="5" y="5" z="0.2"/>', '<scale value="50"/><translate z="-1"/>'
    scene = without_roulette(stage(slab=slab, screen=screen, fov=1e-3))
    image, slopes = derivatives(scene, [GLASS], 64, step=0.01)

    def T(eta):
        return 2 * eta / (eta**2 + 1)

    agree(image, 1 - T(IOR))
    agree(slopes[GLASS], -difference(T, 0.01))
    # The step's own error is 1e-5.
    agree(slopes[GLASS], 0.236686, rounding=1e-4)


# A slab of thickness 0.5 tilted by 45 degrees before a screen 100 away: it hides 1e-4 of the light from the screen.
THICKNESS, TILT, FAR = 0.5, np.radians(45), 100
SLAB = f'<scale x="1" y="1" z="{THICKNESS / 2}"/><rotate y="1" angle="45"/>'


def shift(eta):
    """Return the lateral shift of the view through the tilted slab, and its derivative."""
    s, c = np.sin(TILT), np.cos(TILT)
    root = eta**2 - s**2
    return THICKNESS * s * (1 - c / np.sqrt(root)), THICKNESS * s * c * eta / root**1.5


def slab_reflectance(eta):
    s, c = np.sin(TILT), np.cos(TILT)
    c_t = np.sqrt(1 - (s / eta) ** 2)
    return ((c - eta * c_t) ** 2 / (c + eta * c_t) ** 2 + (eta * c - c_t) ** 2 / (eta * c + c_t) ** 2) / 2


def through_slab(eta, albedo):
    """Return the radiance at depth 4: front reflection, one internal reflection, and transmission of the screen."""
    R = slab_reflectance(eta)
    return R + R * (1 - R) ** 2 + (1 - R) ** 2 * albedo


def ramp_image(eta):
    return through_slab(eta, 0.5 - RAMP * shift(eta)[0])


def test_oblique_slab_before_a_ramp(stage, derivatives, agree):
    """The ramp shifts by d(eta) towards the side that the slab faces."""
    scene = without_roulette(stage(slab=SLAB, screen=f'<translate z="{-FAR}"/>', picture="ramp", fov=1e-3, far=1e6), 4)
    image, slopes = derivatives(scene, [GLASS], 64, step=0.02)
    rounding = 3e-4  # the light hidden by the slab, and the ulp of positions 100 away over the step
    agree(image, ramp_image(IOR), rounding=rounding)
    agree(slopes[GLASS], difference(ramp_image, 0.02), rounding=rounding, pixelwise=False)


@pytest.fixture(scope="module")
def edge_seen_through_a_slab(stage):
    """Return the scene with the texture's edge in the middle of the image, and the image's width on the screen."""
    fov = 0.1
    # The eye is 4 from the slab, which is small compared with the distance to the screen.
    width = 2 * np.tan(np.radians(fov / 2)) * (FAR + 4)
    at_edge = f'<translate x="{-shift(IOR)[0]}" z="{-FAR}"/>'
    return without_roulette(stage(slab=SLAB, screen=at_edge, picture="edge", fov=fov), 4), width


def edge_image(eta, width):
    """Return the mean of the image: as the shift grows, more of the dark left side comes into view."""
    moved = shift(eta)[0] - shift(IOR)[0]
    return through_slab(eta, (0.1 + 0.8) / 2 - 0.7 * moved / width)


def test_oblique_slab_before_a_step_edge(edge_seen_through_a_slab, derivatives, agree):
    """The derivative includes the edge term: a jump of 0.7, at the density 1 / width, moves with dd/deta."""
    scene, width = edge_seen_through_a_slab
    step = 0.02
    image, slopes = derivatives(scene, [GLASS], 64, step=step)
    edge = -0.7 / width * shift(IOR)[1] * (1 - slab_reflectance(IOR)) ** 2
    exact = difference(lambda eta: edge_image(eta, width), step)
    assert edge < -0.5 and abs(exact - edge) < 0.3 * abs(edge)
    agree(image, edge_image(IOR, width), rounding=3e-4, pixelwise=False)
    agree(slopes[GLASS], exact, rounding=1e-3, pixelwise=False)


def test_attached_derivatives_know_no_edges(edge_seen_through_a_slab, derivatives, agree):
    """They include the Fresnel terms only; before a ramp they are right, without any step."""
    scene, width = edge_seen_through_a_slab
    image, slopes = derivatives(scene, [GLASS], 32, method="attached")
    fresnel_alone = difference(lambda eta: through_slab(eta, 0.45), 1e-6)
    agree(image, edge_image(IOR, width), rounding=3e-4, pixelwise=False)
    agree(slopes[GLASS], fresnel_alone, rounding=1e-3, pixelwise=False)
    _, slopes = derivatives(with_picture(scene, "ramp"), [GLASS], 32, method="attached")
    # The screen is placed such that the middle of the image sees the middle of the ramp.
    exact = difference(lambda eta: through_slab(eta, 0.5 - RAMP * (shift(eta)[0] - shift(IOR)[0])), 1e-6)
    agree(slopes[GLASS], exact, rounding=1e-3, pixelwise=False)


# A ball of radius 0.1, seen from 4 away by a ray aimed at a height of 0.002, and a screen 3 behind it.
BALL, EYE, BEHIND, HEIGHT = 0.1, 4, 3, 0.002


def focal_length(eta):
    """Return the focal length and its derivative, -2 R at 1.5."""
    return eta * BALL / (2 * (eta - 1)), -BALL / (2 * (eta - 1) ** 2)


def seen_at(eta):
    """Return the height on the screen, by the lens equation."""
    return HEIGHT / EYE * (EYE + BEHIND - BEHIND * EYE / focal_length(eta)[0])


def test_ball_lens_in_the_paraxial_limit(stage, derivatives, agree):
    """Twice the ramp at the height for +y: the difference to -y cancels all that is the same on both sides."""
    f, df = focal_length(IOR)
    assert df == pytest.approx(-2 * BALL)
    half = 0.1
    means = {}
    for side in (1, -1):
        scene = without_roulette(
            stage(
                ball=f'<scale value="{BALL}"/>',
                screen=f'<scale value="{half}"/><translate z="{-BEHIND}"/>',
                picture="ramp",
                fov=1e-4,
                target=f"{side * HEIGHT}, 0, 0",
            ),
            4,
        )
        means[side] = derivatives(scene, [GLASS], 64, step=0.02, first_seed=1 if side > 0 else 101)
    image, slope = (
        up._replace(mean=up.mean - down.mean, variance=up.variance + down.variance)
        for up, down in ((means[1][0], means[-1][0]), (means[1][1][GLASS], means[-1][1][GLASS]))
    )
    light = 1 - (BALL / BEHIND) ** 2  # of the sky's light, the share that the ball leaves to the screen

    def odd(eta):
        return 2 * RAMP / half * seen_at(eta) * (1 - reflectance(eta)[0]) ** 2 * light

    # Heights of 2 % of the radius have an error of the order of their square.
    agree(image, odd(IOR), rounding=2e-3, pixelwise=False)
    agree(slope, difference(odd, 0.02), rounding=2e-3, pixelwise=False)
    dy = HEIGHT / EYE * BEHIND * EYE / f**2 * df
    R, dR = reflectance(IOR)
    exact = 2 * RAMP / half * light * ((1 - R) ** 2 * dy - 2 * (1 - R) * dR * seen_at(IOR))
    np.testing.assert_allclose(slope.mean.mean((0, 1)), exact, rtol=0.02)


@pytest.mark.slow
def test_motion_of_the_image_behind_a_ball_lens(stage):
    """The motion that chooses the step: pixels by which the image moves, from the same lens equation."""
    scene = stage(
        ball=f'<scale value="{BALL}"/>',
        screen=f'<scale value="0.2"/><translate z="{-BEHIND}"/>',
        fov=1e-4,
        target=f"{HEIGHT}, 0, 0",
    )
    f, df = focal_length(IOR)
    dy_deta = HEIGHT * BEHIND / f**2 * df
    pixel = 2 * np.tan(np.radians(1e-4 / 2)) / 16
    dy_dpixel = pixel * (EYE + BEHIND - BEHIND * EYE / f)
    (motion,) = ior_step.motions(replace(scene, about=None), jnp.asarray([0], jnp.int32))
    assert float(motion) == pytest.approx(abs(dy_deta / dy_dpixel), rel=5e-3)


def test_glass_of_ior_1(stage, derivatives, agree):
    """Nothing is reflected or refracted, but the view through the glass has a derivative."""
    scene = stage(ball="", screen=SCREEN, picture="checkerboard")
    clear = pj.with_parameters(scene, {GLASS: 1.0})
    image, slopes = derivatives(clear, [GLASS], 32, step=0.01)
    bare, _ = derivatives(stage(screen=SCREEN, picture="checkerboard"), [GLASS], 32, step=0.01)
    agree(image, bare, rounding=1e-4)
    assert np.isfinite(slopes[GLASS].mean).all() and np.abs(slopes[GLASS].mean).max() > 0.5
    # Reflection only: R is even about 1 up to the third order, step^2 / 4.
    mirror = pj.with_parameters(without_roulette(stage(ball="", fov=1e-3), 2), {GLASS: 1.0})
    _, slopes = derivatives(mirror, [GLASS], step=0.01)
    np.testing.assert_allclose(slopes[GLASS].mean, 0, atol=1e-4)
    _, J = pj.jacobian(mirror, [GLASS], 4, method="attached")
    np.testing.assert_allclose(J[GLASS], 0, atol=1e-6)
    _, J = pj.jacobian(clear, [GLASS], 4, method="attached")
    assert np.isfinite(J[GLASS]).all()


# ---- glass: against independent images ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball_before_checkerboard(stage):
    """The unit ball at the origin, the eye at z = 4, the checkerboard at z = -3."""
    return stage(ball="", screen=SCREEN, picture="checkerboard")


def rendered_difference(estimate, scene, name, step, spp, count):
    """Return an Estimate of the central difference of images that share no random numbers."""
    value = pj.parameters(scene)[name]
    up, down = (
        estimate(pj.with_parameters(scene, {name: value + sign * step}), spp, count, first_seed=first)
        for sign, first in ((1, 1001), (-1, 2001))
    )
    return up._replace(
        mean=(up.mean - down.mean) / (2 * step), variance=(up.variance + down.variance) / (2 * step) ** 2
    )


def test_ball_before_checkerboard(ball_before_checkerboard, derivatives, estimate, agree):
    """Pixel by pixel against differences of independent renders."""
    scene, step = ball_before_checkerboard, 0.02
    _, slopes = derivatives(scene, [GLASS], 64, step=step)
    reference = rendered_difference(estimate, scene, GLASS, step, 512, 16)
    agree(slopes[GLASS], reference, rounding=1e-4)
    z = (slopes[GLASS].mean - reference.mean) / np.sqrt(slopes[GLASS].variance + reference.variance + 1e-12)
    # With variances from 16 seeds the mean of z^2 is 15 / 13; pixels that see no glass have no variance.
    touched = reference.variance[..., 0] > 1e-6
    assert np.mean(z[touched] ** 2) <= 1.5
    # The compared derivative stands out from its noise.
    assert np.sqrt(np.mean(slopes[GLASS].mean ** 2)) > 5 * np.sqrt(np.mean(slopes[GLASS].variance))


def test_exterior_ior_is_the_same_derivative_scaled(ball_before_checkerboard):
    """Only the ratio matters: dI/dext = -(int / ext) dI/dint, sample by sample."""
    outside = 1.2
    scene = pj.with_parameters(ball_before_checkerboard, {"glass.ext_ior": outside})
    _, J = pj.jacobian(scene, [GLASS, "glass.ext_ior"], 8, step=0.01)
    assert np.abs(J[GLASS]).max() > 0.5
    np.testing.assert_allclose(J["glass.ext_ior"], -IOR / outside * J[GLASS], rtol=1e-6)
    np.testing.assert_allclose(J.bias["glass.ext_ior"], -IOR / outside * J.bias[GLASS], rtol=1e-6)
    assert set(J.step) == {GLASS, "glass.ext_ior"} and float(J.step[GLASS]) == pytest.approx(0.01)


def test_estimated_bias_is_that_of_the_step(stage, derivatives, agree):
    """The front reflection of a ball, whose bias has a closed form: derivative - bias is right to a higher order."""
    scene = without_roulette(stage(ball="", fov=1e-3), 2)
    step = 0.2
    biases = []
    for seed in range(1, 17):
        _, J = pj.jacobian(scene, [GLASS], 256, seed, step=step)
        biases.append(np.asarray(J.bias[GLASS]).mean())
    wanted = (difference(lambda e: reflectance(e)[0], 2 * step) - difference(lambda e: reflectance(e)[0], step)) / 3
    error = np.std(biases, ddof=1) / 4
    assert abs(np.mean(biases) - wanted) < 4.5 * error
    assert error < 0.3 * abs(wanted)


def test_roulette_changes_no_derivative_of_glass(ball_before_checkerboard, derivatives, agree):
    few = replace(ball_before_checkerboard, rr_depth=jnp.int32(1))
    off = replace(ball_before_checkerboard, rr_depth=jnp.int32(NO_LIMIT))
    (image, slopes), (other_image, others) = (
        derivatives(scene, [GLASS], 64, step=0.02, first_seed=first) for scene, first in ((few, 1), (off, 101))
    )
    agree(image, other_image)
    agree(slopes[GLASS], others[GLASS])


# ---- jacobian and render --------------------------------------------------------------------------------------------


def test_image_is_that_of_render(ball_before_checkerboard, plane):
    """With the same seed, to rounding, so a fit sees the image that a render shows."""
    for scene, names, how in ((ball_before_checkerboard, [GLASS], {"step": 0.01}), (plane, [PLATE], {})):
        image, J = pj.jacobian(scene, names, 16, 7, **how)
        np.testing.assert_allclose(image, pj.render(scene, 16, 7), rtol=1e-5, atol=1e-6)
        assert set(J) == J.keys() == set(names) and len(J) == len(names)
        assert {name: value.shape for name, value in J.items()} == {
            name: (*image.shape, *pj.parameters(scene)[name].shape) for name in names
        }


# Every transformation compiles anew; the plane compiles fastest.


@pytest.fixture(scope="module")
def dim_plane(plane):
    """The plane under a sky that may vary too."""
    return pj.with_parameters(plane, {"sky.radiance": [0.5, 1.0, 2.0]})


def plane_image(scene):
    def image(albedo, radiance):
        return pj.render(pj.with_parameters(scene, {PLATE: albedo, "sky.radiance": radiance}), 2)

    return image


def assert_adjoint(f, at):
    rng = np.random.default_rng(5)
    image, J = jax.linearize(f, *at)
    _, transpose = jax.vjp(f, *at)
    for _ in range(3):
        u = [jnp.asarray(rng.normal(size=x.shape), jnp.float32) for x in at]
        v = jnp.asarray(rng.normal(size=image.shape), jnp.float32)
        Ju = np.asarray(J(*u), float)
        left = np.vdot(np.asarray(v, float), Ju)
        right = sum(np.vdot(np.asarray(a, float), np.asarray(b, float)) for a, b in zip(transpose(v), u, strict=True))
        scale = np.linalg.norm(v) * np.linalg.norm(Ju)
        assert scale > 0.1
        # Sums of about 1000 products in float32.
        assert abs(left - right) < 1e-5 * scale


def test_adjoint_is_the_transpose(dim_plane):
    """<v, J u> = <J'v, u>, through jvp and vjp of render, for any u and v."""
    parameters = pj.parameters(dim_plane)
    assert_adjoint(plane_image(dim_plane), (parameters[PLATE], parameters["sky.radiance"]))


@pytest.mark.slow
def test_adjoint_is_the_transpose_for_glass(ball_before_checkerboard):
    def image(ior, radiance):
        return pj.render(pj.with_parameters(ball_before_checkerboard, {GLASS: ior, "sky.radiance": radiance}), 4)

    assert_adjoint(image, (jnp.float32(IOR), jnp.ones(3)))


def test_every_transformation_gives_the_jacobian(dim_plane):
    """jvp, linearize, jacfwd, vjp, and grad in a user's own jit."""
    f = plane_image(dim_plane)
    at = pj.parameters(dim_plane)[PLATE], pj.parameters(dim_plane)["sky.radiance"]
    _, J = pj.jacobian(dim_plane, [PLATE, "sky.radiance"], 2)
    wanted = J[PLATE], J["sky.radiance"]
    direction = jnp.asarray([0.3, -0.2, 0.5]), jnp.asarray([1.0, 2.0, -1.0])
    along = sum(d @ u for d, u in zip(wanted, direction, strict=True))
    v = jnp.linspace(-1, 1, 8 * 8 * 3).reshape(8, 8, 3)
    back = [jnp.einsum("hwc,hwck->k", v, d) for d in wanted]
    close = {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(jax.jvp(f, at, direction)[1], along, **close)
    np.testing.assert_allclose(jax.linearize(f, *at)[1](*direction), along, **close)
    for mine, its in zip(wanted, jax.jacfwd(f, (0, 1))(*at), strict=True):
        np.testing.assert_allclose(its, mine, **close)
    for mine, its in zip(back, jax.vjp(f, *at)[1](v), strict=True):
        np.testing.assert_allclose(its, mine, **close)
    for mine, its in zip(back, jax.jit(jax.grad(lambda a, b: jnp.vdot(v, f(a, b)), (0, 1)))(*at), strict=True):
        np.testing.assert_allclose(its, mine, **close)


def test_a_table_set_by_hand_has_its_derivative_too(dim_plane):
    """Beside parameters set by name. A table without parameters is refused; one with some is differentiated in all."""
    sky = pj.parameters(dim_plane)["sky.radiance"]

    place = named.find(dim_plane, "sky.radiance")

    def image(albedo, radiance):
        table = named.get(dim_plane, place.path).at[place.index].set(radiance)
        return pj.render(pj.with_parameters(named.put(dim_plane, place.path, table), {PLATE: albedo}), 2)

    at = pj.parameters(dim_plane)[PLATE], sky
    direction = jnp.asarray([0.3, -0.2, 0.5]), jnp.asarray([1.0, 2.0, -1.0])
    by_name = jax.jvp(plane_image(dim_plane), at, direction)[1]
    np.testing.assert_allclose(jax.jvp(image, at, direction)[1], by_name, rtol=1e-6)


def test_second_derivative_in_a_colour_is_that_of_the_series(furnace):
    """The series is 1 + rho + rho^2, sample by sample."""
    scene = without_roulette(furnace, 3)

    def slope(rho):
        one = jnp.ones(3)
        image = lambda rho: pj.render(pj.with_parameters(scene, {FURNACE_NAMES[0]: rho}), 1, strategy="bsdf")  # noqa: E731
        return jax.jvp(image, (rho,), (one,))[1]

    slopes, curvature = jax.jvp(slope, (jnp.asarray(RHO, jnp.float32),), (jnp.ones(3),))
    np.testing.assert_allclose(slopes, np.broadcast_to(1 + 2 * RHO, (8, 8, 3)), rtol=1e-5)
    np.testing.assert_allclose(curvature, np.full((8, 8, 3), 2), rtol=1e-5)


def test_jacobian_inside_the_users_jit(dim_plane):
    def weighted(albedo):
        scene = pj.with_parameters(dim_plane, {PLATE: albedo})
        image, J = pj.jacobian(scene, [PLATE], 2)
        return image, J[PLATE]

    albedo = pj.parameters(dim_plane)[PLATE] * 0.9
    for a, b in zip(jax.jit(weighted)(albedo), weighted(albedo), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


# ---- vmap -----------------------------------------------------------------------------------------------------------


def test_batches_of_parameters_equal_single_calls(dim_plane):
    albedos = jnp.asarray([[0.1, 0.2, 0.3], [0.9, 0.5, 0.4], [0.0, 0.6, 1.0]])

    def image(albedo):
        return pj.render(pj.with_parameters(dim_plane, {PLATE: albedo}), 2)

    def derivative(albedo):
        image, J = pj.jacobian(pj.with_parameters(dim_plane, {PLATE: albedo}), [PLATE], 2)
        return image, J[PLATE]

    images, (same, slopes) = jax.vmap(image)(albedos), jax.vmap(derivative)(albedos)
    for i, albedo in enumerate(albedos):
        np.testing.assert_allclose(images[i], image(albedo), rtol=1e-6)
        np.testing.assert_allclose(same[i], image(albedo), rtol=1e-6)
        np.testing.assert_allclose(slopes[i], derivative(albedo)[1], rtol=1e-6)


def test_batches_of_cameras_equal_single_calls(dim_plane):
    origins = jnp.asarray([[0.0, 0.0, 4.0], [1.0, 0.5, 6.0]])  # the second sees past the plate

    def seen_from(origin):
        return replace(dim_plane, camera=replace(dim_plane.camera, origin=origin))

    def derivative(origin):
        image, J = pj.jacobian(seen_from(origin), [PLATE], 2)
        return image, J[PLATE]

    images, slopes = jax.vmap(derivative)(origins)
    assert not np.array_equal(images[0], images[1])
    for i, origin in enumerate(origins):
        np.testing.assert_allclose(images[i], pj.render(seen_from(origin), 2), rtol=1e-6)
        np.testing.assert_allclose(slopes[i], derivative(origin)[1], rtol=1e-6)


@pytest.mark.slow
def test_batches_of_iors_equal_single_calls(ball_before_checkerboard):
    def derivative(ior):
        scene = pj.with_parameters(ball_before_checkerboard, {GLASS: ior})
        image, J = pj.jacobian(scene, [GLASS], 4)
        return image, J[GLASS], J.step[GLASS]

    iors = jnp.asarray([1.3, 1.5, 1.9])
    batched = jax.vmap(derivative)(iors)
    for i, ior in enumerate(iors):
        for a, b in zip(batched, derivative(ior), strict=True):
            # Another order of operations may turn a path at an edge.
            assert np.mean(np.abs(a[i] - b) > 1e-4 * (1 + np.abs(b))) < 2e-3


# ---- devices --------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="needs two devices")
@pytest.mark.parametrize("kind", ["colours", pytest.param("glass", marks=pytest.mark.slow)])
def test_jacobian_is_the_same_on_every_number_of_devices(plane, ball_before_checkerboard, kind):
    scene, names = (plane, [PLATE]) if kind == "colours" else (ball_before_checkerboard, [GLASS])
    wanted = {name: named.find(scene, name) for name in names}
    pixels = jnp.arange(pixel_count(scene.film), dtype=jnp.int32)
    one, all_of_them = (
        jacobian.pixel_jacobians(replace(scene, about=None), wanted, pixels, 0, 4, 1, DEFAULTS, step=0.01, **devices)
        for devices in ({"devices": 1}, {})
    )
    jax.tree.map(np.testing.assert_array_equal, one[0], all_of_them[0])
    if kind == "colours":
        jax.tree.map(np.testing.assert_array_equal, one, all_of_them)
    else:
        # XLA contracts other products in the two programs. Near grazing and critical angles float32 reflectances are
        # accurate to 2e-5, which differences divide by twice the step.
        np.testing.assert_allclose(one[1][GLASS], all_of_them[1][GLASS], atol=2e-5 / 0.02)


# ---- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "names, how, message",
    [
        (["plate.reflectanse"], {}, "plate.reflectanse.*did you mean plate.reflectance"),
        (PLATE, {}, r"write \['plate.reflectance'\]"),
        ([PLATE], {"method": "automatic"}, "method 'automatic' is unknown; use one of difference, attached"),
        ([PLATE], {"step": 0}, "step = 0"),
        ([PLATE], {"step": -0.01}, "step = -0.01"),
        ([PLATE], {"step": 1.5}, "step = 1.5"),
        ([PLATE], {"step": float("nan")}, "step = nan"),
        ([PLATE], {"strategy": "mix"}, "strategy 'mix'"),
        ([PLATE], {"spp": 0}, "spp = 0"),
        ([PLATE], {"seed": -1}, "seed = -1"),
    ],
)
def test_wrong_arguments_are_refused(plane, names, how, message):
    with pytest.raises(pj.InputError, match=message):
        pj.jacobian(plane, names, **how)


def test_bitmaps_beside_the_ior_of_glass_are_refused_by_name(stage):
    with pytest.raises(pj.InputError, match="screen.reflectance is a texture"):
        pj.jacobian(stage(), ["screen.reflectance", GLASS], step=0.01)


def test_scenes_without_names_are_refused(plane):
    with pytest.raises(pj.InputError, match="stripped of its names"):
        pj.jacobian(replace(plane, about=None), [PLATE])


def moved_camera(scene, x):
    return replace(scene, camera=replace(scene.camera, origin=scene.camera.origin + x))


def moved_plate(scene, x):
    return named.put(scene, ("geometry", "tables", 0, "frames"), scene.geometry.tables[0].frames + x)


@pytest.mark.parametrize("move, place", [(moved_camera, "camera.origin"), (moved_plate, "geometry.tables.0.frames")])
@pytest.mark.parametrize("transform", [jax.jacfwd, lambda f: jax.grad(lambda x: jnp.sum(f(x)))])
def test_derivatives_of_geometry_and_cameras_are_refused(plane, move, place, transform):
    with pytest.raises(pj.InputError, match=f"scene.{place}"):
        transform(lambda x: pj.render(move(plane, x), 1))(0.0)


# ---- at length ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_ball_before_checkerboard_in_blocks(stage, derivatives, estimate):
    """64 x 64 pixels in blocks of 8 x 8, against differences of independent images.

    With variances from 16 seeds the expected mean of z^2 is 15 / 13.
    """
    scene, step = stage(ball="", screen=SCREEN, picture="checkerboard", res=64), 0.01
    _, slopes = derivatives(scene, [GLASS], 64, 16, step=step)
    reference = rendered_difference(estimate, scene, GLASS, step, 256, 16)

    def blocks(x, power):
        return x.reshape(8, 8, 8, 8, 3).sum((1, 3)) / 64**power

    difference = blocks(slopes[GLASS].mean - reference.mean, 1)
    variance = blocks(slopes[GLASS].variance + reference.variance, 2)
    touched = variance[..., 0] > 1e-7
    assert touched.sum() > 20
    z2 = difference[touched] ** 2 / variance[touched]
    assert z2.mean() <= 1.5


@pytest.mark.slow
def test_strategies_agree_on_glass(ball_before_checkerboard, derivatives, agree):
    estimates = [
        derivatives(ball_before_checkerboard, [GLASS], 64, step=0.02, strategy=strategy, first_seed=first)
        for strategy, first in (("mis", 1), ("light", 101), ("bsdf", 201))
    ]
    for image, slopes in estimates[1:]:
        agree(image, estimates[0][0])
        agree(slopes[GLASS], estimates[0][1][GLASS])


SCENES = sorted(path.stem for folder in ("scenes", "tests/scenes") for path in (ROOT / folder).glob("*.xml"))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_colours_of_every_scene_against_differences(shipped, derivatives, agree, name):
    """Every colour of every material and light: against central differences of renders with the same seeds.

    There is no roulette, since it depends on the colours. Images are third-order polynomials in a colour. They are
    linear in a radiance or intensity, which takes a step of half its size: a light's power also changes how often it is
    chosen, and a small step changes too few choices to give a variance.
    """
    scene = without_roulette(shipped(name, res=16), 4)
    textures = [n for n in pj.parameters(scene) if named.find(scene, n).is_texture]
    names = [n for n in pj.parameters(scene) if not n.endswith("_ior") and n not in textures]
    spp, count = 16, 8
    _, slopes = derivatives(scene, names, spp, count)
    for parameter in names:
        value = np.asarray(pj.parameters(scene)[parameter])
        low, high = named.find(scene, parameter).bounds
        h = value / 2 if parameter.endswith(("radiance", "intensity")) else np.full(value.shape, 0.02)
        middle = np.clip(value, low + h, high - h)
        slope = slopes[parameter]
        if not np.array_equal(middle, value):
            # At a bound there is no room on both sides.
            _, moved_slopes = derivatives(pj.with_parameters(scene, {parameter: middle}), names, spp, count)
            slope = moved_slopes[parameter]

        def images(parameter, value):
            moved = pj.with_parameters(scene, {parameter: value})
            return np.asarray([pj.render(moved, spp, seed) for seed in range(1, count + 1)], float)

        difference = (images(parameter, middle + h) - images(parameter, middle - h)) / (2 * h)
        other = slope._replace(mean=difference.mean(0), variance=difference.var(0, ddof=1) / count)
        # Rounding of images over twice the step, and the third-order term.
        agree(slope, other, rounding=2e-3)


def test_more_dielectrics_than_one_kernel_takes(make_scene, monkeypatch):
    """Two balls, one in front of the other."""
    balls = (
        shape("sphere", f'<scale value="0.7"/><translate x="{x}" z="{z}"/>', f'<bsdf type="dielectric" id="{name}"/>')
        for name, x, z in (("front", 0, 1), ("back", 0.5, -1))
    )
    scene, names = make_scene("".join(balls) + sky(), res=8), ["front.int_ior", "back.int_ior"]
    _, together = pj.jacobian(scene, names, spp=2, step=0.02)
    monkeypatch.setattr(ior_difference, "MOST_GLASS", 1)
    _, apart = pj.jacobian(scene, names, spp=2, step=0.02)
    for name in names:
        assert np.abs(together[name]).max() > 0.01
        np.testing.assert_allclose(apart[name], together[name], atol=1e-5)
        np.testing.assert_allclose(apart.bias[name], together.bias[name], atol=1e-5)
