"""Burley's principled bsdfs: the checks of all kinds, values against Mitsuba's, extremes, and what is compiled."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.bsdfs import Principled, PrincipledThin
from pathjax.bsdfs.principled import ClearPrincipled

ORANGE = {"base_color": np.array([0.9, 0.3, 0.1])}
FABRIC = {**ORANGE, "sheen": 0.8, "sheen_tint": 0.4, "flatness": 0.6, "roughness": 0.9}
BRUSHED = {**ORANGE, "metallic": 0.6, "anisotropic": 0.7, "roughness": 0.7, "spec_tint": 0.4}
CAR = {**ORANGE, "clearcoat": 0.8, "clearcoat_gloss": 0.05, "specular": 0.8}
FROSTED = {**ORANGE, "spec_trans": 0.7, "eta": 1.5, "roughness": 0.8}
ALL = {**BRUSHED, "spec_trans": 0.6, "sheen": 0.5, "sheen_tint": 0.5, "flatness": 0.4, "clearcoat": 0.5, "eta": 1.4}
LEAF = {**ORANGE, "diff_trans": 0.8, "roughness": 0.7, "flatness": 0.3}
PANE = {**ORANGE, "spec_trans": 0.7, "roughness": 0.8, "eta": 1.4}
THIN = {**PANE, **LEAF, "anisotropic": 0.5, "spec_tint": 0.6, "sheen": 0.5, "sheen_tint": 0.5}
slow = pytest.mark.slow


def kind_of(values):
    return ClearPrincipled if "spec_trans" in values else Principled


def evaluated(kind, values, wi, wo):
    """Return values (N, 3) and densities (N,)."""
    materials, zero = testing.material(kind, **values), jnp.int32(0)

    def of_pair(wi, wo):
        return bsdfs.evaluate(materials, zero, zero, testing._SURFACE, wi, wo)

    return jax.jit(jax.vmap(of_pair))(jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))


@pytest.mark.parametrize(
    "values",
    [
        pytest.param({}, marks=slow),
        pytest.param({**ORANGE, "metallic": 1.0, "roughness": 0.6}, marks=slow),
        pytest.param(BRUSHED, marks=slow),
        pytest.param(CAR, marks=slow),
        pytest.param(FROSTED, marks=slow),
        pytest.param(ALL, marks=slow),
    ],
    ids=str,
)
def test_principled_passes_the_checks_of_all_kinds(values):
    """The lobe of a coat is too narrow for the quadrature that the rest of `check_bsdf` relies on."""
    kind = kind_of(values)
    materials = testing.material(kind, **values)
    for wi in testing.directions(kind):
        testing.check_range(materials, wi)
        testing.check_weights(materials, wi)
        testing.check_detached(materials, wi)
        testing.check_chi_square(materials, wi, 50_000, 1e-4)
        if "clearcoat" not in values:
            testing.check_furnace(materials, wi, 50_000, 1e-4)
            testing.check_derivatives(materials, wi, 50_000, 1e-4)
    testing.check_reciprocity(materials)


@slow
def test_all_lobes_are_drawn_with_the_density_that_is_stated():
    materials = testing.material(ClearPrincipled, **ALL)
    for wi in testing.directions(ClearPrincipled)[1::3]:  # one from each side
        testing.check_weights(materials, wi)
        testing.check_chi_square(materials, wi, 20_000, 1e-4)


@slow
def test_sheen_may_send_back_more_than_arrives_but_is_drawn_right():
    materials = testing.material(Principled, **FABRIC)
    for wi in testing.directions(Principled):
        testing.check_chi_square(materials, wi, 50_000, 1e-4)
        testing.check_derivatives(materials, wi, 50_000, 1e-4)


EXTREMES = [
    {"roughness": r, **share} for r in (0.0, 1.0) for share in ({"metallic": 1.0}, {"spec_trans": 1.0}, {"sheen": 1.0})
]


@slow
@pytest.mark.parametrize("values", EXTREMES, ids=str)
@pytest.mark.parametrize("base_color", [0.0, 1.0])
def test_extremes_are_finite(values, base_color):
    more = {} if "metallic" in values else {"clearcoat": 1.0, "clearcoat_gloss": 1.0, "specular": 0.0, "spec_tint": 1.0}
    kind = kind_of(values)
    materials = testing.material(kind, base_color=base_color, **values, **more)
    for wi in testing.directions(kind):
        testing.check_range(materials, wi)


def pairs(n, seed=1, both=True):
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in np.random.default_rng(seed).normal(size=(2, n, 3)))
    if not both:
        wi[:, 2] = abs(wi[:, 2])
    return wi, wo


@pytest.mark.parametrize(
    "values",
    [
        ALL,
        FABRIC,
        pytest.param({}, marks=slow),
        pytest.param(BRUSHED, marks=slow),
        pytest.param(CAR, marks=slow),
        pytest.param(FROSTED, marks=slow),
        pytest.param({**ORANGE, "clearcoat": 1.0, "clearcoat_gloss": 0.9}, marks=slow),
        pytest.param({**ORANGE, "eta": 0.7, "metallic": 0.3, "spec_tint": 0.4}, marks=slow),
        pytest.param({**ORANGE, "spec_trans": 0.3, "eta": 0.7, "roughness": 0.3}, marks=slow),
        pytest.param({"spec_trans": 0.5, "specular": 0.0, "roughness": 1.0}, marks=slow),
        pytest.param({"roughness": 0.0}, marks=slow),
    ],
    ids=str,
)
def test_values_are_those_of_mitsuba(mitsuba_values, values):
    """From both sides. Densities differ, since lobes are chosen differently."""
    wi, wo = pairs(300, both="spec_trans" in values)
    f, _ = evaluated(kind_of(values), values, wi, wo)
    expected, _ = mitsuba_values("principled", values, wi, wo)
    # Mitsuba's luminance weights have other digits, and for smooth coats the half vector's rounding changes D.
    np.testing.assert_allclose(f, expected, rtol=2e-3, atol=1e-6)
    assert (expected > 0).any()


@pytest.mark.parametrize(
    "values",
    [
        THIN,
        pytest.param({}, marks=slow),
        pytest.param(LEAF, marks=slow),
        pytest.param(PANE, marks=slow),
        pytest.param({**PANE, "roughness": 0.2, "eta": 1.8, "spec_trans": 1.0}, marks=slow),
        pytest.param({**LEAF, "diff_trans": 2.0}, marks=slow),
    ],
    ids=str,
)
def test_values_of_thin_ones_are_those_of_mitsuba(mitsuba_values, values):
    wi, wo = pairs(300)
    f, _ = evaluated(PrincipledThin, values, wi, wo)
    expected, _ = mitsuba_values("principledthin", values, wi, wo)
    np.testing.assert_allclose(f, expected, rtol=2e-3, atol=1e-6)


@slow
@pytest.mark.parametrize("values", [{}, LEAF, PANE, THIN, {**LEAF, "diff_trans": 2.0}], ids=str)
def test_thin_ones_pass_the_checks_of_all_kinds(values):
    materials = testing.material(PrincipledThin, **values)
    for wi in testing.directions(PrincipledThin):
        testing.check_range(materials, wi)
        testing.check_weights(materials, wi)
        testing.check_detached(materials, wi)
        testing.check_chi_square(materials, wi, 50_000, 1e-4)
        testing.check_derivatives(materials, wi, 50_000, 1e-4)
        if "sheen" not in values:
            testing.check_furnace(materials, wi, 50_000, 1e-4)
    testing.check_reciprocity(materials)


@slow
@pytest.mark.parametrize("roughness", [0.0, 1.0])
def test_extremes_of_thin_ones_are_finite(roughness):
    for share in (0.0, 1.0):
        values = {"base_color": share, "spec_trans": 1 - share / 2, "diff_trans": 2 * share, "sheen": 1.0}
        materials = testing.material(PrincipledThin, roughness=roughness, **values)
        for wi in testing.directions(PrincipledThin):
            testing.check_range(materials, wi)


@pytest.mark.parametrize(
    ("kind", "name", "share"),
    [(kind, "spec_trans", share) for kind in (PrincipledThin, ClearPrincipled) for share in (0.0, 1.0)]
    + [(Principled, "metallic", 1.0)],
)
def test_lobes_without_a_share_are_drawn_for_their_derivative_in_it(kind, name, share):
    """Facets this smooth sample none of the directions of the base, and the base none of the light they transmit."""
    wi, wo = pairs(300, both=kind is not Principled)
    values = {**ORANGE, "roughness": 0.3 * (1 - share)}
    _, density = evaluated(kind, {**values, name: share}, wi, wo)
    half, _ = evaluated(kind, {**values, name: 0.5}, wi, wo)
    assert (half > 0).any()
    assert (np.asarray(density)[:, None] >= 1e-3 * np.asarray(half)).all()


# ---- files ----------------------------------------------------------------------------------------------------------


def scene_with(make_scene, inside, more=""):
    return make_scene(
        f'<shape type="sphere"><bsdf type="principled" id="it">{inside}</bsdf></shape>{more}<emitter type="constant"/>',
        res=4,
    )


def number(name, value):
    return f'<float name="{name}" value="{value}"/>'


def test_what_is_0_is_no_parameter_and_is_left_out_of_the_program(make_scene):
    plain = scene_with(make_scene, "")
    noughts = scene_with(make_scene, "".join(number(n, 0) for n in ("metallic", "sheen", "spec_trans", "clearcoat")))
    assert list(pj.parameters(plain)) == list(pj.parameters(noughts))
    assert [name for name in pj.parameters(plain) if name.startswith("it.")] == [
        "it.base_color",
        "it.roughness",
        "it.specular",
    ]
    assert jax.tree.structure(pj.scene.parameters.nameless(plain)) == jax.tree.structure(
        pj.scene.parameters.nameless(noughts)
    )


def test_clear_and_opaque_ones_are_told_apart(make_scene):
    glass = (
        '<shape type="sphere"><bsdf type="principled" id="glass"><float name="spec_trans" value="1"/></bsdf></shape>'
    )
    scene = scene_with(make_scene, number("eta", 1.7), glass)
    materials = scene.materials
    assert [table.kind for table in materials.tables] == [Principled, ClearPrincipled]
    assert [bsdfs.name(materials, k) for k in (0, 1)] == ["principled", "principled"]
    assert [bool(bsdfs.has(materials, jnp.int32(k), "sided")) for k in (0, 1)] == [False, True]
    assert float(pj.parameters(scene)["it.eta"]) == pytest.approx(1.7)
    assert not bsdfs.occurs(materials, "anisotropic")
    with pytest.raises(pj.InputError, match="cannot stand inside"):
        make_scene(f'<shape type="sphere"><bsdf type="twosided">{glass.partition(">")[2][:-8]}</bsdf></shape>')


@pytest.mark.parametrize(
    "inside, words",
    [
        (number("roughness", 1.5), "at most 1, is 1.5"),
        (number("metallic", -0.1), "at least 0"),
        (number("eta", 0), "eta"),
        (number("eta", 1.5) + number("specular", 0.5), "cannot stand beside eta"),
        (number("metalic", 1), 'did you mean "metallic"'),
        ('<rgb name="base_color" value="2, 0, 0"/>', "between 0 and 1"),
    ],
)
def test_what_is_out_of_range_is_refused(make_scene, inside, words):
    with pytest.raises(pj.InputError, match=words):
        scene_with(make_scene, inside)


@slow
def test_derivatives_of_an_image_are_those_of_independent_images(make_scene, estimate, derivatives, agree):
    """Central differences of images with other seeds, in every parameter."""
    values = {name: value for name, value in ALL.items() if name != "base_color"}
    inside = "".join(number(name, value) for name, value in values.items()) + number("clearcoat_gloss", 0.1)
    scene, step = scene_with(make_scene, inside + '<rgb name="base_color" value="0.8, 0.4, 0.2"/>'), 0.05
    names = [name for name in pj.parameters(scene) if name.startswith("it.")]
    assert len(names) == 12
    _, slopes = derivatives(scene, names, 512, 12)
    for name in names:
        value = np.asarray(pj.parameters(scene)[name])
        ahead, behind = (
            estimate(pj.with_parameters(scene, {name: value + s * step}), 512, 12, 100 + 50 * s, scale=1 / (2 * step))
            for s in (1, -1)
        )
        difference = ahead._replace(mean=ahead.mean - behind.mean, variance=ahead.variance + behind.variance)
        agree(slopes[name], difference, rounding=3e-2)
