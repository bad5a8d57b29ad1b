"""Terms of the Neumann series against closed forms, their sum against the render, their errors against true errors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.compile import native
from pathjax.integrators.options import Options
from pathjax.rendering import bounces, tail

RHO = np.array([0.2, 0.5, 0.8])
DEPTH = 6
GREY = '<bsdf type="diffuse" id="wall"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
ALPHA = 0.7
# A disk spans a cap of the unit sphere and emits 3 as the cap would; all other wall points see it alike.
CAVITY = f"""
<shape type="sphere"><boolean name="flip_normals" value="true"/>{GREY}</shape>
<shape type="disk"><transform name="to_world"><scale value="{np.sin(ALPHA)}"/><translate z="{-np.cos(ALPHA)}"/>
  </transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
  <emitter type="area" id="lamp"><rgb name="radiance" value="3"/></emitter></shape>
"""


def with_depth(scene, depth):
    return replace(scene, max_depth=jnp.int32(depth))


@pytest.fixture(scope="module")
def furnace(shipped):
    """Closed and diffuse, Le = 1 everywhere."""
    return shipped("furnace", res=16)


@pytest.fixture(scope="module")
def cavity(make_scene):
    return make_scene(CAVITY, depth=2, rr_depth=3, origin="0.1, 0.2, -0.3", target="0.3, 0.1, 1", fov=90)


def estimates(estimate_type, images):
    """Return an Estimate of each term, from terms (depth, H, W, 3) of independent seeds."""
    images = np.asarray(images, float)
    mean, variance = images.mean(0), images.var(0, ddof=1) / len(images)
    return [estimate_type(*term, len(images)) for term in zip(mean, variance, strict=True)]


# ---- the sum --------------------------------------------------------------------------------------------------------

SUMS = {"rtol": 3e-6, "atol": 1e-6}  # sums of about ten float32 numbers, the largest about 10


@pytest.mark.parametrize("name", ["cornell_box", pytest.param("glass_and_mirror", marks=pytest.mark.slow)])
def test_terms_add_up_to_the_render_of_the_same_seed(shipped, name):
    scene = with_depth(shipped(name, res=16), DEPTH)
    one = pj.render_bounces(scene, DEPTH, 13, 3, errors=False)
    assert one.terms.shape == one.variance.shape == (DEPTH, 16, 16, 3)
    np.testing.assert_allclose(one.terms.sum(0), pj.render(scene, 13, 3), **SUMS)
    assert np.isnan(one.variance).all()
    scene = shipped(name, res=64)  # the scene of the manual, which shares its kernels
    four = pj.render_bounces(scene, 8, 13, 3)
    np.testing.assert_allclose(four.terms.sum(0), pj.render_until(scene, spp=13, seed=3).image, **SUMS)
    assert np.isfinite(four.standard_error).all()


def test_terms_of_an_adaptive_render_add_up_to_it(shipped):
    scene = shipped("cornell_box", res=64)
    result = pj.render_until(scene, 0.1, seed=2)
    assert len(np.unique(result.samples)) > 1
    terms = pj.render_bounces(scene, 8, result.samples, 2).terms
    np.testing.assert_allclose(terms.sum(0), result.image, **SUMS)


@pytest.mark.slow
def test_hidden_emitters_are_hidden_in_the_terms(make_scene):
    lamp = '<transform name="to_world"><translate z="1"/></transform><emitter type="area"/>'
    body = f'<shape type="rectangle">{GREY}</shape><shape type="rectangle">{lamp}</shape><emitter type="constant"/>'
    scene = make_scene(body, hide="true", depth=3, film='<rfilter type="gaussian"/>')
    terms = np.asarray(pj.render_bounces(scene, 3, 4, errors=False).terms)
    assert not terms[0].any() and terms[1].any()
    np.testing.assert_allclose(terms.sum(0), pj.render(scene, 4), **SUMS)


@pytest.mark.slow
def test_depth_alone_says_how_many_terms(furnace):
    """The scene's max_depth does not matter, so the first terms of a longer series are those of a shorter one."""
    short, long = (pj.render_bounces(with_depth(furnace, d), depth, 4).terms for d, depth in ((9, 2), (1, DEPTH)))
    np.testing.assert_allclose(short, long[:2], rtol=1e-6)


def test_portions_make_no_difference(furnace, monkeypatch):
    whole = pj.render_bounces(furnace, DEPTH, 13, 5)
    monkeypatch.setattr(bounces, "_PORTION", 2)
    parts = pj.render_bounces(furnace, DEPTH, 13, 5)
    np.testing.assert_allclose(parts.terms, whole.terms, rtol=1e-6)
    np.testing.assert_allclose(parts.variance, whole.variance, rtol=1e-3, atol=1e-10)


# ---- closed forms ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def furnace_terms(furnace):
    """(reflectance, seed, strategy) -> terms and their derivatives in each channel's reflectance."""

    def both(seed, strategy="mis"):
        def of(rho):
            return pj.render_bounces(pj.with_parameters(furnace, {"wall.reflectance": rho}), DEPTH, 16, seed, strategy)

        rho = jnp.float32(RHO)
        terms, tangents = jax.jvp(of, (rho,), (jnp.ones(3),))
        return terms.terms, tangents.terms

    return both


def test_term_of_the_furnace_is_the_power_of_its_albedo(furnace_terms, estimate_type, agree):
    terms, slopes = zip(*(furnace_terms(seed) for seed in range(1, 17)), strict=True)
    for k, (term, slope) in enumerate(
        zip(estimates(estimate_type, terms), estimates(estimate_type, slopes), strict=True)
    ):
        agree(term, RHO**k)
        agree(slope, k * RHO ** max(k - 1, 0))


@pytest.mark.slow
def test_furnace_by_bsdf_sampling_has_no_noise(furnace, furnace_terms):
    """Only rounding is left, until roulette adds noise."""
    terms, slopes = furnace_terms(1, strategy="bsdf")
    k = np.arange(DEPTH)[:, None, None, None]
    quiet = slice(0, int(furnace.rr_depth))
    expected = np.broadcast_to(RHO**k, terms.shape)
    np.testing.assert_allclose(terms[quiet], expected[quiet], rtol=2e-6)
    slope = np.broadcast_to(k * RHO ** np.maximum(k - 1, 0), terms.shape)
    np.testing.assert_allclose(slopes[quiet], slope[quiet], rtol=2e-6)


def cavity_terms():
    """Return the terms (DEPTH, 3) of a wall without lamp: rho mean(rho)^(k-1) mean(Le), means over the sphere.

    A cap with the share f = (1 - cos alpha) / 2 of the sphere emits 3 and is black.
    """
    f = (1 - np.cos(ALPHA)) / 2
    k = np.arange(DEPTH)[:, None]
    return np.where(k == 0, 0, RHO * (RHO * (1 - f)) ** np.maximum(k - 1, 0) * 3 * f)


@pytest.mark.parametrize("strategy", ["mis", pytest.param("bsdf", marks=pytest.mark.slow)])
def test_indirect_light_in_a_cavity_with_uneven_emission_is_even(cavity, estimate_type, agree, strategy):
    images = [pj.render_bounces(cavity, DEPTH, 64, seed, strategy).terms for seed in range(1, 17)]
    for term, expected in zip(estimates(estimate_type, images), cavity_terms(), strict=True):
        agree(term, expected)


def test_variance_is_that_of_the_terms(cavity):
    """The mean variance equals the mean squared error; both, over 16 seeds of 256 pixels, are known to about 3 %."""
    expected = cavity_terms()[1:, None, None]
    all_of = [pj.render_bounces(cavity, DEPTH, 64, seed) for seed in range(16)]
    squares = np.mean([(np.asarray(b.terms)[1:] - expected) ** 2 for b in all_of], (0, 2, 3))
    variances = np.mean([np.asarray(b.variance)[1:] for b in all_of], (0, 2, 3))
    np.testing.assert_allclose(variances, squares, rtol=0.1)


@pytest.mark.parametrize("power", [-66, 66, 80])
def test_a_power_of_two_in_the_lamp_scales_terms_and_errors(cavity, power):
    """2^-66 is 1.4e-20, and 2^66 is 7e19."""
    radiance = pj.parameters(cavity)["lamp.radiance"]
    one = pj.render_bounces(cavity, DEPTH, 16)
    other = pj.render_bounces(pj.with_parameters(cavity, {"lamp.radiance": 2.0**power * radiance}), DEPTH, 16)
    for field in ("terms", "deviation", "standard_error"):
        np.testing.assert_array_equal(getattr(other, field), np.ldexp(getattr(one, field), power))
    shares, errors = one.tail().cut_off(10)
    np.testing.assert_allclose(other.tail().cut_off(10), (shares, errors), rtol=1e-9)
    assert (errors > 0).all()


@pytest.mark.slow
def test_float64(x64, shipped):
    with x64():
        scene = shipped("furnace", dtype=jnp.float64, res=4)
        terms = pj.render_bounces(scene, 3, 4, strategy="bsdf").terms
        assert terms.dtype == jnp.float64
        np.testing.assert_allclose(terms[2], np.broadcast_to(RHO**2, (4, 4, 3)), rtol=1e-12)


# ---- derivatives ----------------------------------------------------------------------------------------------------


def test_reverse_mode_is_the_transpose(furnace):
    def third(rho):
        scene = pj.with_parameters(furnace, {"wall.reflectance": rho})
        return pj.render_bounces(scene, DEPTH, 4).terms[3].mean((0, 1))

    rho = jnp.float32(RHO)
    _, forwards = jax.jvp(third, (rho,), (jnp.ones(3),))
    np.testing.assert_allclose(jax.grad(lambda rho: third(rho).sum())(rho), forwards, rtol=1e-5)


@pytest.mark.slow
def test_derivative_in_a_radiance_is_the_term_over_it(cavity):
    def of(radiance):
        return pj.render_bounces(pj.with_parameters(cavity, {"lamp.radiance": radiance}), DEPTH, 4).terms

    terms, slopes = jax.jvp(of, (jnp.full(3, 3.0),), (jnp.ones(3),))
    np.testing.assert_allclose(3 * slopes, terms, rtol=1e-5, atol=1e-7)


def test_variance_has_no_derivative_and_nothing_is_nan(furnace):
    def of(rho):
        scene = pj.with_parameters(furnace, {"wall.reflectance": rho})
        return pj.render_bounces(scene, DEPTH, 4).variance.sum()

    assert not np.asarray(jax.grad(of)(jnp.float32(RHO))).any()


# ---- compilation ----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not native(), reason="native loops are off")
@pytest.mark.parametrize("derivative", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_terms_are_one_native_kernel(native_kernels, furnace, derivative):
    parameter = furnace.about.parameters["wall.reflectance"]
    colors = ((parameter.path, parameter.index),) if derivative else ()
    pixels = jnp.arange(256, dtype=jnp.int32)
    work = pixels, 0, jnp.full((4, 256), 4), jnp.arange(4, dtype=jnp.uint32)
    static = {"depth": DEPTH, "options": Options(by_vertex=True), "colors": colors}
    lowered = bounces._kernel.lower(replace(furnace, about=None), *work, **static)
    assert native_kernels(lowered.compile()) == 1  # the program is the one that renders use


def test_other_spp_seeds_and_colours_reuse_the_kernel(furnace):
    pj.render_bounces(furnace, DEPTH, 4)
    before = bounces._kernel._cache_size()
    for how in ({"spp": 5}, {"seed": 7}):
        pj.render_bounces(furnace, DEPTH, **{"spp": 4} | how)
    pj.render_bounces(pj.with_parameters(furnace, {"wall.reflectance": 0.3}), DEPTH, 4)
    assert bounces._kernel._cache_size() == before


# ---- the tail -------------------------------------------------------------------------------------------------------


def test_tail_of_the_furnace(furnace):
    """With Le = 1, cutting off after d terms loses the share rho^d of all light, 1 / (1 - rho)."""
    found = pj.render_bounces(furnace, DEPTH, 64).tail()
    for max_depth in (3, DEPTH, 20):
        share, error = found.cut_off(max_depth)
        assert (np.abs(share - RHO**max_depth) < 4 * error + 1e-6).all()
        assert (error < 0.2 * share + 1e-6).all()
    assert found.depth_for(0.5**3) == np.ceil(np.log(0.5**3) / np.log(0.8))


@pytest.mark.parametrize("error, depth", [(0.3, 2), (0.1, 4), (0.01, 7), (1e-6, 20)])
def test_tail_of_a_geometric_series(error, depth):
    """Ratio 1/2: after d terms the share 2^-d is left."""
    terms = np.repeat(0.5 ** np.arange(8.0)[:, None], 3, 1)
    found = tail.fit(terms, 0.01 * terms)
    np.testing.assert_allclose(found.ratio, 0.5)
    np.testing.assert_allclose(found.light, 2.0**-7)
    np.testing.assert_allclose(found.cut_off(10)[0], 2.0**-10)
    assert found.depth_for(error) == depth


def test_error_of_the_tail_is_that_of_its_estimates():
    """Against 1000 series with errors of 3 % in each term."""
    terms = np.repeat(0.6 ** np.arange(8.0)[:, None], 3, 1)
    rng = np.random.default_rng(1)
    fits = [tail.fit(terms * (1 + 0.03 * rng.standard_normal(terms.shape)), 0.03 * terms) for _ in range(1000)]
    light, said = np.array([f.light for f in fits]), np.array([f.covariance for f in fits])
    by_log = np.array([1, 1 / (1 - 0.6)])
    expected = np.sqrt(np.median(np.einsum("i,ncij,j->nc", by_log, said, by_log)))
    assert np.std(np.log(light)) == pytest.approx(expected, rel=0.15)


def test_light_that_does_not_decay_has_no_depth():
    growing = tail.fit(np.repeat(1.5 ** np.arange(5.0)[:, None], 3, 1), np.full((5, 3), 1e-3))
    assert growing.depth_for(0.01) is None and (growing.cut_off(4)[0] == 1).all()


def test_nothing_is_left_after_black():
    terms = np.array([[1, 1, 0], [0, 0.5, 0], [0, 0.25, 0]], float)
    found = tail.fit(terms, 0.01 * terms)
    np.testing.assert_allclose(found.cut_off(3)[0], [0, 0.125, 0], rtol=1e-6)
    np.testing.assert_allclose(found.cut_off(0)[0], [1, 1, 0])


# ---- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [0, -1, 65, 2.5, True, "3"])
def test_depth_out_of_range(furnace, depth):
    with pytest.raises(pj.InputError, match=r"depth = .* number of terms .* \[1, 64\]"):
        pj.render_bounces(furnace, depth)


@pytest.mark.parametrize(
    "how, says",
    [
        ({"spp": 0}, "spp"),
        ({"spp": np.ones((3, 3), int)}, r"spp has the shape \(3, 3\); .* the \(16, 16\) pixels"),
        ({"seed": -1}, "seed"),
        ({"strategy": "mix"}, "mix"),
    ],
)
def test_arguments_out_of_range(furnace, how, says):
    with pytest.raises(pj.InputError, match=says):
        pj.render_bounces(furnace, 3, **how)


def test_tail_of_too_few_terms():
    with pytest.raises(pj.InputError, match="depth = 2; a tail needs"):
        tail.fit(np.ones((2, 3)), np.ones((2, 3)))


@pytest.mark.parametrize("error", [0, 1, -0.5])
def test_depth_for_an_error_out_of_range(error):
    with pytest.raises(pj.InputError, match="between 0 and 1"):
        tail.fit(np.ones((3, 3)), np.ones((3, 3))).depth_for(error)


def test_derivative_in_the_ior_of_glass(shipped):
    scene = shipped("glass_ball", res=16)

    def of(ior):
        return pj.render_bounces(pj.with_parameters(scene, {"glass.int_ior": ior}), 3, 1).terms

    with pytest.raises(pj.InputError, match=r"glass\.int_ior: the IOR of glass moves paths"):
        jax.jvp(of, (1.5,), (1.0,))
