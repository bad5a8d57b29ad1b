"""Choices of classic path tracers: all but Schlick's keep the image, and a program holds only what is chosen."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs
from pathjax.compile import native
from pathjax.integrators import pixel
from pathjax.integrators.options import MOST_SPLITS, Options
from pathjax.rendering.render import pixel_means, render_pixels

INTERFACE = """
<shape type="rectangle"><transform name="to_world"><scale value="5"/></transform>
  <bsdf type="dielectric" id="glass"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/></bsdf></shape>
<shape type="sphere"><point name="center" x="{x}" y="0" z="{z}"/><emitter type="area"/></shape>
"""


@pytest.fixture(scope="module")
def interface(make_scene):
    """(degrees) -> a glass interface seen at this angle to its normal, from inside beyond 90 degrees. It reflects a
    lamp of radiance 1 and transmits darkness.
    """

    def at(degrees):
        x, z = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        body = INTERFACE.format(x=-20 * x, z=20 * z)
        return make_scene(body, res=4, origin=f"{4 * x}, 0, {4 * z}", fov=1e-3)

    return at


def reflectance(fresnel, degrees):
    eta = 1.5 if degrees < 90 else 1 / 1.5
    cos_i = abs(np.cos(np.radians(degrees)))
    cos2_t = 1 - (1 - cos_i**2) / eta**2
    if cos2_t <= 0:
        return 1.0
    cos_t = np.sqrt(cos2_t)
    if fresnel == "schlick":
        return 0.04 + 0.96 * (1 - (cos_i if eta > 1 else cos_t)) ** 5
    s, p = (cos_i - eta * cos_t) / (cos_i + eta * cos_t), (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return (s**2 + p**2) / 2


# ---- closed forms ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fresnel", bsdfs.FRESNEL)
@pytest.mark.parametrize("degrees", [10, 60, 80, 110, 145, 170])
def test_split_interface_shows_its_reflectance_without_noise(interface, degrees, fresnel):
    image = pj.render(interface(degrees), 1, fresnel=fresnel, split_depth=1)
    np.testing.assert_allclose(image, reflectance(fresnel, degrees), rtol=3e-4)  # a pixel is 1e-5 rad wide


def test_interface_shows_schlicks_reflectance_by_chance(interface, estimate, agree):
    image = estimate(interface(60), spp=64, fresnel="schlick")
    agree(image, reflectance("schlick", 60), pixelwise=False, rounding=3e-4)


@pytest.mark.slow
def test_derivative_in_the_ior_is_that_of_schlicks_reflectance(interface):
    """From outside, only R0 = ((n - 1) / (n + 1))^2 varies."""
    scene = interface(60)

    def image(ior, seed):
        return pj.render(pj.with_parameters(scene, {"glass.int_ior": ior}), 64, seed, fresnel="schlick")

    tangent = jax.jit(lambda seed: jax.jvp(lambda ior: image(ior, seed), (1.5,), (1.0,))[1].mean())
    slopes = np.array([tangent(seed) for seed in range(16)])
    exact = (1 - 0.5**5) * 4 * 0.5 / 2.5**3
    # 4.5 standard errors of 16 seeds, a false-alarm rate of some 3e-4. The difference's bias is some 1e-4 of the slope.
    assert abs(slopes.mean() - exact) < 4.5 * slopes.std(ddof=1) / 4 + 1e-3 * exact


# ---- against the default --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def default(shipped, estimate):
    """(name) -> (scene, Estimate of its image)."""
    made = {}

    def of(name):
        if name not in made:
            scene = shipped(name, res=16)  # shares its kernel with other tests
            made[name] = scene, estimate(scene, spp=256, first_seed=101)
        return made[name]

    return of


@pytest.mark.parametrize("name", ["glass_ball", pytest.param("glass_and_mirror", marks=pytest.mark.slow)])
@pytest.mark.parametrize("split_depth", [2, *(pytest.param(depth, marks=pytest.mark.slow) for depth in (1, 3))])
def test_splitting_keeps_the_image(default, estimate, agree, name, split_depth):
    scene, image = default(name)
    agree(estimate(scene, spp=64, split_depth=split_depth), image)


@pytest.mark.slow
def test_splitting_under_roulette_and_hidden_lights_keeps_the_image(shipped, estimate, agree):
    scene = shipped("glass_and_mirror", res=12)
    scene = replace(scene, rr_depth=jnp.int32(1), hide_emitters=True)
    agree(estimate(scene, spp=256, split_depth=2), estimate(scene, spp=256, first_seed=101))


def test_splitting_lowers_the_error_of_a_sample(default, estimate):
    scene, _ = default("glass_ball")
    split = estimate(scene, spp=64, split_depth=2).variance.mean()
    assert split < 0.8 * estimate(scene, spp=64).variance.mean()


@pytest.mark.parametrize("sampler", [pytest.param("independent", marks=pytest.mark.slow), "subpixel"])
@pytest.mark.parametrize("film", [pytest.param("box", marks=pytest.mark.slow), "tent"])
def test_samplers_agree(make_scene, estimate, agree, sampler, film):
    """On stripes, so that the position on the film matters."""
    stripes = """<shape type="rectangle"><transform name="to_world"><scale value="9"/></transform><bsdf type="diffuse">
      <texture type="checkerboard" name="reflectance"><transform name="to_uv"><scale x="33" y="21"/></transform>
      </texture></bsdf></shape><emitter type="constant"/>"""
    scene = make_scene(stripes, res=12, fov=90, film=f'<rfilter type="{film}"/>')
    agree(estimate(scene, spp=64, sampler=sampler), estimate(scene, spp=64, first_seed=101))


@pytest.mark.slow
def test_samplers_agree_on_many_bounces(default, estimate, agree):
    scene, image = default("glass_and_mirror")
    agree(estimate(scene, spp=256, sampler="independent"), image)


def test_two_by_two_strata_lower_the_error_of_independent_numbers(make_scene, estimate):
    """Half of the middle pixel is bright: two of its quarters."""
    half = """<shape type="rectangle"><transform name="to_world"><scale value="9"/><translate x="9"/></transform>
      <emitter type="area"/></shape>"""
    scene = make_scene(half, res=3)
    assert estimate(scene, sampler="independent").variance[:, 1].min() > 1e-4
    assert not estimate(scene, sampler="subpixel").variance.any()


# ---- what is compiled -----------------------------------------------------------------------------------------------


def lowered(scene, form=None, **chosen):
    pixels = jnp.arange(256, dtype=jnp.int32)
    work = replace(scene, about=None), pixels, *pixel.numbers(pixels, 0, 4, 1)
    return pixel_means.lower(*work, options=Options(**chosen), form=form)


TRACES = {  # names in a program's debug information -> the choice that brings them
    "/splitting.py": {"split_depth": 2},
    "schlick": {"fresnel": "schlick"},
    "independent_point": {"sampler": "independent"},
    "subpixel_point": {"sampler": "subpixel"},
}


@pytest.mark.parametrize("chosen", [{}, *TRACES.values()], ids=str)
def test_program_holds_what_is_chosen_and_no_trace_of_the_rest(shipped, chosen):
    text = lowered(shipped("glass_ball", res=16), form="loop", **chosen).as_text(debug_info=True)
    assert {trace for trace in TRACES if trace in text} == {trace for trace, how in TRACES.items() if how == chosen}


def test_scene_without_glass_is_the_same_program(shipped):
    scene = shipped("cornell_box", res=16)
    text = lowered(scene, form="loop").as_text()
    assert lowered(scene, form="loop", split_depth=2, fresnel="schlick").as_text() == text


@pytest.mark.skipif(not native(), reason="native loops are off")
def test_choices_are_one_native_kernel(native_kernels, shipped):
    chosen = lowered(shipped("glass_ball", res=16), split_depth=2, fresnel="schlick", sampler="subpixel")
    assert native_kernels(chosen) == 1


@pytest.mark.slow
def test_vectorised_form_splits_into_the_same_image(default):
    scene, _ = default("glass_ball")
    images = [pj.render(scene, 4, split_depth=2)]
    pixels = jnp.arange(256, dtype=jnp.int32)
    for form in ("loop", "vmap"):
        images.append(render_pixels(scene, pixels, 0, 4, 0, Options(split_depth=2), form=form).reshape(16, 16, 3))
    for image in images[1:]:
        assert np.isclose(images[0], image, rtol=1e-4, atol=1e-5).all(-1).mean() > 0.97


@pytest.mark.slow
def test_float64_splits_into_the_same_image(shipped, default, x64):
    scene, _ = default("glass_ball")
    single = np.asarray(pj.render(scene, 4, split_depth=2))
    with x64():
        double = np.asarray(pj.render(shipped("glass_ball", jnp.float64, res=16), 4, split_depth=2))
    assert double.dtype == np.float64
    assert np.isclose(single, double, rtol=1e-3, atol=1e-5).all(-1).mean() > 0.97


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong, says",
    [
        ({"fresnel": "shlick"}, "fresnel 'shlick' is unknown; use one of exact, schlick"),
        ({"sampler": "sobol"}, "sampler 'sobol' is unknown"),
        ({"split_depth": -1}, "split_depth = -1"),
        ({"split_depth": MOST_SPLITS + 1}, "split_depth = 9"),
        ({"split_depth": 1.5}, "split_depth = 1.5"),
        ({"sampler": "subpixel", "spp": 6}, "spp = 6.*multiple of 4"),
    ],
)
def test_choices_out_of_range_are_refused(default, wrong, says):
    with pytest.raises(pj.InputError, match=says):
        pj.render(default("glass_ball")[0], **wrong)


@pytest.mark.parametrize("how", [{"split_depth": 1}, {"sampler": "independent"}])
def test_derivatives_with_another_sampler_or_splitting_are_refused(default, how):
    scene, _ = default("glass_ball")
    with pytest.raises(pj.InputError, match="derivatives are not made with.*lattice"):
        jax.grad(lambda r: pj.render(pj.with_parameters(scene, {"sky.radiance": r}), 4, **how).mean())(0.5)
