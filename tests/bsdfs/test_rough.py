"""Rough bsdfs: the checks of all kinds, values against Mitsuba's, small roughnesses, and scene files."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.bsdfs import Dielectric, RoughConductor, RoughDielectric, ThinDielectric
from pathjax.bsdfs.metals import METALS
from pathjax.kinds import Parameters

COPPER = {"eta": np.array([0.2, 0.92, 1.1]), "k": np.array([3.9, 2.45, 2.14])}
BRUSHED = {"alpha_u": 0.15, "alpha_v": 0.5}
slow = pytest.mark.slow


@pytest.mark.parametrize(
    "values",
    [
        {"distribution": "ggx", "alpha": 0.3},
        pytest.param({"distribution": "ggx", "alpha": 0.3, **COPPER}, marks=slow),
        pytest.param({"distribution": "ggx", "alpha": 1.0}, marks=slow),
        pytest.param({"distribution": "ggx", **BRUSHED}, marks=slow),
        pytest.param({"distribution": "beckmann", "alpha": 0.2, **COPPER}, marks=slow),
        pytest.param({"distribution": "beckmann", "alpha": 1.0}, marks=slow),
        pytest.param({"distribution": "beckmann", **BRUSHED}, marks=slow),
    ],
)
def test_rough_metals_pass_the_checks_of_all_kinds(values):
    testing.check_bsdf(RoughConductor, samples=20_000, **values)


def pairs(n, seed=1):
    """Return directions (N, 3) above the surface; the first quarter are near the horizon."""
    wi, wo = np.random.default_rng(seed).normal(size=(2, n, 3))
    for w in (wi, wo):
        w[:, 2] = abs(w[:, 2])
        w[: n // 4, 2] *= 1e-2
    return tuple((w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32) for w in (wi, wo))


def ours(kind, values, wi, wo):
    materials, zero = testing.material(kind, **values), jnp.int32(0)
    of_pair = lambda wi, wo: bsdfs.evaluate(materials, zero, zero, testing._SURFACE, wi, wo)  # noqa: E731
    return [np.asarray(x, np.float64) for x in jax.jit(jax.vmap(of_pair))(wi, wo)]


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize("roughness", [{"alpha": 0.3}, BRUSHED, {"alpha": 0.02}], ids=str)
def test_values_and_densities_are_mitsubas(distribution, roughness, mitsuba_values):
    values = {**roughness, "distribution": distribution, **COPPER, "specular_reflectance": np.array([0.5, 0.9, 1.0])}
    wi, wo = pairs(300)
    f, pdf = ours(RoughConductor, values, wi, wo)
    expected, density = mitsuba_values("roughconductor", values, wi, wo)
    # The half vector is rounded by 6e-8, and the logarithm of D of the smoothest facets changes by 1e3 times that.
    np.testing.assert_allclose(f, expected, rtol=2e-4, atol=1e-12)
    # Mitsuba's density for Beckmann uses the rational approximation, whose error is 0.35 %.
    np.testing.assert_allclose(pdf, density, rtol=4e-3 if distribution == "beckmann" else 2e-4, atol=1e-12)


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
def test_weights_of_small_roughnesses_are_right_in_float32(distribution, x64):
    """Down to 1e-3 they equal those of float64, whose samples are mirrored at nearly the same normals."""
    u = np.random.default_rng(3).integers(0, 1 << 24, (2000, 2)) * 2.0**-24

    def drawn(alpha, dtype, wi):
        materials = bsdfs.build(
            [RoughConductor.instance(alpha=alpha, distribution=distribution, **COPPER)], dtype, (), Parameters()
        )
        return testing.sample(jax.device_put(materials), jnp.asarray(wi, dtype), jnp.asarray(u, dtype))

    for cos in (1.0, 0.7, 0.05, 1e-3):
        wi = np.array([np.sqrt(1 - cos * cos), 0, cos])
        for alpha in (1e-3, 1e-2):
            single = drawn(alpha, np.float32, wi)
            with x64():
                double = drawn(alpha, np.float64, wi)
            # In the tails of GGX, which reach all directions, 1 - u has fewer digits.
            np.testing.assert_allclose(single.wo, double.wo, atol=1e-4)
            # Where wo is near the horizon its cosine has lost digits, and so has the share of visible facets.
            clear = np.asarray(double.wo)[:, 2] > 0.3 * alpha
            np.testing.assert_allclose(
                np.asarray(single.weight)[clear], np.asarray(double.weight)[clear], rtol=1e-5 + 5e-6 / alpha
            )
            # For Beckmann, G1 is within 0.35 % of its exact value, which the density uses.
            most = 1.0035 if distribution == "beckmann" else 1 + 1e-5
            assert (np.asarray(single.weight) >= 0).all() and (np.asarray(single.weight) <= most).all()


GLASS = {"int_ior": 1.5, "ext_ior": 1.0}
TINTS = {"specular_reflectance": np.array([0.5, 0.9, 1.0]), "specular_transmittance": np.array([1.0, 0.4, 0.7])}


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize("values", [{"alpha": 0.3, **GLASS}, {**BRUSHED, "int_ior": 1.0, "ext_ior": 2.4}], ids=str)
def test_values_and_densities_of_rough_glass_are_mitsubas(distribution, values, mitsuba_values):
    """For reflection and refraction, from outside and from inside."""
    values = {**values, **TINTS, "distribution": distribution}
    wi, wo = pairs(400)
    wi[::2, 2] *= -1
    wo[::3, 2] *= -1
    f, pdf = ours(RoughDielectric, values, wi, wo)
    expected, density = mitsuba_values("roughdielectric", values, wi, wo)
    np.testing.assert_allclose(f, expected, rtol=5e-4, atol=1e-7)
    np.testing.assert_allclose(pdf, density, rtol=4e-3 if distribution == "beckmann" else 5e-4, atol=1e-7)


@pytest.mark.parametrize(
    "values",
    [
        pytest.param({"alpha": 0.3, **GLASS}, marks=slow),
        pytest.param({"alpha": 0.3, **TINTS, "int_ior": 1.33, "ext_ior": 2.4}, marks=slow),
        pytest.param({**BRUSHED, "int_ior": 1.0, "ext_ior": 1.7}, marks=slow),
    ],
)
def test_rough_glass_passes_the_checks_of_all_kinds(values):
    testing.check_bsdf(RoughDielectric, samples=20_000, **values)


@slow
@pytest.mark.parametrize("values", [{"alpha": 0.3, **GLASS}, {**BRUSHED, "int_ior": 1.33, "ext_ior": 2.4}], ids=str)
def test_rough_glass_of_ggx_passes_the_checks_but_for_derivatives_in_its_ior(values, monkeypatch):
    """GGX has upright facets, so f ends at an edge at grazing angles. Differences see the edge and samples do not; the
    midpoint rule resolves it with more points."""
    monkeypatch.setattr(testing, "POINTS", 60)
    materials = testing.material(RoughDielectric, distribution="ggx", **values)
    for wi in testing.directions(RoughDielectric):
        testing.check_range(materials, wi)
        testing.check_weights(materials, wi)
        testing.check_furnace(materials, wi, 100_000, 1e-4)
        testing.check_detached(materials, wi)
        testing.check_chi_square(materials, wi, 100_000, 1e-4)


def test_rough_glass_is_reciprocal_through_and_through():
    """Radiance / n^2 is conserved: f(wi, wo) n_o^2 = f(wo, wi) n_i^2, with the IOR on the side of each direction."""
    values = {"alpha": 0.3, "distribution": "ggx", **GLASS}
    wi, wo = pairs(300)
    wo[:, 2] *= -1
    there, back = ours(RoughDielectric, values, wi, wo)[0], ours(RoughDielectric, values, wo, wi)[0]
    # wi is outside, where n = 1; `ours` includes the cosine of its second direction.
    np.testing.assert_allclose(there / abs(wo[:, 2:]) * 1.5**2, back / abs(wi[:, 2:]), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
def test_rough_glass_of_small_roughness_acts_as_smooth_glass(distribution):
    """At roughness 1e-3 both lobes have the mean weights of smooth glass, from both sides and at the critical angle."""
    rough = testing.material(RoughDielectric, alpha=1e-3, distribution=distribution, **GLASS)
    smooth = testing.material(Dielectric, **GLASS)
    for wi in testing.directions(RoughDielectric):
        means = []
        for materials in (rough, smooth):
            drawn = testing.sample(materials, wi, testing.random_numbers(materials, 20_000, 1))
            reflected = np.asarray(drawn.wo)[:, 2] * wi[2] > 0
            weight = np.asarray(drawn.weight, np.float64)[:, 0]
            means.append([np.mean(weight * reflected), np.mean(weight * ~reflected)])
        # 4 standard deviations of 20,000 choices; the roughness changes angles by 1e-3, and the reflectance by less.
        np.testing.assert_allclose(*means, atol=4 * 0.5 / np.sqrt(20_000) * 2.25)


# ---- towards smooth surfaces ----------------------------------------------------------------------------------------

MIRRORED = """<shape type="rectangle"><transform name="to_world"><scale value="3"/><rotate x="1" angle="-90"/>
  <translate y="-1"/></transform><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
  <transform name="to_uv"><scale value="4"/></transform></texture></bsdf></shape>
  <emitter type="constant"/><shape type="sphere"><bsdf type="{}" id="it">{}</bsdf></shape>"""
INSIDE = {
    "conductor": '<rgb name="eta" value="0.2, 0.9, 1.1"/><rgb name="k" value="3.9, 2.4, 2.2"/>',
    "dielectric": '<rgb name="specular_reflectance" value="0.9"/><rgb name="specular_transmittance" value="0.8"/>',
}
SMALL = '<float name="alpha" value="1e-3"/><string name="distribution" value="{}"/>'


@slow
@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize("kind", INSIDE)
def test_images_and_derivatives_of_small_roughnesses_are_those_of_smooth_surfaces(
    kind, distribution, make_scene, derivatives, agree
):
    """Roughness 1e-3 turns rays by about 1e-3, which is less than the noise at edges. The derivative in the logarithm
    of alpha is about alpha^2, which is 0 within the noise."""
    of = lambda kind, inside: make_scene(MIRRORED.format(kind, inside), res=16, origin="0, 1, 4")  # noqa: E731
    smooth, rough = of(kind, INSIDE[kind]), of(f"rough{kind}", INSIDE[kind] + SMALL.format(distribution))
    names = [name for name in pj.parameters(smooth) if name.startswith("it.") and "ior" not in name]
    (image, expected), (seen, found) = (
        derivatives(scene, [*names, *more], 64, 16, first_seed)
        for scene, more, first_seed in ((smooth, [], 1), (rough, ["it.alpha"], 101))
    )
    agree(seen, image, rounding=1e-3)
    for name in names:
        agree(found[name], expected[name], rounding=1e-3)
    agree(found["it.alpha"], np.zeros(3))


def test_derivatives_in_a_roughness_that_counts_as_a_larger_one_are_refused(make_scene):
    """No image changes with it, so gradient descent would never leave it."""
    scene = make_scene(MIRRORED.format("roughconductor", '<float name="alpha" value="0"/>'))
    with pytest.raises(pj.InputError, match=r"it\.alpha = 0 has no derivative: what is below 0\.0001 counts as that"):
        pj.jacobian(scene, ["it.alpha"])
    with pytest.raises(pj.InputError, match=r"it\.alpha = 0.* set a larger value"):
        jax.grad(lambda alpha: pj.render(pj.with_parameters(scene, {"it.alpha": alpha})).sum())(0.0)


def test_nothing_is_nan_between_nearly_equal_media():
    for ior in (1.0, 1 + 1e-7, 1.001):
        materials = testing.material(RoughDielectric, alpha=0.1, int_ior=ior, ext_ior=1.0)
        for wi in testing.directions(RoughDielectric):
            testing.check_range(materials, wi)


def test_a_pane_reflects_between_its_faces_any_number_of_times():
    """At normal incidence a slab transmits 2 n / (n^2 + 1) straight on, tinted, from both sides."""
    pane = testing.material(ThinDielectric, **TINTS, **GLASS)
    u = testing.random_numbers(pane, 20_000, 1)
    for z in (1.0, -1.0):
        drawn = testing.sample(pane, np.array([0, 0, z], np.float32), u)
        passed = np.asarray(drawn.wo)[:, 2] * z < 0
        through = 2 * 1.5 / (1.5**2 + 1)
        assert np.asarray(drawn.pdf)[passed][0] == pytest.approx(through, rel=1e-6)
        assert passed.mean() == pytest.approx(through, abs=4 * np.sqrt(through * (1 - through) / len(u)))
        np.testing.assert_allclose(np.asarray(drawn.weight)[passed][0], TINTS["specular_transmittance"], rtol=1e-6)
        np.testing.assert_allclose(np.asarray(drawn.weight)[~passed][0], TINTS["specular_reflectance"], rtol=1e-6)
    oblique = testing.directions(ThinDielectric)[1]
    drawn = testing.sample(pane, oblique, u)
    np.testing.assert_array_equal(np.unique(drawn.wo, axis=0), np.sort([-oblique, oblique * [-1, -1, 1]], axis=0))


def test_thin_panes_pass_the_checks_of_all_kinds():
    testing.check_bsdf(ThinDielectric, samples=20_000, **TINTS)


def test_lobes_of_glass_have_their_colours_where_some_are_given():
    plain, tinted = testing.material(Dielectric, **GLASS), testing.material(Dielectric, **GLASS, **TINTS)
    assert plain.tables[0].column("specular_reflectance") is None
    u = testing.random_numbers(plain, 1000, 1)
    for wi in testing.directions(Dielectric):
        a, b = (testing.sample(materials, wi, u) for materials in (plain, tinted))
        reflected = (np.asarray(a.wo)[:, 2] * wi[2] > 0)[:, None]
        tint = np.where(reflected, TINTS["specular_reflectance"], TINTS["specular_transmittance"])
        np.testing.assert_allclose(b.weight, a.weight * tint, rtol=1e-6)
        np.testing.assert_array_equal(b.passive, a.passive)


def test_glass_without_colours_among_tinted_glass_has_ones():
    glass = tables(Dielectric.instance("a", **GLASS), Dielectric.instance("b", **GLASS, **TINTS)).tables[0]
    np.testing.assert_allclose(glass.column("specular_transmittance").values, [[1, 1, 1], [1, 0.4, 0.7]])


SPLIT = """<scene version="3.0.0">
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>
  <shape type="sphere"><bsdf type="roughdielectric" id="it"/></shape>
  <emitter type="constant" id="sky"/>
</scene>"""


def test_rough_glass_is_no_smooth_interface_to_splitting_and_derivatives(tmp_path):
    """Paths do not split there, and its IOR is an ordinary parameter, which moves no paths."""
    file = tmp_path / "scene.xml"
    file.write_text(SPLIT)
    scene = pj.load_scene(file)
    programs = (jax.make_jaxpr(lambda s, n=n: pj.render(s, spp=4, split_depth=n))(scene) for n in (0, 2))
    assert len(set(map(str, programs))) == 1
    assert not any(parameter.moves_paths for parameter in scene.about.parameters.values())
    assert "it.int_ior" in pj.parameters(scene) and "it.specular_reflectance" not in pj.parameters(scene)


def tables(*instances):
    return bsdfs.build(list(instances), np.float32, (), Parameters())


def test_what_differs_in_settings_has_a_table_of_its_own():
    kinds = tables(
        RoughConductor.instance("a"),
        RoughConductor.instance("b", distribution="ggx", **BRUSHED),
        RoughConductor.instance("c", distribution="ggx"),
        RoughConductor.instance("d", alpha=0.5),
    )
    assert [len(table.column("specular_reflectance").values) for table in kinds.tables] == [2, 1, 1]
    assert [dict(table.settings)["distribution"] for table in kinds.tables] == ["beckmann", "ggx", "ggx"]
    assert [bsdfs.occurs(tables(RoughConductor.instance(**v)), "anisotropic") for v in ({}, BRUSHED)] == [False, True]
    assert {bsdfs.name(kinds, i) for i in range(3)} == {"roughconductor"}


def test_named_metals_have_mitsubas_numbers():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    for name, numbers in METALS.items():
        made = mi.traverse(mi.load_dict({"type": "conductor", "material": name}))
        np.testing.assert_allclose(numbers, [made["eta.value"], made["k.value"]], rtol=1e-5, err_msg=name)
