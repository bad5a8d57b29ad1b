"""Smooth plastic: the checks of all kinds, closed forms, derivatives, and values against Mitsuba's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.bsdfs import Plastic, PPlastic, fresnel

COLORS = {"diffuse_reflectance": np.array([0.9, 0.3, 0.0]), "specular_reflectance": np.array([0.2, 0.5, 1.0])}
slow = pytest.mark.slow


@slow
@pytest.mark.parametrize(
    "values",
    [
        {},
        {"nonlinear": True, "diffuse_reflectance": np.array([0.95, 0.5, 0.1])},
        {**COLORS, "int_ior": 1.9},
        {"int_ior": 1.3, "ext_ior": 1.3},
        {"int_ior": 1.0, "ext_ior": 1.5},
        {"int_ior": 9.0, "nonlinear": True, "diffuse_reflectance": 1.0},
        {"int_ior": 1e30, "nonlinear": True, "diffuse_reflectance": 1.0},
        {"int_ior": 1e5},
    ],
)
def test_plastic_passes_the_checks_of_all_kinds(values):
    testing.check_bsdf(Plastic, samples=50_000, **values)


def test_diffuse_light_that_passes_an_interface_is_its_integral():
    """1 - 2 integral R(cos) cos dcos, by the midpoint rule; the fits claim an error of 0.002."""
    cos = (np.arange(20_000) + 0.5) / 20_000
    for eta in (0.2, 0.4, 0.6, 0.67, 0.8, 1.1, 1.5, 2.4):
        R = jax.vmap(lambda c, eta=eta: fresnel.dielectric(c, jnp.float32(eta))[0])(jnp.asarray(cos, jnp.float32))
        exact = 1 - 2 * (np.asarray(R, float) * cos).mean()
        assert fresnel.diffuse(jnp.float32(eta)) == pytest.approx(exact, abs=2e-3), eta


def scattered(materials, wi):
    """Share of light that is scattered, (3,): the base by quadrature, the mirrored part in closed form."""
    table = materials.tables[0]
    inside, outside = (float(table.column(name).values[0]) for name in ("int_ior", "ext_ior"))
    n, cos_i = inside / outside, float(wi[2])
    cos_t = np.sqrt(1 - (1 - cos_i**2) / n**2)
    r_s, r_p = (cos_i - n * cos_t) / (cos_i + n * cos_t), (n * cos_i - cos_t) / (n * cos_i + cos_t)
    mirrored = (r_s**2 + r_p**2) / 2 * np.asarray(table.column("specular_reflectance").values[0], float)
    return testing._on_sphere(materials, wi)[0].sum(0) + mirrored


@pytest.mark.parametrize("nonlinear", [pytest.param(None, marks=slow), True])
def test_samples_scatter_what_base_and_coat_do_and_so_do_their_derivatives(nonlinear):
    """`check_bsdf` does not check the mean of the weights of bsdfs with Dirac lobes."""
    count, sigmas, step = 200_000, 4.5, 0.01
    materials = testing.material(Plastic, int_ior=1.7, nonlinear=nonlinear, **COLORS)
    u = testing.random_numbers(materials, count, 8)
    tangents = testing._material_tangents(materials)
    assert tangents.keys() == {"diffuse_reflectance", "specular_reflectance", "int_ior", "ext_ior"}
    for wi in testing.directions(Plastic):
        weights = np.asarray(testing.sample(materials, wi, u).weight, float)
        error = sigmas * weights.std(0) / np.sqrt(count) + 1e-3  # error of the quadrature
        assert (abs(weights.mean(0) - scattered(materials, wi)) < error).all()
        for name, tangent in tangents.items():
            moved = np.asarray(testing.sample_tangent(materials, tangent, wi, u).weight, float)
            ahead, behind = (scattered(testing._plus(materials, s * step, tangent), wi) for s in (1, -1))
            error = sigmas * moved.std(0) / np.sqrt(count) + 3e-3  # error of quadrature and differences
            assert (abs(moved.mean(0) - (ahead - behind) / (2 * step)) < error).all(), (name, wi)


def test_a_black_lobe_is_drawn_sometimes_so_that_its_derivative_is_known():
    wi = np.array([0.6, 0, 0.8], np.float32)
    for black in COLORS:
        materials = testing.material(Plastic, **{black: 0.0})
        u = testing.random_numbers(materials, 20_000, 9)
        moved = testing.sample_tangent(materials, testing._material_tangents(materials)[black], wi, u).weight
        assert np.asarray(moved).mean() > 0.01


# ---- beside Mitsuba -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values", [{}, {"nonlinear": True}, {**COLORS, "int_ior": 1.9}, {"int_ior": 1.0, "ext_ior": 1.5, "nonlinear": True}]
)
def test_values_and_densities_are_those_of_mitsuba(mitsuba_values, values):
    """Lobes are chosen as in Mitsuba, except where a reflectance is nearly black or textured."""
    rng = np.random.default_rng(1)
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in rng.normal(size=(2, 200, 3)))
    wi[:, 2] = abs(wi[:, 2])
    materials = testing.material(Plastic, **values)

    def ours(wi, wo):
        return bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), testing._SURFACE, wi, wo)

    f, pdf = jax.vmap(ours)(jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))
    their_f, their_pdf = mitsuba_values("plastic", values, wi, wo)
    np.testing.assert_allclose(f, their_f, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(pdf, their_pdf, rtol=1e-4, atol=1e-6)
    assert their_f.any()


# ---- pplastic -------------------------------------------------------------------------------------------------------

ADDED = [
    {},
    {**COLORS, "int_ior": 1.9, "alpha": 0.3, "distribution": "ggx"},
    # An IOR whose critical angle is not one of the checks' directions: there is no derivative at that angle.
    {"int_ior": 1.0, "ext_ior": 1.3, "alpha": 0.5},
    {"alpha_u": 0.1, "alpha_v": 0.5, "distribution": "ggx"},
]


@slow
@pytest.mark.parametrize("values", ADDED, ids=str)
def test_plastic_of_added_lobes_passes_the_checks_of_all_kinds(values):
    testing.check_bsdf(PPlastic, samples=50_000, **values)


@pytest.mark.parametrize("values", ADDED, ids=str)
def test_values_of_added_lobes_are_those_of_mitsuba(mitsuba_values, values):
    """Both use the same approximation of Beckmann's shadowing."""
    rng = np.random.default_rng(1)
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in rng.normal(size=(2, 200, 3)))
    wi[:, 2] = abs(wi[:, 2])
    wo[:100] = wi[:100] * [-1, -1, 1] + 0.05 * wo[:100]  # near the mirror direction
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    materials = testing.material(PPlastic, **values)

    def ours(wi, wo):
        return bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), testing._SURFACE, wi, wo)[0]

    f = jax.jit(jax.vmap(ours))(jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))
    np.testing.assert_allclose(f, mitsuba_values("pplastic", values, wi, wo)[0], rtol=2e-3, atol=1e-5)


def test_roughness_of_added_lobes_may_be_a_texture():
    wi, wo = (jnp.asarray(w, jnp.float32) / 3 for w in ([1, 2, 2], [-1, -2, 2]))

    def value(alpha):
        shape = {"type": "sphere", "bsdf": {"type": "pplastic", "alpha": alpha}}
        materials = pj.load_dict({"type": "scene", "ball": shape, "sky": {"type": "constant"}}).materials
        evaluate = jax.jit(lambda: bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), testing._SURFACE, wi, wo)[0])
        return evaluate()

    np.testing.assert_allclose(value(np.full((2, 2), 0.3)), value(0.3), rtol=1e-5)
