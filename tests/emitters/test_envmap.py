"""Environment maps: against closed forms, samples against densities, and images against Mitsuba's."""

import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import pathjax as pj
from pathjax import emitters, transport
from pathjax.emitters import Envmap, envmap
from pathjax.images import write_exr
from pathjax.kinds import Parameters, Row

ROOT = Path(__file__).resolve().parents[2]
FALSE_ALARM = 1e-4
TURN = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/></transform>
  <bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf></shape>"""
ALBEDO = np.array([0.2, 0.5, 0.8])
BALLS = """<shape type="sphere"><point name="center" x="-1" y="0.8" z="0"/><float name="radius" value="0.8"/>
    <bsdf type="conductor"/></shape>
  <shape type="sphere"><point name="center" x="1" y="0.8" z="0"/><float name="radius" value="0.8"/></shape>
  <shape type="sphere"><point name="center" x="0.2" y="0.5" z="1.5"/><float name="radius" value="0.5"/>
    <bsdf type="dielectric"/></shape>"""
VIEW = {"origin": "0.5, 2, 5", "target": "0, 0.5, 0"}
LARGE = 33, 64  # texels of images above the floor: with films 8 pixels wide, all are rendered by one kernel


def picture(height, width, seed=0, hot=()):
    """Return random texels (H, W, 3); those in `hot` are a thousand times as bright."""
    texels = np.random.default_rng(seed).uniform(0.1, 1, (height, width, 3)).astype(np.float32)
    for place in hot:
        texels[place] *= 1000
    return texels


PICTURES = {
    "usual": picture(16, 32),
    "odd": picture(7, 13),
    "flat": picture(1, 5),
    "narrow": picture(6, 1),
    "two": picture(2, 3),
    "small": picture(3, 2),
    "one": picture(1, 1),
    "hot": picture(31, 60, hot=[(9, 22)]),
    "zenith": picture(31, 60, hot=[0]),
    "nadir": picture(32, 60, hot=[-1, (15, 59)]),
    "partly black": np.where(np.arange(24)[:, None, None] % 5 < 2, picture(24, 30), 0),
    "black": np.zeros((5, 6, 3), np.float32),
}


def row(texels, dtype=np.float32, **values):
    made = Envmap.build([Envmap.instance("sky", texels=texels, **values)], dtype, (), Parameters(), None)
    return Row(jax.device_put(made), 0)


def directions(count, seed=1):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def place(d, height, width):
    """Return rows and columns (N,) of directions (N, 3), in texels, whose centres are at whole numbers."""
    y = np.arctan2(np.hypot(d[:, 0], d[:, 2]), d[:, 1]) / np.pi * (height - 1)
    return y, np.arctan2(d[:, 0], -d[:, 2]) / (2 * np.pi) % 1 * width - 0.5


def interpolated(texels, d):
    height, width, _ = texels.shape
    if height == 1:
        return interpolated(np.repeat(texels, 2, 0), d)
    y, x = place(d, height, width)
    total = 0
    for j in (0, 1):
        for i in (0, 1):
            low, left = np.minimum(np.floor(y), height - 2), np.floor(x)
            weight = (1 - abs(y - low - j)) * (1 - abs(x - left - i))
            total = total + weight[:, None] * texels[(low + j).astype(int), (left + i).astype(int) % width]
    return total


@jax.jit
def drawn(p, u):
    return jax.vmap(lambda u: Envmap.sample(Row(p, 0), u[:2], u[2]))(u)


@jax.jit
def seen(p, d):
    return jax.vmap(lambda d: (Envmap.emitted(Row(p, 0), d), Envmap.density(Row(p, 0), d)))(d)


# ---- one picture ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PICTURES)
def test_radiance_is_bilinear_between_texels(name):
    texels, d = PICTURES[name], directions(2000)
    p = row(texels, scale=2.0, to_world=TURN)
    radiance, _ = seen(p._table, jnp.asarray(d, jnp.float32))
    # The rounding of an angle, times the largest slope.
    rounding = 1e-6 * max(texels.shape[:2]) * texels.max()
    np.testing.assert_allclose(radiance, 2 * interpolated(texels, d @ TURN), rtol=1e-5, atol=rounding)


@pytest.mark.parametrize("name", PICTURES)
def test_directions_are_drawn_by_their_density(name):
    """Chi-square over those quarters of patches that are expected to hold 10 samples or more."""
    texels, count = PICTURES[name], 100_000
    height, width = max(len(texels), 2), texels.shape[1]
    p = row(texels)
    u = np.random.default_rng(3).integers(0, 1 << 23, (count, 3)) * 2.0**-23 + 2.0**-24
    d = np.asarray(drawn(p._table, jnp.asarray(u, jnp.float32)), float)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-6)
    # Quarters of equal solid angle: the density is bilinear, so its mean over a quarter is its value in the middle.
    cos = np.cos(np.linspace(0, np.pi, height))
    cos = np.append(np.stack([cos[:-1], (cos[:-1] + cos[1:]) / 2], 1).ravel(), -1)
    _, x = place(d, height, width)
    y = np.searchsorted(-cos, -d[:, 1], side="right") - 1
    found = np.zeros((2 * (height - 1), 2 * width))
    np.add.at(found, (np.clip(y, 0, 2 * height - 3), np.floor(2 * x).astype(int) % (2 * width)), 1)
    middle, phi = (cos[:-1] + cos[1:])[:, None] / 2, (np.arange(2 * width) / 2 + 0.75) / width * 2 * np.pi
    radius = np.sqrt(1 - middle**2)
    toward = np.stack(np.broadcast_arrays(radius * np.sin(phi), middle, -radius * np.cos(phi)), -1)
    _, density = seen(p._table, jnp.asarray(toward.reshape(-1, 3), jnp.float32))
    expected = np.asarray(density, float).reshape(found.shape) * -np.diff(cos)[:, None] * (np.pi / width)
    np.testing.assert_allclose(expected.sum(), 1, rtol=1e-5)
    expected = expected * count
    many = expected >= 10
    found, expected = (np.append(each[many], each[~many].sum()) for each in (found, expected))
    used = expected > 0
    assert not found[~used].any()
    if used.sum() > 1:
        chance = stats.chi2.sf(((found - expected)[used] ** 2 / expected[used]).sum(), used.sum() - 1)
        assert chance > FALSE_ALARM


def test_tabled_probabilities_are_those_of_random_numbers():
    """Random numbers are odd multiples of 2^-24, and each patch gets exactly its probability's share of them."""
    made = row(picture(8, 300, hot=[(3, 7)]))
    for cdf in (made.rows, *made.columns.reshape(7, 301)):
        steps = np.asarray(cdf, float) * 2**23
        assert steps[0] == 0 and steps[-1] == 2**23 and (steps == np.rint(steps)).all() and (np.diff(steps) > 0).all()


def test_density_follows_what_is_above_the_mean():
    """Or 1/20 of the luminance where that is more. The test compares means over patches and values within patches."""
    texels = picture(9, 12, hot=[(4, 3)])
    texels[4, 3] /= 100
    p = row(texels)
    shine = texels @ [0.2126, 0.7152, 0.0722]
    kept = np.maximum(shine - float(p.brightness), shine / 20)
    grid, ratios = (np.arange(200) + 0.5) / 200, []
    for y in (2, 3, 4, 5):
        theta, phi = (y + grid) / 8 * np.pi, (2.5 + 1 + grid) / 12 * 2 * np.pi
        t, f = (x.ravel() for x in np.meshgrid(theta, phi, indexing="ij"))
        d = np.stack([np.sin(t) * np.sin(f), np.cos(t), -np.sin(t) * np.cos(f)], -1)
        weights = np.sin(t) / np.sin(t).sum()
        density = np.asarray(seen(p._table, jnp.asarray(d, jnp.float32))[1], float)
        wanted = interpolated(np.repeat(kept[..., None], 3, -1), d)[:, 0]
        ratios.append(weights @ density / (weights @ wanted))
        # 1/16 of the mean is added to it; and interpolation in cosines, not angles, changes rows this broad by 0.1.
        follows = (16 * wanted + weights @ wanted) / 17
        np.testing.assert_allclose(density / ratios[-1], follows, atol=0.1 * wanted.max())
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-3)


def test_black_texels_are_looked_at_beside_bright_ones():
    """So that derivatives in the light of black texels have bounded weights."""
    texels = np.zeros((9, 12, 3), np.float32)
    texels[4, 3] = 1
    t, f = np.array([4 - 1e-3, 5 - 1e-3]) / 8 * np.pi, np.full(2, (3 - 1e-3 + 0.5) / 12 * 2 * np.pi)
    d = np.stack([np.sin(t) * np.sin(f), np.cos(t), -np.sin(t) * np.cos(f)], -1)
    _, (beside, far) = (np.asarray(x) for x in seen(row(texels)._table, jnp.asarray(d, jnp.float32)))
    assert far == pytest.approx(beside / (4 * 16 + 1), rel=0.1)


@pytest.mark.parametrize("ends", [(1.0, 1.0), (0.0, 2.0), (3.0, 0.0), (0.2, 1.8), (0.0, 0.0), (1e30, 2e30)])
def test_straight_densities_are_drawn_by_their_inverse(ends):
    first, last = (jnp.float32(end) for end in ends)
    u = jnp.asarray((np.arange(1000) + 0.5) / 1000, jnp.float32)
    x = np.asarray(jax.vmap(lambda u: envmap._drawn(first, last, u))(u), float)
    a, b = (end / sum(ends) if sum(ends) else 0.5 for end in ends)
    np.testing.assert_allclose(2 * a * x + (b - a) * x**2, u, atol=1e-6)


def test_brightness_is_the_mean_over_the_sphere():
    d = directions(200_000)
    radiance = interpolated(PICTURES["usual"], d) @ [0.2126, 0.7152, 0.0722]
    error = radiance.std() / np.sqrt(len(d))
    assert abs(row(PICTURES["usual"]).brightness - radiance.mean()) < 4 * error


@pytest.mark.parametrize("name", ["zenith", "nadir", "odd", "one", "black"])
def test_nothing_is_nan_at_poles_and_seams(name):
    p = row(PICTURES[name])
    edges = [(0, 1, 0), (0, -1, 0), (0, 0, -1), (1e-30, 0, -1), (-1e-30, 1, 0), (0, 0, 1), (1, 0, 0), (1e-20, 1, 1e-20)]
    d = jnp.asarray(edges, jnp.float32)
    (radiance, density), (slope, _) = jax.jvp(lambda d: seen(p._table, d), [d], [jnp.ones_like(d)])
    assert np.isfinite(radiance).all() and np.isfinite(density).all() and np.isfinite(slope).all()
    ends = jnp.asarray([(a, b, 0.5) for a in (0, 2**-24, 1 - 2**-24) for b in (0, 2**-24, 1 - 2**-24)], jnp.float32)
    ends = drawn(p._table, ends)
    _, density = seen(p._table, ends)
    assert np.isfinite(ends).all() and np.isfinite(density).all() and (density > 0).all()


def test_double_precision(x64):
    with x64():
        texels, d = picture(7, 13), directions(500)
        radiance, density = seen(row(texels, np.float64, to_world=TURN)._table, jnp.asarray(d))
        assert radiance.dtype == density.dtype == jnp.float64
        np.testing.assert_allclose(radiance, interpolated(texels.astype(float), d @ TURN), rtol=1e-12)


# ---- images of scenes -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """(texels, inside) -> element of an emitter that reads them from a file."""
    folder = tmp_path_factory.mktemp("skies")
    numbers = iter(range(1000))

    def element(texels, inside="", name="sky"):
        file = folder / f"{next(numbers)}.exr"
        write_exr(file, {channel: texels[..., k] for k, channel in enumerate("RGB")}, {})
        return f'<emitter type="envmap" id="{name}"><string name="filename" value="{file}"/>{inside}</emitter>'

    return element


SCALE = '<float name="scale" value="0.5"/>'
PLACED = '<transform name="to_world"><rotate x="1" angle="90"/><rotate y="0.6" z="0.8" angle="35"/></transform>'


@pytest.mark.slow
def test_an_even_picture_is_a_constant_background(make_scene, sky, estimate, agree):
    constant = '<emitter type="constant"><rgb name="radiance" value="1, 2, 3"/></emitter>'
    lights = sky(np.full((5, 9, 3), [1, 2, 3], np.float32)), constant
    even, constant = (make_scene(FLOOR + BALLS + light, **VIEW) for light in lights)
    agree(estimate(even, 64), estimate(constant, 64, first_seed=100))


@pytest.mark.parametrize("strategy", ["mis", pytest.param("light", marks=pytest.mark.slow)])
def test_a_bright_texel_lights_a_floor(make_scene, sky, estimate, agree, strategy):
    """It is a tent, two patches wide in azimuth and polar angle, whose integral weighted by sin cos is known."""
    texels = np.zeros((*LARGE, 3), np.float32)
    texels[10, 37] = [3000, 1000, 500]
    theta, step = 10 * np.pi / 32, np.pi / 32
    irradiance = texels[10, 37] * (2 * np.pi / 64) * step * (np.sin(step) / step) ** 2 * np.sin(2 * theta) / 2
    scene = make_scene(FLOOR + sky(texels), origin="0.1, 2, 0.1", fov=10, res=8, depth=2)
    agree(estimate(scene, 256, strategy=strategy), ALBEDO / np.pi * irradiance, pixelwise=False)


def test_images_are_linear_in_the_scale(make_scene, sky):
    scene = make_scene(FLOOR + sky(picture(16, 32), SCALE), res=8, depth=2, **VIEW)
    assert "sky.scale" in pj.parameters(scene)
    image, J = pj.jacobian(scene, ["sky.scale"], 16)
    np.testing.assert_allclose(np.asarray(J["sky.scale"]) * 0.5, image, rtol=1e-5)
    doubled, _ = pj.jacobian(pj.with_parameters(scene, {"sky.scale": 1.0}), ["sky.scale"], 16)
    np.testing.assert_allclose(doubled, 2 * np.asarray(image), rtol=1e-5)


def test_texels_are_a_parameter(make_scene, sky):
    """New texels, traced or not, are sampled as those of a file are; the image is linear in them."""
    old, new = picture(*LARGE), picture(*LARGE, seed=5, hot=[(1, 2)])
    scene = make_scene(FLOOR + sky(old, name="texels"), **VIEW, res=8)
    read = make_scene(FLOOR + sky(new, name="texels"), **VIEW, res=8)
    for key in Envmap.declared:
        both = pj.with_parameters(scene, {"texels.radiance": new}), read
        mine, theirs = (each.emitters[0].table.column(key) for each in both)
        assert mine is theirs is None or np.array_equal(mine.values, theirs.values)

    def image(texels):
        return pj.render(pj.with_parameters(scene, {"texels.radiance": texels}), 4)

    seen, pull = jax.jit(lambda texels: (lambda image, pull: (image, pull(image)[0]))(*jax.vjp(image, texels)))(new)
    np.testing.assert_allclose(seen, pj.render(read, 4), rtol=1e-6)
    assert pull.shape == new.shape and (pull >= 0).all()
    np.testing.assert_allclose((pull * new).sum(), (np.asarray(seen, float) ** 2).sum(), rtol=1e-5)
    with pytest.raises(pj.InputError, match=r"\(33, 64, 3\), and cannot be set to 64 x 33 x 3"):
        pj.with_parameters(scene, {"texels.radiance": np.ones((64, 33, 3))})
    with pytest.raises(pj.InputError, match=r"outside its bounds \[0, inf\]"):
        pj.with_parameters(scene, {"texels.radiance": -new})


def test_terms_first_hits_and_hidden_emitters(make_scene, sky):
    light = sky(picture(16, 32))
    shown, hidden = (make_scene(FLOOR + light, res=16, hide=hide, **VIEW) for hide in ("false", "true"))
    above = np.s_[:2]
    assert not np.asarray(pj.render(hidden, 4))[above].any() and np.asarray(pj.render(hidden, 4))[8:].any()
    terms = np.asarray(pj.render_bounces(shown, 3, 4).terms)
    assert terms[0][above].min() > 0 and not terms[1:][:, above].any() and terms[1].any()
    assert pj.render_aovs(shown, ["normal"])["normal"].shape == (16, 16, 3)
    with pytest.raises(pj.InputError, match="envmap emitter; patches hold the light of surfaces alone"):
        transport.operator(shown)


@pytest.mark.slow
def test_it_adds_to_other_lights(make_scene, sky, estimate, agree):
    texels = picture(16, 32, hot=[(3, 4)])
    others = """<emitter type="constant"><rgb name="radiance" value="0.2, 0.1, 0.3"/></emitter>
      <emitter type="point"><point name="position" x="0" y="3" z="1"/></emitter>"""
    both, one, other = (make_scene(FLOOR + light, res=8, depth=3, **VIEW)
                        for light in (sky(texels) + others, sky(texels), others))  # fmt: skip
    parts = [estimate(each, 64, first_seed=seed) for seed, each in ((50, one), (100, other))]
    total = type(parts[0])(parts[0].mean + parts[1].mean, parts[0].variance + parts[1].variance, parts[0].count)
    agree(estimate(both, 64), total)


# ---- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [np.inf, -np.inf, np.nan])
def test_what_is_not_finite_is_refused(make_scene, sky, wrong):
    texels = picture(4, 6)
    texels[2, 5, 1] = wrong
    with pytest.raises(pj.InputError, match=r"scene\d+.xml:\d+: .*texel \(5, 2\); radiance must be finite"):
        make_scene(FLOOR + sky(texels))


def test_negative_radiance_is_taken_as_none_and_told(make_scene, sky):
    texels = picture(4, 6)
    texels[2, 5] = -0.01
    scene = make_scene(FLOOR + sky(texels))
    notes = scene.about.description.notes
    assert any("1 texels of negative radiance, down to -0.01, which is taken as 0" in note for note in notes)
    assert scene.emitters[0].parameters(0).texels.min() == 0


@pytest.mark.parametrize(
    "inside, words",
    [
        ('<transform name="to_world"><scale x="2"/></transform>', "shears or scales unevenly"),
        ('<float name="scale" value="-1"/>', "must be at least 0"),
        ('<boolean name="mis_compensation" value="7"/>', "neither"),
        ('<float name="radiance" value="1"/>', "is not a parameter of"),
    ],
)
def test_wrong_parameters_are_refused(make_scene, sky, inside, words):
    with pytest.raises(pj.InputError, match=words):
        make_scene(FLOOR + sky(picture(2, 3), inside))


def test_one_picture_alone_is_taken(make_scene, sky):
    with pytest.raises(pj.InputError, match="a scene takes one of this type; the first is at"):
        make_scene(FLOOR + sky(picture(2, 3)) + sky(picture(2, 3), name="other"))


def test_a_black_picture_is_told(write_scene, sky):
    with pytest.warns(pj.errors.InputWarning, match="the radiance of every light is 0"):
        scene = pj.load_scene(write_scene(FLOOR + sky(np.zeros((*LARGE, 3), np.float32)), res=8))
    assert not np.asarray(pj.render(scene, 4)).any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pj.load_scene(write_scene(FLOOR + sky(picture(2, 3))))


def test_arrays_are_pictures_too():
    texels = picture(4, 6)
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    for key in ("data", "bitmap"):
        scene = pj.load_dict({"type": "scene", "view": camera, "sky": {"type": "envmap", key: texels}})
        np.testing.assert_array_equal(scene.emitters[0].table.column("texels").values, texels.ravel())
        assert list(pj.parameters(scene)) == ["sky.radiance", "sky.scale"]
    with pytest.raises(pj.InputError, match=r"must have the shape \(H, W\)"):
        pj.load_dict({"type": "scene", "view": camera, "sky": {"type": "envmap", "data": np.ones((2, 2, 5))}})
    # Mitsuba ignores the alpha of a bitmap.
    with_alpha = np.concatenate([texels, texels[..., :1]], -1)
    scene = pj.load_dict({"type": "scene", "view": camera, "sky": {"type": "envmap", "bitmap": with_alpha}})
    np.testing.assert_array_equal(scene.emitters[0].table.column("texels").values, texels.ravel())


# ---- beside Mitsuba -------------------------------------------------------------------------------------------------


@pytest.fixture
def mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    return mi


@pytest.mark.parametrize("name", ["usual", "odd", "small", "hot", "zenith", "nadir"])
@pytest.mark.parametrize("inside", ["", PLACED + SCALE, '<transform name="to_world"><scale x="-1"/></transform>'])
def test_radiance_is_what_mitsuba_says(make_scene, mitsuba, sky, name, inside):
    text = sky(PICTURES[name], inside)
    scene = make_scene(text)
    theirs = mitsuba.load_string(f'<scene version="3.0.0">{text}</scene>').emitters()[0]
    si, d = mitsuba.SurfaceInteraction3f(), directions(100)
    ours, _ = jax.vmap(lambda d: emitters.background(scene.emitters, None, d))(jnp.asarray(d, jnp.float32))
    for direction, radiance in zip(d, np.asarray(ours), strict=True):
        si.wi = mitsuba.Vector3f(*(-direction).tolist())
        rounding = 1e-5 * max(PICTURES[name].shape) * PICTURES[name].max()
        np.testing.assert_allclose(radiance, np.array(theirs.eval(si)), rtol=1e-4, atol=rounding)


@pytest.mark.slow
@pytest.mark.parametrize("name, inside", [("hot", PLACED + SCALE), ("odd", ""), ("zenith", PLACED)])
def test_images_are_mitsubas(make_scene, mitsuba, sky, estimate, agree, estimate_type, write_scene, name, inside):
    body = FLOOR + BALLS + sky(PICTURES[name], inside)
    theirs = mitsuba.load_file(str(write_scene(body, res=8, **VIEW)))
    images = np.stack([np.array(mitsuba.render(theirs, spp=128, seed=seed), float) for seed in range(16)])
    theirs = estimate_type(images.mean(0), images.var(0, ddof=1) / len(images), len(images))
    agree(estimate(make_scene(body, res=8, **VIEW), 128), theirs)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads what Linux tells of memory")
def test_a_large_picture_is_loaded_without_copies(write_scene, sky):
    """Its tables take two thirds of its own 100 MB, and at the peak at most 1.5 times that size is in use beside it.

    The script runs in a process of its own and reads VmHWM, since getrusage would report the peak of the parent process
    where that was higher.
    """
    path = write_scene(FLOOR + sky(np.tile(picture(64, 128), (32, 32, 1))), res=2)
    script = f"""
import re, jax, pathjax as pj
jax.block_until_ready(jax.numpy.zeros(3))
used = lambda: int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
pj.load_scene("{ROOT}/scenes/cornell_box.xml")
before = used()
scene = pj.load_scene("{path}")
print((used() - before) * 1024 / (2048 * 4096 * 12))
"""
    share = float(subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout)
    assert 1 < share < 2.5
