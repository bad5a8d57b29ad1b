"""Rough bsdfs: the checks of all kinds, values beside Mitsuba's, small roughnesses, and what scene files may say."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax import bsdfs, testing
from pathjax.bsdfs import RoughConductor
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
    """Directions (N, 3) above the surface; the first ones nearly in it."""
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
    # The half vector is rounded to 6e-8, and the logarithm of D changes with it by up to 1e3 of the smoothest.
    np.testing.assert_allclose(f, expected, rtol=2e-4, atol=1e-12)
    # Mitsuba's densities of Beckmann's normals hold the rational approximation, which errs by 0.35 %.
    np.testing.assert_allclose(pdf, density, rtol=4e-3 if distribution == "beckmann" else 2e-4, atol=1e-12)


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
def test_weights_of_small_roughnesses_are_right_in_float32(distribution, x64):
    """Down to 1e-3 as in float64, whose samples are mirrored at nearly the same normals."""
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
            # In the tails of GGX, which reach all directions, what is left of 1 - u has fewer digits.
            np.testing.assert_allclose(single.wo, double.wo, atol=1e-4)
            # Where wo lies nearly in the surface its cosine has lost digits, and with it the share of facets seen.
            clear = np.asarray(double.wo)[:, 2] > 0.3 * alpha
            np.testing.assert_allclose(
                np.asarray(single.weight)[clear], np.asarray(double.weight)[clear], rtol=1e-5 + 5e-6 / alpha
            )
            # Of Beckmann's normals G1 is within 0.35 % of what the density holds.
            most = 1.0035 if distribution == "beckmann" else 1 + 1e-5
            assert (np.asarray(single.weight) >= 0).all() and (np.asarray(single.weight) <= most).all()


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
