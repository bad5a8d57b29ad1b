"""What each bsdf samples has its density and weight; energy, reciprocity, Snell's law; textures against NumPy."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pathjax import bsdfs
from pathjax import description as desc
from pathjax.bsdfs import conductor, dielectric, diffuse
from pathjax.bsdfs.builder import _textures, build_materials
from pathjax.bsdfs.conductor import ConductorTable
from pathjax.bsdfs.dielectric import DielectricTable
from pathjax.bsdfs.diffuse import DiffuseTable
from pathjax.textures import texture

# Chance that a correct bsdf fails one of the statistical tests here; seeds are fixed.
FALSE_ALARM = 1e-4
ALBEDO = np.array([[0.9, 0.5, 0.1], [1.0, 0.0, 0.3]], np.float32)
WHITE = DiffuseTable(jnp.asarray(ALBEDO), None, None)
UV = jnp.zeros(2)
SURFACE = SimpleNamespace(uv=UV)


def uniform(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).integers(0, 1 << 24, shape) * 2.0**-24, jnp.float32)


def directions(n, seed=2, upper=True):
    w = np.random.default_rng(seed).normal(size=(n, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    w[:, 2] = np.abs(w[:, 2]) if upper else w[:, 2]
    return jnp.asarray(w, jnp.float32)


@partial(jax.jit, static_argnames="sample")
def _draw(sample, table, row, wi, u):
    return jax.vmap(lambda wi, u: sample(table, row, UV, wi, u))(wi, u)


def draw(sample, table, wi, u, row=0):
    drawn = _draw(sample, table, row, wi, u)
    return jax.tree.map(lambda x: np.asarray(x, np.float64) if x.dtype != bool else np.asarray(x), drawn)


# ---- diffuse --------------------------------------------------------------------------------------------------------


def test_diffuse_samples_have_the_stated_density():
    n = 400_000
    drawn = draw(diffuse.sample, WHITE, directions(n), uniform(n, 2))
    edges = np.linspace(0, 1, 13)
    phi = np.arctan2(drawn.wo[:, 1], drawn.wo[:, 0]) / (2 * np.pi) % 1
    counts = np.histogram2d(drawn.wo[:, 2], phi, [edges, np.linspace(0, 1, 17)])[0]
    # The pdf is linear in z, so its integral over a cell is its value in the middle.
    middle = (edges[1:] + edges[:-1]) / 2
    wo = jnp.asarray(np.stack([np.sqrt(1 - middle**2), 0 * middle, middle], -1), jnp.float32)
    pdf = np.asarray(jax.vmap(lambda wo: diffuse.evaluate(WHITE, 0, UV, wo, wo)[1])(wo), np.float64)
    expected = n * np.repeat((pdf * np.diff(edges) * 2 * np.pi / 16)[:, None], 16, 1)
    assert stats.chisquare(counts.ravel(), expected.ravel() * counts.sum() / expected.sum()).pvalue > FALSE_ALARM
    assert expected.sum() == pytest.approx(n, rel=1e-5)


def test_diffuse_weight_is_value_over_density():
    wi = directions(1000)
    drawn = draw(diffuse.sample, WHITE, wi, uniform(1000, 2), row=1)
    f, pdf = jax.vmap(lambda wi, wo: diffuse.evaluate(WHITE, 1, UV, wi, wo))(wi, jnp.asarray(drawn.wo, jnp.float32))
    np.testing.assert_allclose(drawn.pdf, pdf, rtol=1e-6)
    np.testing.assert_allclose(drawn.weight * drawn.pdf[:, None], f, rtol=1e-6)
    assert not drawn.delta.any() and (drawn.passive == 1).all()


def test_diffuse_is_reciprocal():
    a, b = directions(500, 3), directions(500, 4)
    f = jax.vmap(lambda wi, wo: diffuse.evaluate(WHITE, 0, UV, wi, wo)[0] / wo[2])
    np.testing.assert_allclose(f(a, b), f(b, a), rtol=1e-6)


def test_diffuse_white_furnace_returns_the_albedo():
    # Midpoints in z and azimuth: exact for the linear integrand.
    z = (np.arange(64) + 0.5) / 64
    wo = jnp.asarray(np.stack([np.sqrt(1 - z**2), 0 * z, z], -1), jnp.float32)
    for row in (0, 1):
        f = np.asarray(jax.vmap(lambda wo, row=row: diffuse.evaluate(WHITE, row, UV, wo, wo)[0])(wo), np.float64)
        np.testing.assert_allclose(f.mean(0) * 2 * np.pi, ALBEDO[row], rtol=1e-6)


def test_diffuse_is_black_below_the_surface():
    up = jnp.array([0.6, 0.0, 0.8])
    f, pdf = diffuse.evaluate(WHITE, 0, UV, up, -up)
    assert not f.any() and pdf == 0


def test_diffuse_derivative_in_the_albedo_is_right_at_zero():
    up = jnp.array([0.6, 0.0, 0.8])

    def of(albedo):
        table = DiffuseTable(albedo[None], None, None)
        return diffuse.sample(table, 0, UV, up, jnp.array([0.2, 0.3])).weight

    np.testing.assert_array_equal(jax.jacfwd(of)(jnp.zeros(3)), np.eye(3))


# ---- dielectric -----------------------------------------------------------------------------------------------------

GLASS = DielectricTable(jnp.array([1.5, 1.0, 1.33]), jnp.array([1.0, 1.0, 1.5]))


def test_dielectric_reflects_as_often_as_fresnel_says():
    n = 100_000
    for row, cos in ((0, 0.9), (0, 0.1), (0, -0.8), (2, 0.6), (2, -0.3)):
        wi = jnp.broadcast_to(jnp.array([np.sqrt(1 - cos**2), 0, cos], jnp.float32), (n, 3))
        drawn = draw(dielectric.sample, GLASS, wi, uniform(n, 2, seed=row + 10), row)
        reflected = drawn.wo[:, 2] * cos > 0
        pdf = drawn.pdf[reflected]
        assert len(np.unique(pdf)) == 1 and drawn.delta.all()
        assert stats.binomtest(int(reflected.sum()), n, float(pdf[0])).pvalue > FALSE_ALARM
        np.testing.assert_allclose(drawn.pdf[~reflected], 1 - pdf[0], rtol=1e-6)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_dielectric_obeys_snell_and_scales_radiance(row):
    n = 20_000
    wi = directions(n, upper=False)
    drawn = draw(dielectric.sample, GLASS, wi, uniform(n, 2), row)
    wi = np.asarray(wi, np.float64)
    np.testing.assert_allclose(np.linalg.norm(drawn.wo, axis=1), 1, atol=2e-6)
    reflected = drawn.wo[:, 2] * wi[:, 2] > 0
    np.testing.assert_array_equal(drawn.wo[reflected], wi[reflected] * [-1, -1, 1])
    assert (drawn.weight[reflected] == 1).all() and (drawn.passive[reflected] == 1).all()

    eta = float(GLASS.int_ior[row] / GLASS.ext_ior[row]) ** np.where(wi[:, 2] > 0, 1.0, -1.0)[~reflected]
    np.testing.assert_allclose(drawn.wo[~reflected, :2] * eta[:, None], -wi[~reflected, :2], atol=1e-6)
    np.testing.assert_allclose(drawn.weight[~reflected], np.repeat(1 / eta[:, None] ** 2, 3, 1), rtol=1e-6)
    np.testing.assert_allclose(drawn.passive[~reflected], 1 / eta**2, rtol=1e-6)
    assert reflected.any() == (row != 1)


def test_dielectric_reflects_totally_beyond_the_critical_angle():
    cos = np.linspace(-np.sqrt(1 - 1 / 1.5**2) + 1e-4, 0, 1000)
    wi = jnp.asarray(np.stack([np.sqrt(1 - cos**2), 0 * cos, cos], -1), jnp.float32)
    drawn = draw(dielectric.sample, GLASS, wi, jnp.full((1000, 2), 1 - 2**-24, jnp.float32))
    np.testing.assert_array_equal(drawn.wo, np.asarray(wi) * [-1, -1, 1])
    assert (drawn.weight == 1).all() and (drawn.pdf == 1).all()


def test_dielectric_of_equal_media_is_invisible_at_any_angle():
    cos = np.geomspace(1e-4, 1, 1000)
    wi = jnp.asarray(np.stack([np.sqrt(1 - cos**2), 0 * cos, cos], -1), jnp.float32)
    drawn = draw(dielectric.sample, GLASS, wi, uniform(1000, 2), row=1)
    np.testing.assert_allclose(drawn.wo, -np.asarray(wi, np.float64), atol=2e-6)


def test_dielectric_returns_all_energy():
    """Weight, times eta^2 where refracted, is the share of power: what is sampled carries 1 in each case."""
    wi = directions(10_000, upper=False)
    drawn = draw(dielectric.sample, GLASS, wi, uniform(10_000, 2))
    z = np.asarray(wi)[:, 2]
    eta = np.where(drawn.wo[:, 2] * z > 0, 1, np.where(z > 0, 1.5, 1 / 1.5))
    np.testing.assert_allclose(drawn.weight * eta[:, None] ** 2, 1, rtol=1e-6)


@pytest.mark.parametrize("fresnel", bsdfs.FRESNEL)
@pytest.mark.parametrize("row", [0, 1, 2])
def test_dielectric_and_its_other_branch_share_the_light(row, fresnel):
    """One reflects and one refracts; what cannot be drawn has pdf 0."""
    glass, n = replace(GLASS, fresnel=fresnel), 10_000
    wi, u = directions(n, upper=False), uniform(n, 2)
    drawn = draw(dielectric.sample, glass, wi, u, row)
    other = draw(partial(dielectric.sample, other=True), glass, wi, u, row)
    z = np.asarray(wi)[:, 2]
    eta = float(GLASS.int_ior[row] / GLASS.ext_ior[row]) ** np.sign(z)
    power = [b.pdf * b.weight[:, 0] * np.where(b.wo[:, 2] * z > 0, 1, eta**2) for b in (drawn, other)]
    np.testing.assert_allclose(sum(power), 1, atol=1e-6)
    possible = other.pdf > 0
    assert ((drawn.wo[:, 2] * other.wo[:, 2] < 0) | ~possible).all()
    assert possible.any() == (row != 1 or fresnel == "schlick")


def test_no_numbers_at_the_ends_are_not_finite():
    ends = [0.0, 1 - 2**-24]
    u = jnp.array([[a, b] for a in ends for b in ends])
    grazing = [[1, 0, z] for z in (0.0, -0.0, 1e-20, -1e-20, 1e-4)]
    cases = [[0, 0, 1], [0, 0, -1], [0.8, 0, -0.6], *grazing]
    metal = ConductorTable(jnp.ones((1, 3)), jnp.full((1, 3), 0.2), jnp.full((1, 3), 3.0), jnp.array([False]))
    for module, table in ((diffuse, WHITE), (dielectric, GLASS), (conductor, metal)):
        for wi in cases:
            drawn = draw(module.sample, table, jnp.broadcast_to(jnp.array(wi), (4, 3)), u)
            assert all(np.isfinite(x).all() for x in drawn)
            assert (drawn.pdf >= 0).all() and (drawn.weight >= 0).all()


# ---- conductor ------------------------------------------------------------------------------------------------------


def test_conductor_mirrors_and_weighs_by_fresnel():
    eta, k = np.array([0.2, 0.9, 1.1]), np.array([3.9, 2.4, 2.1])
    table = ConductorTable(
        jnp.array([[1.0, 1, 1], [0.9, 0.8, 0.7]]),
        jnp.asarray(np.stack([eta, np.ones(3)]), jnp.float32),
        jnp.asarray(np.stack([k, np.ones(3)]), jnp.float32),
        jnp.array([False, True]),
    )
    wi = directions(1000)
    drawn = draw(conductor.sample, table, wi, uniform(1000, 2))
    np.testing.assert_array_equal(drawn.wo, np.asarray(wi) * [-1, -1, 1])
    n, cos = eta + 1j * k, np.asarray(wi, np.float64)[:, 2:]
    cos_t = np.sqrt(1 - (1 - cos**2) / n**2)
    r = (abs((cos - n * cos_t) / (cos + n * cos_t)) ** 2 + abs((n * cos - cos_t) / (n * cos + cos_t)) ** 2) / 2
    np.testing.assert_allclose(drawn.weight, r, atol=3e-6)
    assert drawn.delta.all() and (drawn.pdf == 1).all() and (drawn.weight <= 1 + 1e-6).all()
    ideal = draw(conductor.sample, table, wi, uniform(1000, 2), row=1)
    np.testing.assert_allclose(ideal.weight, np.broadcast_to([0.9, 0.8, 0.7], (1000, 3)), rtol=1e-6)


# ---- textures -------------------------------------------------------------------------------------------------------


def bitmap(h, w, seed=0, to_uv=None, **how):
    texels = np.random.default_rng(seed).random((h, w, 3)).astype(np.float32)
    return desc.Bitmap(f"b{seed}", texels, np.eye(3) if to_uv is None else to_uv, **how)


def checkerboard(to_uv=None):
    to_uv = np.eye(3) if to_uv is None else to_uv
    return desc.Checkerboard("c", np.array([0.1, 0.2, 0.3]), np.array([0.9, 0.8, 0.7]), to_uv)


def wrapped(i, n, wrap):
    if wrap == "repeat":
        return i % n
    if wrap == "clamp":
        return np.clip(i, 0, n - 1)
    i = i % (2 * n)
    return np.where(i < n, i, 2 * n - 1 - i)


def reference(tex, uv):
    """(N, 2) -> (N, 3), float64."""
    uv = (np.c_[uv, np.ones(len(uv))] @ tex.to_uv.T)[:, :2]
    if isinstance(tex, desc.Checkerboard):
        odd = uv - np.floor(uv) > 0.5
        return np.where((odd[:, 0] == odd[:, 1])[:, None], tex.color0, tex.color1)
    h, w, _ = tex.texels.shape
    x, y = uv[:, 0] * w, uv[:, 1] * h

    def texel(j, i):
        return tex.texels[wrapped(i.astype(int), h, tex.wrap), wrapped(j.astype(int), w, tex.wrap)].astype(float)

    if tex.interpolation == "nearest":
        return texel(np.floor(x), np.floor(y))
    x, y = x - 0.5, y - 0.5
    j, i = np.floor(x), np.floor(y)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    top = texel(j, i) * (1 - fx) + texel(j + 1, i) * fx
    bottom = texel(j, i + 1) * (1 - fx) + texel(j + 1, i + 1) * fx
    return top * (1 - fy) + bottom * fy


def lookup_all(textures, uv):
    table = _textures(textures, jnp.float32, {}, ())
    rows = jnp.arange(len(textures))
    look = jax.vmap(jax.vmap(lambda row, uv: texture.lookup(table, row, uv), (None, 0)), (0, None))
    return np.asarray(jax.jit(look)(rows, jnp.asarray(uv, jnp.float32)))


def random_uv(n=5000):
    """Points in and around the unit square, none within float32 rounding of a texel's border."""
    uv = np.random.default_rng(3).uniform(-3, 3, (n, 2))
    return (np.floor(uv * 420) + 0.5) / 420


TO_UV = np.array([[2.0, 0.5, 0.25], [-0.5, 3.0, -0.125], [0, 0, 1]])


def test_bitmaps_are_those_of_numpy():
    """All wraps and both interpolations beside each other in one table, images of different sizes."""
    kinds = [(i, w) for i in ("bilinear", "nearest") for w in texture.WRAPS]
    textures = [bitmap(3 + k, 7 - k, k, interpolation=i, wrap=w) for k, (i, w) in enumerate(kinds)]
    uv = random_uv()
    found = lookup_all(textures, uv)
    for tex, colors in zip(textures, found, strict=True):
        # Fractions of a texel are rounded at |uv| < 3 times a size of 8.
        tolerance = 1e-5
        wrong = np.abs(colors - reference(tex, uv)).max(1) > tolerance
        if tex.interpolation == "nearest":
            size = np.array(tex.texels.shape[1::-1])
            place = np.float64(np.float32(uv)) * size
            wrong &= np.abs(place - np.round(place)).min(1) > 1e-5  # on a border either side is right
        assert not wrong.any(), (tex.interpolation, tex.wrap, uv[wrong][:3])


def test_to_uv_is_applied_before_the_look_up():
    textures = [bitmap(4, 5, to_uv=TO_UV), checkerboard(TO_UV)]
    uv = np.random.default_rng(5).uniform(-2, 2, (5000, 2))
    place = (np.c_[uv, np.ones(len(uv))] @ TO_UV.T)[:, :2] * 2
    clear = np.abs(place - np.round(place)).min(1) > 1e-4  # of the checkerboard's borders
    for tex, colors in zip(textures, lookup_all(textures, uv), strict=True):
        np.testing.assert_allclose(colors[clear], reference(tex, uv)[clear], atol=2e-5)


def test_checkerboard_starts_with_color0_and_repeats():
    colors = lookup_all([checkerboard()], [[0.2, 0.2], [0.7, 0.2], [0.2, 0.7], [0.7, 0.7], [-0.2, 0.2], [1.2, 5.2]])[0]
    np.testing.assert_allclose(colors[:, 0], np.float32([0.1, 0.9, 0.9, 0.1, 0.9, 0.1]))


def test_bilinear_derivative_in_uv_is_the_slope():
    table = _textures([bitmap(4, 4)], jnp.float32, {}, ())
    uv = jnp.array([0.4, 0.55])
    slope = jax.jit(jax.jacfwd(lambda uv: texture.lookup(table, 0, uv)))(uv)
    h = 1e-3
    ends = [reference(bitmap(4, 4), np.float64(uv)[None] + s * h * e)[0] for e in np.eye(2) for s in (1, -1)]
    numeric = np.stack([(ends[0] - ends[1]), (ends[2] - ends[3])], -1) / (2 * h)
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["checkerboard", "bilinear", "nearest"])
def test_textures_are_those_of_mitsuba(kind):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    transform = mi.ScalarTransform3f(TO_UV)
    if kind == "checkerboard":
        ours, more = checkerboard(TO_UV), {"color0": color([0.1, 0.2, 0.3]), "color1": color([0.9, 0.8, 0.7])}
    else:
        ours = bitmap(4, 6, to_uv=TO_UV, interpolation=kind, wrap="mirror")
        image = mi.Bitmap(ours.texels)
        more = {"bitmap": image, "raw": True, "filter_type": kind, "wrap_mode": "mirror"}
    theirs = mi.load_dict({"type": "checkerboard" if kind == "checkerboard" else "bitmap", "to_uv": transform, **more})
    uv = np.random.default_rng(7).random((300, 2))
    place = (np.c_[uv, np.ones(len(uv))] @ TO_UV.T)[:, :2] * np.array([12, 12])  # every border of the three
    uv = uv[np.abs(place - np.round(place)).min(1) > 1e-3]
    si = mi.SurfaceInteraction3f()
    expected = []
    for u, v in uv:
        si.uv = [u, v]
        expected.append(np.asarray(theirs.eval(si)).ravel())
    np.testing.assert_allclose(lookup_all([ours], uv)[0], expected, atol=2e-5)


def color(rgb):
    return {"type": "rgb", "value": rgb}


# ---- dispatch -------------------------------------------------------------------------------------------------------


def test_sides_of_a_shape_are_told_apart():
    red = desc.Diffuse("red", np.array([1.0, 0, 0]))
    green = desc.Diffuse("green", np.array([0, 1.0, 0]))
    mirror = desc.Conductor("mirror", None, None, np.array([0.5, 0.6, 0.7]))
    glass = desc.Dielectric("glass", 1.5, 1.0)

    class Holder:
        shapes = [
            desc.Shape("", desc.Rectangle(np.eye(4)), bsdf, None, "", False)
            for bsdf in (red, desc.Twosided("t", red, green), desc.Twosided("u", mirror, red), glass)
        ]

    materials = build_materials(Holder, jnp.float32, {})
    wi, u = jnp.array([0.6, 0, 0.8]), jnp.array([0.999, 0.3])

    @jax.jit
    def draw_side(shape, front):
        kind, row = bsdfs.select(materials, shape, front)
        drawn = bsdfs.sample(materials, kind, row, SURFACE, wi, u)
        return kind, drawn, bsdfs.has(materials, kind, "smooth"), bsdfs.has(materials, kind, "sided")

    def weight(shape, front):
        kind, drawn, smooth, _ = draw_side(shape, front)
        return int(kind), np.asarray(drawn.weight), bool(smooth)

    np.testing.assert_array_equal(weight(0, True)[1], [1, 0, 0])
    assert weight(0, False)[0] == -1  # one-sided: absorbs
    np.testing.assert_array_equal(weight(1, False)[1], [0, 1, 0])
    np.testing.assert_allclose(weight(2, True)[1], [0.5, 0.6, 0.7])
    assert weight(2, True)[2] is False and weight(2, False)[2] is True
    for front in (True, False):
        _, drawn, _, glass = draw_side(3, front)
        assert glass
        np.testing.assert_allclose(drawn.weight, 1 / 1.5**2, rtol=1e-6)
