"""Rough plastic and its coat: closed forms, the checks of all kinds, derivatives, and values against Mitsuba's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.bsdfs import RoughPlastic, coat, fresnel

COLORS = {"diffuse_reflectance": np.array([0.9, 0.3, 0.0]), "specular_reflectance": np.array([0.2, 0.5, 1.0])}
COSINES = np.array([0.02, 0.1, 0.3, 0.6, 1.0], np.float32)
slow = pytest.mark.slow


def transmitted(distribution, alpha, eta):
    """Return T at COSINES, and the share reflected inside."""
    made = coat.coats(distribution, np.array([alpha]), np.array([eta]))[0]

    @jax.jit
    def of(made):
        terms, share = coat.at(made, alpha, eta)
        return jax.vmap(lambda mu: coat.passes(terms, mu))(COSINES), share

    T, share = of(jnp.asarray(made))
    return np.asarray(T), float(share)


# ---- coats ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("eta, error", [(1.5, 2e-3), (1 / 1.5, 2e-2)])
def test_a_smooth_coat_passes_what_fresnel_says(eta, error):
    """Where eta is below 1, nothing passes at the first four cosines."""
    T, share = transmitted("beckmann", 1e-4, eta)
    R = jax.vmap(lambda mu: fresnel.dielectric(mu, jnp.float32(eta))[0])(COSINES)
    np.testing.assert_allclose(T, 1 - R, atol=error)
    # Mitsuba's mean over 64 cosines is too low by 1/64 or more, mostly where only the last cosines reflect.
    reflected = 1 - float(fresnel.diffuse(jnp.float32(1 / eta)))
    assert share == pytest.approx(63 / 64 * reflected, rel=0.01 if eta > 1 else 0.1)


@pytest.mark.parametrize("eta", [1.6, 1 / 1.3])
@pytest.mark.parametrize(
    "distribution, alpha",
    [
        ("ggx", 0.6),
        ("beckmann", 0.05),
        pytest.param("ggx", 0.1, marks=slow),
        pytest.param("beckmann", 0.1, marks=slow),
        pytest.param("beckmann", 0.6, marks=slow),
    ],
)
def test_a_rough_coat_passes_what_its_facets_do(distribution, alpha, eta):
    """T is a mean over the normals that `microfacet` samples."""
    count, error = 40_000, 1e-3 if eta > 1 else 8e-3
    facets = bsdfs.microfacet.DISTRIBUTIONS[distribution].of(jnp.float32(alpha), jnp.float32(alpha))
    u = jnp.asarray(np.random.default_rng(1).random((count, 2)), jnp.float32)

    def passed(mu, u):
        wi = jnp.stack([jnp.sqrt(1 - mu * mu), 0 * mu, mu])
        m = facets.sample(wi, u)
        cos_i = jnp.clip(wi @ m, 0, 1)
        R, cos_t = fresnel.dielectric(cos_i, jnp.float32(eta))
        wo = (cos_i / eta - cos_t) * m - wi / eta
        down = wo * jnp.array([1, 1, -1])
        return (1 - R) * jnp.where(down[2] > 0, facets.seen(jnp.abs(wo)) * down[2], 0)

    values = np.asarray(jax.jit(jax.vmap(jax.vmap(passed, (None, 0)), (0, None)))(COSINES, u), float)
    T, _ = transmitted(distribution, alpha, eta)
    assert (abs(T - values.mean(1)) < 4.5 * values.std(1) / np.sqrt(count) + error).all()


@pytest.mark.parametrize("distribution", ["ggx", pytest.param("beckmann", marks=slow)])
def test_terms_are_linear_with_the_right_derivatives(distribution):
    """A kernel does not recompute the coat; its derivatives equal differences between recomputed coats."""
    alpha, eta, step = 0.3, 1.5, 0.01
    made = jnp.asarray(coat.coats(distribution, np.array([alpha]), np.array([eta]))[0])

    def of(alpha, eta):
        terms, share = coat.at(made, alpha, eta)
        return jnp.append(jax.vmap(lambda mu: coat.passes(terms, mu))(COSINES), share)

    slopes = jax.jacfwd(of, (0, 1))(alpha, eta)
    for slope, d in zip(slopes, np.eye(2), strict=True):
        changed = [np.array([alpha, eta]) + s * step * d for s in (1, -1)]
        ahead, behind = (np.append(*transmitted(distribution, *each)) for each in changed)
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), atol=5e-3)


# ---- the bsdf -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        pytest.param({"distribution": "ggx", "alpha": 0.4, "nonlinear": True}, marks=slow),
        pytest.param({**COLORS, "int_ior": 1.9, "alpha": 0.2}, marks=slow),
        pytest.param({"diffuse_reflectance": 0.99, "nonlinear": True, "alpha": 1.0}, marks=slow),
        pytest.param({"int_ior": 1.4, "ext_ior": 1.3}, marks=slow),
        pytest.param({"int_ior": 1.0, "ext_ior": 1.5, "alpha": 0.1}, marks=slow),
        {"int_ior": 1.0, "ext_ior": 1.3, "alpha": 0.3, "distribution": "ggx"},
    ],
)
def test_rough_plastic_passes_the_checks_of_all_kinds(values):
    testing.check_bsdf(RoughPlastic, samples=50_000, **values)


@slow
@pytest.mark.parametrize("distribution", ["beckmann", "ggx"])
def test_the_smoothest_the_roughest_and_none_are_finite(distribution):
    for values in ({"alpha": 0.0}, {"alpha": 1.0}, {"int_ior": 1.3, "ext_ior": 1.3}):
        materials = testing.material(RoughPlastic, distribution=distribution, **COLORS, **values)
        testing.check_range(materials, np.array([0.6, 0, 0.8], np.float32))


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"nonlinear": True, "distribution": "ggx", "alpha": 0.3},
        pytest.param({**COLORS, "int_ior": 1.9, "alpha": 0.6}, marks=slow),
        pytest.param({"alpha": 0.03}, marks=slow),
        pytest.param({"alpha": 1.0, "distribution": "ggx"}, marks=slow),
    ],
    ids=str,
)
def test_values_are_those_of_mitsuba(mitsuba_values, values):
    """Within 0.001 in the light that passes the coat; densities of Beckmann's normals differ by up to 0.35 %."""
    rng = np.random.default_rng(1)
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in rng.normal(size=(2, 200, 3)))
    wi[:, 2] = abs(wi[:, 2])
    wo[:100] = wi[:100] * [-1, -1, 1] + 0.05 * wo[:100]  # near the mirror direction
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    materials = testing.material(RoughPlastic, **values)

    def ours(wi, wo):
        return bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), testing._SURFACE, wi, wo)

    f, pdf = jax.jit(jax.vmap(ours))(jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))
    their_f, their_pdf = mitsuba_values("roughplastic", values, wi, wo)
    np.testing.assert_allclose(f, their_f, rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(pdf, their_pdf, rtol=5e-3, atol=1e-5)


def plate(make_scene, alpha, ior=1.5):
    return make_scene(
        f'<shape type="rectangle"><bsdf type="roughplastic" id="it"><float name="alpha" value="{alpha}"/>'
        f'<float name="int_ior" value="{ior}"/></bsdf></shape><emitter type="constant"/>',
        res=2,
    )


def test_a_coat_follows_its_parameters(make_scene):
    """A coat is computed for one alpha and one IOR; new values, traced or not, recompute it."""
    wanted = plate(make_scene, 0.5, 1.7)
    values = {"it.alpha": 0.5, "it.int_ior": 1.7}
    scenes = (
        pj.with_parameters(plate(make_scene, 0.1), values),
        jax.jit(lambda values: pj.with_parameters(plate(make_scene, 0.1), values))(values),
    )
    for scene in scenes:
        for ours, expected in zip(scene.materials.tables[0].columns, wanted.materials.tables[0].columns, strict=True):
            if expected is not None:
                np.testing.assert_allclose(ours.values, expected.values, atol=1e-5)


@pytest.mark.parametrize("distribution", ["beckmann", "ggx"])
@pytest.mark.parametrize("alpha, eta", [(0.05, 1 / 1.5), (0.1, 1 / 1.1), (0.3, 1 / 1.5)])
def test_light_that_is_reflected_totally_from_outside_is_that_of_mitsuba(mitsuba_values, distribution, alpha, eta):
    """Within 0.01 of the brightest value: both interpolate, Mitsuba between 64 cosines."""
    mu = np.linspace(0.02, 1, 40)
    wi = np.stack([np.sqrt(1 - mu * mu), 0 * mu, mu], 1)
    wo = np.tile([0.6, 0, 0.8], (40, 1)) if eta > 0.8 else np.tile([0, 0, 1.0], (40, 1))
    values = {"int_ior": eta, "ext_ior": 1.0, "alpha": alpha, "distribution": distribution}
    values |= {"diffuse_reflectance": np.array([0.9, 0.3, 0.1]), "specular_reflectance": np.zeros(3)}
    materials = testing.material(RoughPlastic, **values)

    def ours(wi, wo):
        return bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), testing._SURFACE, wi, wo)[0]

    f = jax.jit(jax.vmap(ours))(jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))
    theirs = mitsuba_values("roughplastic", values, wi, wo)[0]
    np.testing.assert_allclose(f, theirs, atol=0.012 * theirs.max())


@slow
def test_derivatives_of_an_image_are_those_of_independent_images(make_scene, estimate, derivatives, agree):
    """Central differences of images with other seeds; the truncation error is below the noise."""
    scene, step = plate(make_scene, 0.3), 0.05
    _, slopes = derivatives(scene, ["it.alpha", "it.int_ior"], 512, 16)
    for name, slope in slopes.items():
        value = float(pj.parameters(scene)[name])
        ahead, behind = (
            estimate(pj.with_parameters(scene, {name: value + s * step}), 512, 16, 100 + 50 * s, scale=1 / (2 * step))
            for s in (1, -1)
        )
        difference = ahead._replace(mean=ahead.mean - behind.mean, variance=ahead.variance + behind.variance)
        agree(slope, difference, rounding=2e-2)
