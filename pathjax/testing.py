"""Checks that every kind must pass: the package's kinds in its tests, users' registered kinds in theirs.

    from pathjax import testing
    testing.check_bsdf(OrenNayar, sigma=0.3)
    testing.check_texture(Stripes, color0=0.1)
    testing.check_emitter(Sunset, radiance=3.0)
    testing.check_phase(Rayleigh)

A check that fails raises an AssertionError with the value found and the expected one. Each statistical check fails for
a correct bsdf with the probability `false_alarm`; seeds are fixed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import bsdfs, textures
from pathjax.bsdfs import BSDF, Materials
from pathjax.emitters import Emitter
from pathjax.emitters.selection import AllRows
from pathjax.kinds import Parameters, Row, Table
from pathjax.media import Phase
from pathjax.textures import Texture, Textures

# Directions of grazing and steep light; `directions` adds an azimuth without symmetry.
COSINES = (1.0, 0.7, 0.2)
# Cells of the sphere, in the polar angle and the azimuth, and points of the midpoint rule per cell in each of the two.
CELLS, POINTS = (20, 24), 12
# Cells with fewer expected samples are merged: the chi-square distribution is an approximation.
LEAST_EXPECTED = 10
# Step of finite differences: float32 keeps five digits of them, and their error is of second order.
STEP = 0.01
FEW = 2000  # samples of checks that test each sample; they share compiled functions
# The only field of a surface that kinds of the package read: where textures are looked up.
_SURFACE = SimpleNamespace(uv=jnp.full(2, 0.5, jnp.float32))


# ---- bsdfs ----------------------------------------------------------------------------------------------------------


def check_bsdf(kind: type[BSDF], samples: int = 200_000, false_alarm: float = 1e-4, reciprocal: bool = True, **values):
    """Run all checks that apply to a kind of bsdf with constant parameters.

    Args:
        samples: number of samples of each statistical check.
        reciprocal: whether f(wi, wo) should equal f(wo, wi).
        values: parameters that differ from their defaults.
    Raises:
        AssertionError: a check failed.
    """
    materials = material(kind, **values)
    for wi in directions(kind):
        check_range(materials, wi)
        check_weights(materials, wi)
        check_furnace(materials, wi, samples, false_alarm)
        check_detached(materials, wi)
        if kind.smooth:
            check_chi_square(materials, wi, samples, false_alarm)
        if kind.smooth and not kind.delta:
            check_derivatives(materials, wi, samples, false_alarm)
    if kind.smooth and reciprocal:
        check_reciprocity(materials)


def material(kind: type[BSDF], **values) -> Materials:
    """Return materials of one shape with a bsdf of this kind on both sides; other parameters have their defaults."""
    return jax.device_put(bsdfs.build([kind.instance("it", **values)], np.float32, (), Parameters()))


def directions(kind: type[BSDF]) -> list[np.ndarray]:
    """Return unit directions wi (3,), on both sides if the kind distinguishes them."""
    cosines = [*COSINES, *(-z for z in COSINES)] if kind.sided else COSINES
    return [np.array([math.sqrt(1 - z * z) * 0.6, math.sqrt(1 - z * z) * 0.8, z], np.float32) for z in cosines]


@jax.jit
def sample(materials: Materials, wi, u):
    """Sample the first bsdf for each of u (N, 2 or 3)."""
    return jax.vmap(lambda u: bsdfs.sample(materials, jnp.int32(0), jnp.int32(0), _SURFACE, wi, u))(u)


@jax.jit
def evaluate(materials: Materials, wi, wo):
    """Return values (N, 3) and densities (N,) of the first bsdf for each of wo (N, 3)."""
    return jax.vmap(lambda wo: bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), _SURFACE, wi, wo))(wo)


@jax.jit
def sample_tangent(materials: Materials, tangent: Materials, wi, u):
    """Return the tangent of the samples for a tangent of the materials."""
    return jax.jvp(lambda m: sample(m, wi, u), (materials,), (tangent,))[1]


def random_numbers(materials: Materials, count: int, seed: int):
    """Return uniform numbers in [0, 1): (count, 2), or (count, 3) if the bsdf needs three."""
    width = 3 if bsdfs.occurs(materials, "lobes") else 2
    return jnp.asarray(np.random.default_rng(seed).integers(0, 1 << 24, (count, width)) * 2.0**-24, jnp.float32)


def check_range(materials: Materials, wi):
    """Check that values, pdfs, weights are finite and >= 0, and derivatives finite, also at the ends of all ranges."""
    ends = np.array([0, 2**-24, 0.5, 1 - 2**-24], np.float32)
    width = random_numbers(materials, 1, 0).shape[1]
    u = jnp.asarray(np.resize(np.stack(np.meshgrid(*[ends] * width), -1), (FEW, width)))
    grazing = [np.array([math.sqrt(1 - z * z), 0, z], np.float32) for z in (1e-4, 1e-7, 0.0)]
    for each in [wi, *grazing]:
        drawn = sample(materials, each, u)
        f, pdf = evaluate(materials, each, drawn.wo)
        for what, x in {"weight": drawn.weight, "pdf": drawn.pdf, "value": f, "density": pdf}.items():
            assert np.isfinite(x).all() and (np.asarray(x) >= 0).all(), f"a {what} of wi = {each} is {np.min(x)}"
        assert np.isfinite(drawn.wo).all(), f"a direction of wi = {each} is not finite"
        for name, tangent in _material_tangents(materials).items():
            moved = sample_tangent(materials, tangent, each, u).weight
            assert np.isfinite(moved).all(), f"the derivative of a weight in {name} is not finite at wi = {each}"


def check_weights(materials: Materials, wi):
    """Check that sampled directions are unit, and that weight times density is the value of `evaluate`."""
    drawn = sample(materials, wi, random_numbers(materials, FEW, 1))
    length = np.linalg.norm(drawn.wo, axis=1)
    assert np.allclose(length, 1, atol=1e-5), f"a direction has length {length[np.argmax(abs(length - 1))]}"
    kept = ~np.asarray(drawn.delta) & (np.asarray(drawn.pdf) > 0)
    f, pdf = evaluate(materials, wi, drawn.wo)
    # The two may differ only by the rounding of a cosine near 0.
    for what, ours, theirs in (("pdf", drawn.pdf, pdf), ("weight * pdf", drawn.weight * drawn.pdf[:, None], f)):
        ours, theirs = np.asarray(ours)[kept], np.asarray(theirs)[kept]
        wrong = ~np.isclose(ours, theirs, rtol=1e-3, atol=1e-5)
        assert not wrong.any(), f"{what} is {ours[wrong][0]} of a sample, {theirs[wrong][0]} of evaluate, at wi = {wi}"


def check_chi_square(materials: Materials, wi, samples: int, false_alarm: float, seed: int = 2):
    """Check that directions are drawn with the density that `evaluate` returns."""
    drawn = sample(materials, wi, random_numbers(materials, samples, seed))
    kept = ~np.asarray(drawn.delta) & (np.asarray(drawn.pdf) > 0)
    _, pdf = _on_sphere(materials, wi)
    _chi_square(np.asarray(drawn.wo)[kept], samples, pdf, false_alarm, f"wi = {wi}")


def _chi_square(directions, samples: int, shares, false_alarm: float, where: str):
    """Check that directions (N, 3), those kept of `samples`, fall into cells by their `shares` at the midpoints."""
    from scipy import stats

    directions = np.asarray(directions, np.float64)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) % 1
    polar = np.arccos(directions[:, 2].clip(-1, 1)) / np.pi
    seen = np.histogram2d(polar, azimuth, CELLS, [[0, 1], [0, 1]])[0].ravel()
    expected = samples * shares.reshape(CELLS[0], POINTS, CELLS[1], POINTS).sum((1, 3)).ravel()
    # Samples that are not drawn from the density (Dirac lobes, no sample) form a cell of their own.
    seen, expected = np.append(seen, samples - seen.sum()), np.append(expected, samples - expected.sum())
    few = expected < LEAST_EXPECTED
    seen = np.append(seen[~few], seen[few].sum())
    expected = np.append(expected[~few], max(expected[few].sum(), 0))
    used = expected > LEAST_EXPECTED
    statistic = ((seen - expected)[used] ** 2 / expected[used]).sum()
    # With a single cell, all samples fall into it.
    chance = stats.chi2.sf(statistic, used.sum() - 1) if used.sum() > 1 else 1.0
    assert chance > false_alarm, f"samples do not follow the stated density at {where}: p = {chance:.2g}"
    assert seen[~used].sum() <= 5 * LEAST_EXPECTED, f"{seen[~used].sum():.0f} samples lie where the density is 0"


def check_furnace(materials: Materials, wi, samples: int, false_alarm: float, seed: int = 3):
    """Check that no more light leaves than arrives, and as much as `evaluate` integrates to if it covers all lobes."""
    kind = materials.tables[0].kind
    drawn = sample(materials, wi, random_numbers(materials, samples, seed))
    # Light that crosses an interface is measured in power, which does not depend on the IOR.
    share = np.asarray(drawn.weight, np.float64) / np.asarray(drawn.passive, np.float64)[:, None]
    mean, error = share.mean(0), share.std(0) / math.sqrt(samples)
    limit = _sigmas(false_alarm) * error + 1e-5  # rounding of weights of 1
    assert (mean <= 1 + limit).all(), f"{mean.max():.5f} of the light is scattered at wi = {wi}"
    if kind.smooth and not kind.delta:
        f, _ = _on_sphere(materials, wi)
        # In terms of radiance, like both weight and f.
        weight = np.asarray(drawn.weight, np.float64)
        mean, error = weight.mean(0), weight.std(0) / math.sqrt(samples)
        limit = _sigmas(false_alarm) * error + 1e-3 * f.sum(0) + 1e-5  # error of the midpoint rule; rounding
        assert (abs(mean - f.sum(0)) <= limit).all(), (
            f"samples scatter {mean} of the light, evaluate {f.sum(0)}, at wi = {wi}"
        )


def check_reciprocity(materials: Materials, seed: int = 4):
    """Check that f(wi, wo) = f(wo, wi)."""
    rng = np.random.default_rng(seed)
    pairs = rng.normal(size=(2, 500, 3))
    pairs[..., 2] = abs(pairs[..., 2]) + 0.05
    a, b = jnp.asarray(pairs / np.linalg.norm(pairs, axis=-1, keepdims=True), jnp.float32)

    def f(wi, wo):
        return bsdfs.evaluate(materials, jnp.int32(0), jnp.int32(0), _SURFACE, wi, wo)[0] / wo[2]

    there, back = (np.asarray(jax.jit(jax.vmap(f))(*pair)) for pair in ((a, b), (b, a)))
    wrong = ~np.isclose(there, back, rtol=1e-3, atol=1e-6)
    assert not wrong.any(), f"f is {there[wrong][0]} one way and {back[wrong][0]} the other"


def check_detached(materials: Materials, wi):
    """Check that directions and densities carry no derivative in parameters; only the weights do."""
    u = random_numbers(materials, FEW, 5)
    for name, tangent in _material_tangents(materials, but_moving=True).items():
        drawn = sample_tangent(materials, tangent, wi, u)
        for what in ("wo", "pdf"):
            assert not np.asarray(getattr(drawn, what)).any(), (
                f"`{what}` has a derivative in {name}; put lax.stop_gradient around what it is made of"
            )


def check_derivatives(materials: Materials, wi, samples: int, false_alarm: float, seed: int = 6):
    """Check that the mean derivative of the weights is that of the scattered light, by differences of `evaluate`."""
    u = random_numbers(materials, samples, seed)
    for name, tangent in _material_tangents(materials, but_moving=True).items():
        moved = sample_tangent(materials, tangent, wi, u).weight
        moved = np.asarray(moved, np.float64)

        def at(change, tangent=tangent):
            return _on_sphere(_plus(materials, change, tangent), wi)[0].sum(0)

        ahead, behind = at(STEP), at(-STEP)
        expected = (ahead - behind) / (2 * STEP)
        limit = _sigmas(false_alarm) * moved.std(0) / math.sqrt(samples)
        curvature = abs(at(2 * STEP) - at(-2 * STEP) - 2 * (ahead - behind)) / (4 * STEP) + 2e-3 * abs(expected) + 1e-3
        assert (abs(moved.mean(0) - expected) <= limit + curvature).all(), (
            f"the derivative in {name} is {moved.mean(0)} by samples and {expected} by evaluate, at wi = {wi}"
        )


def _material_tangents(materials: Materials, but_moving: bool = False) -> dict[str, Materials]:
    rest = jax.tree.map(_zero, materials)
    return {name: replace(rest, tables=(table,)) for name, table in _tangents(materials.tables[0], but_moving).items()}


# ---- textures -------------------------------------------------------------------------------------------------------


def check_texture(kind: type[Texture], **values):
    """Check that colours and their derivatives in parameters and uv are finite, that derivatives in parameters are
    correct, and that colours lie in the stated span.

    Args:
        values: parameters that differ from their defaults.
    Raises:
        AssertionError: a check failed.
    """
    instance = kind.instance("it", **values)
    made, _ = textures.build([instance], np.float32, (), Parameters())
    made, code = jax.device_put(made), jnp.zeros(2, jnp.int32)
    uv = jnp.asarray(np.random.default_rng(0).uniform(-3, 3, (2000, 2)), jnp.float32)

    def surface(uv):
        return SimpleNamespace(uv=uv, p=jnp.stack([uv[0], uv[1], uv[0] * uv[1]]))

    def look_up(textures, uv):
        return jax.vmap(lambda uv: textures.look_up(code, surface(uv)))(uv)

    colors = np.asarray(jax.jit(look_up)(made, uv))
    low, high = kind.span(instance)
    assert np.isfinite(colors).all(), "a colour is not finite"
    rounding = 1e-5 * max(abs(low), abs(high))
    assert (low - rounding <= colors).all() and (colors <= high + rounding).all(), (
        f"colours lie in [{colors.min()}, {colors.max()}], where `span` says [{low}, {high}]"
    )
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda uv: made.look_up(code, surface(uv)))))(uv)
    assert np.isfinite(slopes).all(), "a derivative in uv is not finite"
    for name, tangent in _tangents(made.tables[0]).items():
        tangent = Textures((tangent,))
        moved = np.asarray(jax.jvp(lambda made: look_up(made, uv), (made,), (tangent,))[1])
        ahead, behind = (
            np.asarray(look_up(_plus(made, change, tangent), uv), np.float64) for change in (STEP, -STEP)
        )
        expected = (ahead - behind) / (2 * STEP)
        wrong = ~np.isclose(moved, expected, rtol=1e-2, atol=1e-3)
        assert not wrong.any(), f"the derivative in {name} is {moved[wrong][0]}, by differences {expected[wrong][0]}"


# ---- emitters -------------------------------------------------------------------------------------------------------


def check_emitter(kind: type[Emitter], samples: int = 200_000, false_alarm: float = 1e-4, **values):
    """Check that a kind of emitter samples its stated density, and that its emission is finite and not negative.

    Args:
        samples: number of samples of the chi-square test of a background.
        values: parameters that differ from their defaults.
    Raises:
        AssertionError: a check failed.
    """
    table = jax.device_put(kind.build([kind.instance("it", **values)], np.float32, (), Parameters(), None))
    power = np.asarray(kind.power(AllRows(table)))
    assert power.shape == (1,) and np.isfinite(power).all() and (power >= 0).all(), f"the power is {power}, not (1,)"
    p, rng = Row(table, 0), np.random.default_rng(1)
    if kind.dirac:
        refs = jnp.asarray(rng.normal(size=(200, 3)), jnp.float32)
        d, distance, arriving = jax.vmap(lambda ref: kind.sample(p, ref))(refs)
        _check_light(arriving, np.zeros(len(refs)))
        assert (np.asarray(distance) > 0).all() and np.isfinite(distance).any() != kind.distant, (
            "distances are positive, inf of what is `distant` and of nothing else"
        )
    elif not kind.on_surfaces:
        u = jnp.asarray(rng.integers(0, 1 << 24, (samples, 3)) * 2.0**-24, jnp.float32)
        d = jax.jit(jax.vmap(lambda u: kind.sample(p, u[:2], u[2])))(u)
        middles, share = _midpoints()
        _check_light(*jax.vmap(lambda d: (kind.emitted(p, d), kind.density(p, d)))(d))
        density = np.asarray(jax.vmap(lambda d: kind.density(p, d))(middles), np.float64)
        _chi_square(d, samples, density * share, false_alarm, f"{kind.__name__}")
        unsampled = np.asarray(jax.vmap(lambda d: kind.emitted(p, d))(middles)).any(1) & (density == 0)
        assert not unsampled.any(), f"light from {np.asarray(middles)[unsampled][0]} is never drawn"
    else:
        d = jnp.asarray(rng.normal(size=(200, 3)), jnp.float32)
        d = d / jnp.linalg.norm(d, axis=1, keepdims=True)
        _check_light(jax.vmap(lambda d: kind.emitted(p, d))(d), np.zeros(len(d)))
    assert np.allclose(np.linalg.norm(d, axis=1), 1, atol=1e-5), "a direction is not of unit length"


def _check_light(light, density):
    for what, x in (("emitted", light), ("density", density)):
        assert np.isfinite(x).all() and (np.asarray(x) >= 0).all(), f"`{what}` is {np.min(x)} somewhere"


# ---- phase functions ------------------------------------------------------------------------------------------------


def check_phase(kind: type[Phase], samples: int = 200_000, false_alarm: float = 1e-4, **values):
    """Check that a phase function samples its density, and that all derivatives of the density integrate to 0.

    Args:
        samples: number of samples of the chi-square test.
        values: parameters that differ from their defaults.
    Raises:
        AssertionError: a check failed.
    """
    table = jax.device_put(kind.build([kind.instance("it", **values)], np.float32, (), Parameters(), None))
    u = jnp.asarray(np.random.default_rng(1).integers(0, 1 << 24, (samples, 2)) * 2.0**-24, jnp.float32)
    ends = jnp.asarray([[a, b] for a in (0, 1 - 2**-24) for b in (0, 1 - 2**-24)], jnp.float32)
    u = jnp.concatenate([u, ends])

    @jax.jit
    def drawn(table):
        return jax.vmap(lambda u: kind.sample(Row(table, 0), u))(u)

    @jax.jit
    def density(table, wo):
        return jax.vmap(lambda wo: kind.evaluate(Row(table, 0), wo))(wo)

    wo, (middles, share) = drawn(table), _midpoints()
    assert np.allclose(np.linalg.norm(wo, axis=1), 1, atol=1e-5), "a direction is not of unit length"
    for what in (wo, middles):
        pdf = np.asarray(density(table, what), np.float64)
        assert np.isfinite(pdf).all() and (pdf >= 0).all(), f"`evaluate` is {np.min(pdf)} somewhere"
    _chi_square(wo[:samples], samples, pdf * share, false_alarm, kind.__name__)
    middles, share = _midpoints(2)  # the derivative of a narrow lobe is narrower than its density
    for name, tangent in _tangents(table).items():
        _, moved = jax.jvp(drawn, (table,), (tangent,))
        assert not np.asarray(moved).any(), f"directions carry a derivative in {name}; put lax.stop_gradient around it"
        _, moved = jax.jvp(lambda table: density(table, middles), (table,), (tangent,))
        total, size = (np.sum(x * share) for x in (np.asarray(moved, np.float64), np.abs(moved)))
        assert abs(total) <= 1e-3 * size, f"the derivative of the density in {name} integrates to {total}, not to 0"


# ---- shared helpers -------------------------------------------------------------------------------------------------


def _midpoints(finer: int = 1):
    """Return directions (N, 3) at midpoints of (finer POINTS)^2 parts per cell, and the solid angle of each part."""
    rows, columns = (cells * finer * POINTS for cells in CELLS)
    steps = np.pi / rows, 2 * np.pi / columns
    theta, phi = ((np.arange(n) + 0.5) * step for n, step in zip((rows, columns), steps, strict=True))
    theta, phi = (x.ravel() for x in np.meshgrid(theta, phi, indexing="ij"))
    r = np.sin(theta)
    w = np.stack([r * np.cos(phi), r * np.sin(phi), np.cos(theta)], -1)
    return jnp.asarray(w, jnp.float32), r * steps[0] * steps[1]


def _on_sphere(materials, wi):
    """Return values (N, 3) and densities (N,) at the midpoints, times the solid angle."""
    wo, share = _midpoints()
    f, pdf = evaluate(materials, wi, wo)
    return np.asarray(f, np.float64) * share[:, None], np.asarray(pdf, np.float64) * share


def _tangents(table: Table, but_moving: bool = False) -> dict[str, Table]:
    """Return a unit tangent of each parameter, by name."""
    zero, found = jax.tree.map(_zero, table), {}
    for name, declared in table.kind.declared.items():
        column = table.column(name)
        if column is not None and declared.listed and not (but_moving and declared.moves_paths):
            found[name] = zero.with_column(name, jnp.ones_like(column.values))
    return found


def _zero(x):
    real = jnp.issubdtype(x.dtype, jnp.floating)
    return jnp.zeros_like(x) if real else np.zeros(x.shape, jax.dtypes.float0)


def _plus(tree, share, tangent):
    return jax.tree.map(lambda x, t: x if t.dtype == jax.dtypes.float0 else x + share * t, tree, tangent)


def _sigmas(false_alarm: float) -> float:
    """Return the number of standard deviations that a normal variate exceeds, to either side, with this probability."""
    from scipy import special

    return float(special.ndtri(1 - false_alarm / 2))
