"""Images with wide filters, where every sample counts in all pixels under the filter."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import pathjax as pj
from pathjax import images, transport
from pathjax.derivatives import jacobian, matrix_free
from pathjax.derivatives.row_slopes import RowSlopes
from pathjax.integrators import pixel, reconstruction
from pathjax.integrators.options import DEFAULTS, Options
from pathjax.rendering.progressive import passes
from pathjax.rendering.render import pixel_means
from pathjax.scene import parameters as named
from pathjax.sensors import film
from pathjax.sensors.filters import Box, Gaussian, Tent

FALSE_ALARM = 1e-4
SKY = '<emitter type="constant"><rgb name="radiance" value="0.7, 1.3, 2"/></emitter>'
# A diffuse ball, half in front of the sky and half beyond the border of the image.
BALL = (
    SKY
    + """<shape type="sphere" id="ball"><point name="center" x="1" y="0.4" z="0"/><bsdf type="diffuse" id="grey">
  <rgb name="reflectance" value="0.2, 0.4, 0.8"/></bsdf></shape>"""
)
GAUSSIAN = '<rfilter type="gaussian"/>'
BORDER = GAUSSIAN + '<boolean name="sample_border" value="true"/>'


@pytest.fixture(scope="module")
def ball(make_scene):
    return make_scene(BALL, res=8, depth=3, film=GAUSSIAN)


def own(scene):
    return replace(scene, film=film.with_own_samples(scene.film))


def through(scene, filter, border=False, crop=None):
    made = scene.film
    described = film.HDRFilm(made.width, made.height, crop or made.crop, filter, border)
    return replace(scene, film=described.build(scene.camera.origin.dtype))


def agree(one, other):
    """Assert that two stacks of independent images have one mean, by the largest |z| over pixels and channels."""
    z = (one.mean(0) - other.mean(0)) / np.sqrt(one.var(0, ddof=1) / len(one) + other.var(0, ddof=1) / len(other))
    freedom = len(one) + len(other) - 2
    worst = 2 * stats.t.sf(np.abs(z).max(), freedom / 2)
    assert -np.expm1(z.size * np.log1p(-worst)) > FALSE_ALARM, np.abs(z).max()


@pytest.mark.parametrize("spp", [1, 5])
@pytest.mark.parametrize(
    "film",
    [GAUSSIAN, *(pytest.param(other, marks=pytest.mark.slow) for other in (BORDER, '<rfilter type="tent"/>'))],
)
def test_a_constant_image_stays_constant_also_at_its_borders(make_scene, film, spp):
    image = pj.render(make_scene(SKY, res=6, film=film), spp, 3)
    np.testing.assert_allclose(image, np.broadcast_to([0.7, 1.3, 2], (6, 6, 3)), rtol=1e-6)


def test_samples_count_by_the_filter_and_by_nothing_else(ball):
    """The definition written out: A / W over all samples of the kernel."""
    spp, count = 3, film.pixel_count(ball.film)
    sampled = replace(ball, film=film.of_samples(ball.film), about=None)
    pixels = jnp.tile(jnp.arange(count, dtype=jnp.int32), spp)
    numbers = jnp.repeat(jnp.arange(spp, dtype=jnp.uint32), count)
    values = pixel_means(sampled, pixels, *pixel.numbers(pixels, numbers, 1, 7), options=DEFAULTS)
    u = reconstruction.film_numbers(sampled, pixels, numbers, jnp.uint32(7))
    at = np.asarray(u, float) + np.stack([pixels % 8, pixels // 8], -1)
    expected = np.zeros((8, 8, 3))
    for y, x in np.ndindex(8, 8):
        distance = at - [x + 0.5, y + 0.5]
        f = np.maximum(np.exp(-2 * distance**2) - np.exp(-8), 0).prod(-1)
        expected[y, x] = f @ np.asarray(values, float) / f.sum()
    np.testing.assert_allclose(pj.render(ball, spp, 7), expected, rtol=2e-5)


def test_what_is_not_finite_spoils_only_what_it_counts_in(ball):
    """A sample spoils the pixels under the filter around it, and the adjoint of a pixel spoils the samples there."""
    here, edge, first = 27, reconstruction.halo(ball.film), jnp.int32(0)
    u = jnp.asarray(np.random.default_rng(3).uniform(size=(1, 1, 64, 2)), jnp.float32)
    pixels = np.stack([np.arange(64) % 8, np.arange(64) // 8], -1)
    counts = (np.abs(pixels[:, None] + np.asarray(u)[0, 0, :, None] - pixels - 0.5) < 2).all(-1)  # (sample, pixel)
    scale, values = jnp.ones((1, 1, 64)), jnp.ones((1, 1, 64, 3)).at[:, :, here].set(jnp.nan)
    spread = jax.jit(partial(reconstruction.spread_samples, ball.film))(first, u, scale, values)[0, :3, edge:-edge]
    np.testing.assert_array_equal(np.isnan(spread), np.broadcast_to(counts[here], (3, 64)))
    adjoint = jnp.ones((1, 64 + 2 * edge, 3)).at[:, edge + here].set(jnp.nan)
    gathered = jax.jit(partial(reconstruction.gather_samples, ball.film))(first, u, scale, adjoint)[0, 0]
    np.testing.assert_array_equal(np.isnan(gathered), np.broadcast_to(counts[:, here, None], (64, 3)))


def test_the_box_shares_nothing_and_is_rendered_as_ever(ball):
    box = through(ball, Box())
    assert not box.film.shared and film.pixel_count(film.of_samples(box.film)) == 64
    trace = jax.jit(lambda scene: pj.render(scene, 4)).trace
    assert str(trace(replace(box, about=None)).jaxpr) == str(trace(own(replace(box, about=None))).jaxpr)


def test_filters_too_wide_to_share_are_sampled_by_importance(ball):
    assert through(ball, Tent(4.5)).film.shared and not through(ball, Tent(4.6)).film.shared


@pytest.mark.slow
@pytest.mark.parametrize("border", [False, True], ids=["within the crop window", "beyond it"])
def test_pixels_that_share_samples_have_the_mean_of_those_that_do_not(ball, border):
    scene = through(ball, Gaussian(), border)
    one, other = (
        np.asarray(jax.vmap(lambda seed, scene=scene: pj.render(scene, 16, seed))(jnp.arange(first, first + 64)), float)
        for scene, first in ((scene, 0), (own(scene), 100))
    )
    agree(one, other)
    # Sharing samples with the pixels around reduces noise.
    assert one.var(0).mean() < 0.5 * other.var(0).mean()


@pytest.mark.slow
def test_a_crop_window_shows_that_part_of_the_image(ball):
    whole, part = (
        np.asarray(jax.vmap(lambda seed, scene=scene: pj.render(scene, 16, seed))(jnp.arange(first, first + 48)), float)
        for scene, first in (
            (through(ball, Gaussian(), True), 0), (through(ball, Gaussian(), True, (2, 1, 5, 4)), 100)
        )
    )  # fmt: skip
    agree(whole[:, 1:5, 2:7], part)


def test_derivatives_go_the_same_way(ball):
    name = "grey.reflectance"
    image, J = pj.jacobian(ball, [name], 4, 5)
    np.testing.assert_allclose(image, pj.render(ball, 4, 5), rtol=1e-5)

    def of(grey):
        return pj.render(pj.with_parameters(ball, {name: grey}), 4, 5)

    present = jnp.asarray(pj.parameters(ball)[name])
    _, tangent = jax.jvp(of, (present,), (jnp.ones(3),))
    np.testing.assert_allclose(tangent, jnp.einsum("yxcc->yxc", J[name]), rtol=1e-5, atol=1e-6)
    # The image is a polynomial in each channel, of degree 2 for max_depth 3, and roulette begins only at depth 5.
    difference = (of(present + 0.1) - of(present - 0.1)) / 0.2
    np.testing.assert_allclose(tangent, difference, rtol=1e-3, atol=1e-4)


def test_a_recorded_jacobian_goes_the_same_way(ball, monkeypatch):
    """It equals that by tangents from the same samples, also with samples beyond the border of the crop window."""
    scene = through(ball, Gaussian(), True, (2, 1, 5, 4))
    names = list(pj.parameters(scene))
    image, J = pj.jacobian(scene, names, 3, 5)
    monkeypatch.setattr(jacobian, "MOST_TANGENTS", 0)
    other, rows = pj.jacobian(scene, names, 3, 5)
    assert isinstance(rows.derivatives, RowSlopes) and not isinstance(J.derivatives, RowSlopes)
    for one, two in zip([image, *J.values()], [other, *rows.values()], strict=True):
        assert one.shape[:2] == (4, 5)
        np.testing.assert_allclose(two, one, rtol=1e-5, atol=1e-6 * np.abs(one).max())


def test_products_with_a_jacobian_go_the_same_way(ball):
    scene = through(ball, Gaussian(), True, (2, 1, 5, 4))
    wanted, bare, random = scene.about.parameters, named.nameless(scene), np.random.default_rng(0)
    work = film.pixels(scene.film), 0, 3, 5, Options(shared=True)
    changes = {name: jnp.asarray(random.normal(size=p.shape), jnp.float32) for name, p in wanted.items()}
    v = jnp.asarray(random.normal(size=(4, 5, 3)), jnp.float32)
    _, J = pj.jacobian(scene, list(wanted), 3, 5)
    moved = sum(jnp.einsum("yxck,k->yxc", J[name], change) for name, change in changes.items())
    size = np.abs(moved).max()
    np.testing.assert_allclose(
        matrix_free.push(bare, wanted, changes, *work), moved.reshape(-1, 3), rtol=1e-5, atol=1e-5 * size
    )
    for name, pulled in matrix_free.pull(bare, wanted, v.reshape(-1, 3), *work).items():
        np.testing.assert_allclose(pulled, jnp.tensordot(v, J[name], 3), rtol=1e-5, atol=1e-6 * np.abs(J[name]).sum())


@pytest.mark.slow
def test_differences_in_iors_go_the_same_way(shipped):
    scene = through(shipped("glass_ball", res=24), Gaussian())
    check = pj.check_gradient(scene, "glass.int_ior", spp=16, seeds=8)
    assert check.passed


@pytest.mark.slow
def test_terms_add_up_to_the_image(ball):
    bounces = pj.render_bounces(ball, 3, 4, 5, errors=False)
    np.testing.assert_allclose(bounces.terms.sum(0), pj.render(ball, 4, 5), rtol=1e-5)


@pytest.mark.slow
def test_terms_with_errors_add_up_to_the_image_of_render_until(ball):
    for scene in (ball, through(ball, Gaussian(), True)):
        bounces, result = pj.render_bounces(scene, 3, 10, 5), pj.render_until(scene, spp=10, seed=5)
        np.testing.assert_allclose(bounces.terms.sum(0), result.image, rtol=2e-5)


@pytest.mark.slow
def test_output_variables_and_patches_look_through_the_same_filter(shipped):
    scene = through(shipped("cornell_box", res=12), Gaussian())
    ours = pj.render_aovs(scene, ["normal", "albedo"], seed=1)
    theirs = [pj.render_aovs(own(scene), ["normal", "albedo"], seed=seed) for seed in range(2, 34)]
    for name, image in ours.items():
        stack = np.array([each[name] for each in theirs])
        assert np.abs(image - stack.mean(0)).max() < 5 * stack.std(0).max()
    op = transport.operator(scene, patches=60)
    light = op.radiosity(op.solve().L)
    images = np.array([transport.image(own(scene), light, 16, seed) for seed in range(32)])
    assert np.abs(transport.image(scene, light, 16) - images.mean(0)).max() < 5 * images.std(0).max()
    slope = jax.grad(lambda L: transport.image(scene, op.radiosity(L), 1).sum())(op.solve().L)
    assert np.isfinite(slope).all() and (slope > 0).any()


def test_the_number_of_devices_changes_no_bit(ball):
    pixels = film.pixels(ball.film)
    work = replace(ball, about=None), pixels, *pixel.numbers(pixels, 0, 9, 1)
    one = pixel_means(*work, options=Options(shared=True), devices=1)
    np.testing.assert_array_equal(one.reshape(8, 8, 3), pj.render(ball, 9, 1))  # by all devices


@pytest.mark.slow
def test_a_batch_is_rendered_as_its_entries(ball):
    together = jax.vmap(lambda seed: pj.render(ball, 9, seed))(jnp.arange(2))
    np.testing.assert_allclose(together[1], pj.render(ball, 9, 1), rtol=1e-5)


@pytest.mark.slow
def test_samples_of_a_pixel_may_be_of_any_number(ball):
    """Each of a pixel's n samples weighs 1 / n, so uneven counts change no mean, and a constant stays constant."""
    count = film.pixel_count(ball.film)
    pixels, spp = film.pixels(ball.film), jnp.asarray(np.random.default_rng(1).integers(1, 12, count))
    work = pixels, *pixel.numbers(pixels, 0, spp, 1)
    lit = replace(ball, max_depth=jnp.int32(1), about=None)  # only the sky's light, which is constant
    image = pixel_means(lit, *work, options=Options(shared=True)).reshape(8, 8, 3)
    np.testing.assert_allclose(image[:, 0], np.broadcast_to([0.7, 1.3, 2], (8, 3)), rtol=1e-5)


@pytest.mark.slow
def test_float64_is_kept(x64, make_scene):
    with x64():
        scene = make_scene(SKY, jnp.float64, res=4, film=GAUSSIAN)
        image = pj.render(scene, 2, 1)
        assert image.dtype == np.float64
        np.testing.assert_allclose(image, np.broadcast_to([0.7, 1.3, 2], (4, 4, 3)), rtol=1e-14)


def extended(scene, state, spp, seed=5):
    passes.plan(state, spp)
    for _ in passes.extend(scene, state, seed, DEFAULTS):
        pass


@pytest.mark.slow
def test_rounds_of_samples_spread_unevenly_leave_the_mean(ball):
    """Weights are independent of the image, and rounds take several calls."""
    weights = np.random.default_rng(2).random((8, 8)).astype(np.float32) * 4 + 0.2
    weights /= weights.mean()
    stack = []
    for seed in range(64):
        state = passes.start(ball)
        extended(ball, state, 4, seed)
        state.spread(weights)
        extended(ball, state, 8, seed)
        extended(ball, state, 20, seed)
        stack.append(state.moments()[0].reshape(8, 8, 3))
    plain = np.asarray(jax.vmap(lambda seed: pj.render(ball, 32, seed))(jnp.arange(100, 164)), float)
    agree(np.array(stack, float), plain)


@pytest.mark.slow
@pytest.mark.parametrize("devices", [3, 5])
def test_a_kept_state_goes_on_to_the_same_bits(ball, tmp_path, monkeypatch, devices):
    """Also with another number of devices, for which the image would have been split into other runs."""
    from pathjax.rendering.progressive.checkpoint import Checkpoint

    monkeypatch.setattr(passes, "_LEAST_CHUNK", 1)
    monkeypatch.setattr(passes, "calls_at_once", lambda: 3)
    ended, kept = passes.start(ball), passes.start(ball)
    for state in (ended, kept):
        extended(ball, state, 16)
        state.spread(np.linspace(0.5, 1.5, 64, dtype=np.float32).reshape(8, 8))
        passes.plan(state, 1000)
    next(passes.extend(ball, kept, 5, DEFAULTS))
    assert 0 < (kept.count == ended.count).sum() < kept.count.size
    monkeypatch.setattr(passes, "calls_at_once", lambda: devices)
    store = Checkpoint(tmp_path / "run.npz", {})
    store.save(kept)
    loaded = store.load(passes.start(ball))
    assert 0 < (loaded.goal - loaded.count).max() and loaded.spp == 1000
    for state in (ended, loaded):
        for _ in passes.extend(ball, state, 5, DEFAULTS):
            pass
    np.testing.assert_array_equal(ended.means, loaded.means)
    np.testing.assert_array_equal(ended.count, loaded.count)


@pytest.mark.slow
def test_estimated_errors_are_right(shipped):
    """Both the standard errors of pixels and the error of the image, with equal and with adaptive sample counts."""
    scene = through(shipped("cornell_box", res=24), Gaussian())
    truth = np.mean([pj.render(scene, 1 << 13, seed) for seed in range(1000, 1004)], 0, dtype=float)
    for limit in ({"spp": 64}, {"target_error": 0.05}):
        results = [pj.render_until(scene, **limit, seed=seed) for seed in range(32)]
        square = np.mean([(each.image - truth) ** 2 / each.standard_error**2 for each in results])
        assert 0.85 < square < 1.25, limit
        errors = [images.relative_error(each.image, truth) for each in results]
        ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square([each.error for each in results])))
        assert 0.9 < ratio < 1.15, limit


@pytest.mark.slow
def test_the_correlation_of_noise_is_that_of_renders(ball):
    renders = np.array([pj.render(ball, 1, seed)[4:7, 2:6, 0] for seed in range(512)], float)
    noise = (renders - renders.mean(0)) / renders.std(0)
    beside = (noise[:, :, 1:] * noise[:, :, :-1]).mean()
    expected = np.asarray(film.correlation(ball.film))[4, 5]
    assert expected == pytest.approx(np.exp(-1), rel=0.01) and beside == pytest.approx(expected, abs=0.12)
    assert film.correlation(own(ball).film).shape == (1, 1)


@pytest.mark.slow
def test_noise_is_below_that_of_mitsuba_at_equal_samples(shipped, root, tmp_path):
    """relMSE of the 64 x 64 Cornell box, over that of Mitsuba's independent sampler; measured: 0.48."""
    mi = pytest.importorskip("mitsuba")
    scene = through(shipped("cornell_box", res=64), Gaussian())
    truth = np.mean([pj.render(scene, 1 << 13, seed) for seed in range(1000, 1002)], 0, dtype=float)
    text = (root / "scenes" / "cornell_box.xml").read_text()
    (tmp_path / "box.xml").write_text(text.replace('<rfilter type="box"/>', GAUSSIAN))
    mi.set_variant(next(name for name in ("llvm_ad_rgb", "scalar_rgb") if name in mi.variants()))
    theirs = mi.load_file(str(tmp_path / "box.xml"), res=64)

    def error(image):
        return np.mean((np.asarray(image, float) - truth) ** 2 / (truth**2 + 0.01))

    ours = np.mean([error(pj.render(scene, 64, seed)) for seed in range(8)])
    assert ours < 0.7 * np.mean([error(mi.render(theirs, spp=64, seed=seed)) for seed in range(8)])


@pytest.mark.slow
def test_a_fit_takes_targets_of_pixels_that_share_samples(ball):
    """In 12 fits of three channels, standard errors are calibrated and noise is not taken for structure."""
    z = []
    scene = through(pj.with_parameters(ball, {"grey.reflectance": [0.2, 0.4, 0.7]}), Gaussian(), crop=None)
    for seed in range(12):
        target = np.asarray(pj.render(scene, 16, 1000 + seed), float)
        fit = pj.fit(scene, target, ["grey.reflectance"], start={"grey.reflectance": 0.5}, spp=32, seed=seed)
        assert fit.converged, fit.message
        error = fit.values["grey.reflectance"] - pj.parameters(scene)["grey.reflectance"]
        z.append(error / fit.standard_errors["grey.reflectance"])
    assert 0.4 < np.mean(np.square(z)) < 2.2
