"""Fresnel reflectances against closed forms, their derivatives against complex steps, and finiteness everywhere."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.bsdfs import fresnel

ETAS = [1.0003, 1.33, 1.5046, 2.419, 1 / 1.33, 1 / 2.419]
# float32 roundings of a few operations on numbers of order 1.
ROUNDING = 2e-6


@pytest.fixture
def x64():
    context = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
    with context(True):
        yield


def dielectric(cos_i, eta):
    r, cos_t = jax.jit(jax.vmap(fresnel.dielectric))(*np.broadcast_arrays(np.float32(cos_i), np.float32(eta)))
    return np.asarray(r, np.float64), np.asarray(cos_t, np.float64)


def exact_dielectric(cos_i, eta):
    """Textbook form, for complex arguments too, so that complex steps differentiate it; not for total reflection."""
    cos_t = np.sqrt((cos_i**2 + eta**2 - 1) / eta**2)
    r_s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    r_p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return (r_s**2 + r_p**2) / 2


def exact_conductor(cos_i, eta, k):
    """From complex amplitudes, independently of the real form in the package."""
    n = eta + 1j * k
    cos_t = np.sqrt(1 - (1 - cos_i**2) / n**2)
    r_s = (cos_i - n * cos_t) / (cos_i + n * cos_t)
    r_p = (n * cos_i - cos_t) / (n * cos_i + cos_t)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


def critical_cos(eta):
    """Cosine of incidence at which refraction ends, for eta < 1."""
    return np.sqrt(1 - eta**2)


@pytest.mark.parametrize("eta", ETAS)
def test_normal_incidence(eta):
    r, cos_t = dielectric([1.0], eta)
    np.testing.assert_allclose(r, ((eta - 1) / (eta + 1)) ** 2, atol=1e-7)
    np.testing.assert_allclose(cos_t, 1, atol=1e-7)


@pytest.mark.parametrize("eta", ETAS)
def test_brewsters_angle_leaves_half_of_the_s_wave(eta):
    cos_i = 1 / np.hypot(1, eta)  # tan = eta
    r_s = (1 - eta**2) / (1 + eta**2)
    np.testing.assert_allclose(dielectric([cos_i], eta)[0], r_s**2 / 2, atol=ROUNDING)


@pytest.mark.parametrize("eta", ETAS)
def test_closed_form_at_all_angles(eta):
    cos_i = np.float32(np.linspace(critical_cos(eta) + 1e-3 if eta < 1 else 1e-3, 1, 1001)).astype(np.float64)
    eta = float(np.float32(eta))
    # Near the critical angle the square root of a small difference keeps half of the digits.
    np.testing.assert_allclose(dielectric(cos_i, eta)[0], exact_dielectric(cos_i, eta), atol=2e-4 if eta < 1 else 1e-5)


@pytest.mark.parametrize("eta", [e for e in ETAS if e < 1])
def test_total_internal_reflection_begins_at_the_critical_angle(eta):
    c = critical_cos(eta)
    r, cos_t = dielectric([0, 0.5 * c, c - 1e-5], eta)
    assert (r == 1).all() and (cos_t == 0).all()
    r, cos_t = dielectric([c + 1e-3, 1], eta)
    assert (r < 1).all() and (cos_t > 0).all()


@pytest.mark.parametrize("eta", [1.0003, 1.5, 2.4])
def test_grazing_incidence_tends_to_one_smoothly(eta):
    cos_i = np.float32([0, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4])
    r = dielectric(cos_i, eta)[0]
    assert abs(r[0] - 1) <= 2**-23 and (np.diff(r) <= 1e-7).all()
    # 1 - R = 2 cos (1 + eta^2) / sqrt(eta^2 - 1) to first order.
    slope = 2 * (1 + eta**2) / np.sqrt(eta**2 - 1)
    np.testing.assert_allclose(1 - r, slope * cos_i.astype(float), rtol=0.02, atol=5e-7)


@pytest.mark.parametrize("eta", [1.33, 1.5, 2.4])
def test_reciprocity(eta):
    cos_i = np.linspace(0.01, 1, 200)
    r, cos_t = dielectric(cos_i, eta)
    back, cos_back = dielectric(cos_t, 1 / eta)
    # The reverse direction is near the critical angle, where a rounding of cos_t changes R by 1e-4.
    np.testing.assert_allclose(back, r, atol=3e-4)
    # A rounding of cos_t^2 is magnified by eta^2 / (2 cos_i); there are two of them.
    np.testing.assert_array_less(np.abs(cos_back - cos_i), 2 * 2**-24 * max(eta**2, 1) / (2 * cos_i) + 1e-6)


def test_equal_media_reflect_nothing_at_any_angle():
    cos_i = np.concatenate([np.linspace(0.01, 1, 100), np.geomspace(1e-6, 1e-2, 50)])
    r, cos_t = dielectric(cos_i, 1.0)
    np.testing.assert_allclose(r, 0, atol=1e-12)
    np.testing.assert_allclose(cos_t, cos_i, rtol=1e-6)


def test_equal_media_have_derivative_zero():
    cos_i = jnp.asarray(np.geomspace(1e-3, 1, 50), jnp.float32)
    of_eta = jax.grad(lambda c, eta: fresnel.dielectric(c, eta)[0], argnums=1)
    slope = jax.jit(jax.vmap(of_eta, (0, None)))(cos_i, 1.0)
    np.testing.assert_allclose(slope, 0, atol=1e-6)


# ---- Schlick's approximation ----------------------------------------------------------------------------------------


def schlick(cos_i, eta):
    r, cos_t = jax.jit(jax.vmap(fresnel.schlick))(*np.broadcast_arrays(np.float32(cos_i), np.float32(eta)))
    return np.asarray(r, np.float64), np.asarray(cos_t, np.float64)


@pytest.mark.parametrize("eta", ETAS)
def test_schlick_is_exact_at_normal_and_grazing_incidence_and_beyond_the_critical_angle(eta):
    ends = [critical_cos(eta) - 1e-5, 1] if eta < 1 else [0, 1]
    exact, cos_exact = dielectric(ends, eta)
    r, cos_t = schlick(ends, eta)
    np.testing.assert_allclose(r, exact, atol=ROUNDING)
    np.testing.assert_array_equal(cos_t, cos_exact)


@pytest.mark.parametrize("eta", [1.33, 1.5, 2.4])
def test_schlick_is_the_polynomial_in_the_angle_on_the_thinner_side_from_either_side(eta):
    cos_i = np.linspace(0.05, 1, 200)
    expected = ((eta - 1) / (eta + 1)) ** 2 + (1 - ((eta - 1) / (eta + 1)) ** 2) * (1 - cos_i) ** 5
    r, cos_t = schlick(cos_i, eta)
    np.testing.assert_allclose(r, expected, atol=ROUNDING)
    np.testing.assert_allclose(schlick(cos_t, 1 / eta)[0], expected, atol=1e-4)  # the cosine was rounded


def test_schlick_is_off_by_what_its_users_accept():
    """At IOR 1.5 the error is up to 0.036, at 85 degrees, and the reflectance of diffuse light is 6.6 % too low."""
    cos_i = np.sqrt((np.arange(10_000) + 0.5) / 10_000)  # cosine-distributed
    difference = schlick(cos_i, 1.5)[0] - exact_dielectric(cos_i, 1.5)
    assert np.abs(difference).max() == pytest.approx(0.0357, abs=1e-4)
    assert np.degrees(np.arccos(cos_i[np.abs(difference).argmax()])) == pytest.approx(85, abs=0.1)
    assert difference.mean() / exact_dielectric(cos_i, 1.5).mean() == pytest.approx(-0.066, abs=1e-3)


def test_dielectric_derivatives_are_the_analytic_ones(x64):
    step = 1e-30
    gradient = jax.jit(jax.vmap(jax.grad(lambda c, e: fresnel.dielectric(c, e)[0], (0, 1)), (0, None)))
    for eta in ETAS:
        low = critical_cos(eta) + 1e-3 if eta < 1 else 1e-3
        cos_i = np.linspace(low, 1 - 1e-3, 50)
        slopes = gradient(cos_i, eta)
        # A complex step has no cancellation: exact to the last bits.
        exact = exact_dielectric(cos_i + 1j * step, eta), exact_dielectric(cos_i, eta + 1j * step)
        np.testing.assert_allclose(slopes, [r.imag / step for r in exact], rtol=1e-8, atol=1e-12)


def test_derivative_at_normal_incidence():
    eta = np.float32([1.0, 1.33, 1.5, 2.419, 1 / 1.5])
    slope = jax.jit(jax.vmap(jax.grad(lambda e: fresnel.dielectric(jnp.ones_like(e), e)[0])))(eta)
    exact = 4 * (eta - 1.0) / (eta + 1.0) ** 3
    np.testing.assert_allclose(slope, exact, rtol=1e-5, atol=1e-7)
    assert slope[2] == pytest.approx(0.128)


@pytest.mark.parametrize("eta", [1 / 1.33, 1 / 1.5, 1 / 2.419])
def test_derivatives_around_the_critical_angle(x64, eta):
    """1e-3 rad below it they are large and correct; 1e-3 rad beyond it reflection is total, so they are 0."""
    critical = np.arcsin(eta)
    gradient = jax.jit(jax.grad(lambda c, e: fresnel.dielectric(c, e)[0], (0, 1)))
    cos_i = np.cos(critical - 1e-3)
    step = 1e-30
    exact = [exact_dielectric(cos_i + 1j * step, eta).imag / step, exact_dielectric(cos_i, eta + 1j * step).imag / step]
    slopes = gradient(cos_i, eta)
    np.testing.assert_allclose(slopes, exact, rtol=1e-8)
    assert abs(slopes[1]) > 10
    # In float32 the relative error of the small cos_t^2 is the rounding of the cosine divided by it.
    rounded = np.float32([cos_i, eta]).astype(float)
    exact = exact_dielectric(rounded[0], rounded[1] + 1j * step).imag / step
    slope = jax.jit(jax.grad(lambda e, c: fresnel.dielectric(c, e)[0]))(np.float32(eta), np.float32(cos_i))
    np.testing.assert_allclose(slope, exact, rtol=1e-3)
    assert gradient(np.cos(critical + 1e-3), eta) == (0, 0)


def test_dielectric_derivatives_are_finite_everywhere():
    assert_finite_everywhere(np.float32)


def test_dielectric_derivatives_are_finite_everywhere_in_float64(x64):
    assert_finite_everywhere(np.float64)


def assert_finite_everywhere(dtype):
    """Check both modes of differentiation, and IORs beyond those of any glass."""
    cos_i, eta = [], []
    near = np.nextafter(dtype(1), 0), np.nextafter(dtype(1), 2)
    for e in [*ETAS, 1.0, *near, *np.geomspace(1e-30, 1e30, 121)]:
        around = critical_cos(e) + np.array([-1e-3, -1e-6, -1e-7, 0, 1e-7, 1e-6, 1e-3]) if e < 1 else []
        for c in [0, 1e-30, 1e-12, 1e-7, 1e-3, 0.5, 1, *around]:
            cos_i.append(c)
            eta.append(e)
    arguments = dtype(cos_i).clip(0, 1), dtype(eta)
    reflectances, ways = (fresnel.dielectric, fresnel.schlick), (jax.jacfwd, jax.jacrev)
    for reflectance, differentiate in itertools.product(reflectances, ways):
        for f in (reflectance, differentiate(reflectance, (0, 1))):
            found = jax.tree.leaves(jax.jit(jax.vmap(f))(*arguments))
            assert all(x.dtype == dtype and np.isfinite(x).all() for x in found)


def test_reflectance_lies_in_zero_to_one():
    rng = np.random.default_rng(1)
    r, cos_t = dielectric(rng.random(100_000), np.exp(rng.normal(size=100_000)))
    assert r.min() >= 0 and r.max() <= 1 and cos_t.min() >= 0 and cos_t.max() <= 1


# ---- conductors ----------------------------------------------------------------------------------------------------

METALS = [(0.2, 3.9), (0.04, 10.0), (1.5, 7.6), (3.0, 0.1), (0.143, 3.98)]


def conductor(cos_i, eta, k):
    return np.asarray(jax.jit(jax.vmap(fresnel.conductor))(*np.broadcast_arrays(*map(np.float32, (cos_i, eta, k)))))


@pytest.mark.parametrize("eta, k", METALS)
def test_conductor_is_that_of_complex_amplitudes(eta, k):
    cos_i = np.linspace(0, 1, 500)
    np.testing.assert_allclose(conductor(cos_i, eta, k), exact_conductor(cos_i, eta, k), atol=5e-6)


@pytest.mark.parametrize("eta", [1.0003, 1.33, 1.5, 2.4, 0.7])
def test_conductor_without_absorption_is_a_dielectric(eta):
    cos_i = np.linspace(0.01, 1, 200)
    cos_i = cos_i[np.abs(cos_i - critical_cos(eta)) > 1e-2] if eta < 1 else cos_i
    # a^2 is a difference, so its square root keeps half of the digits.
    np.testing.assert_allclose(conductor(cos_i, eta, 0), dielectric(cos_i, eta)[0], atol=2e-5)


def test_conductor_grazing_and_mirror_limits():
    for eta, k in METALS:
        np.testing.assert_allclose(conductor([0.0], eta, k), 1, atol=1e-6)
    np.testing.assert_allclose(conductor(np.linspace(0, 1, 20), 1.0, 1e4), 1, atol=5e-4)  # 1 - R ~ 4 / k^2
    np.testing.assert_allclose(conductor([1.0], 0.2, 3.9), (0.8**2 + 3.9**2) / (1.2**2 + 3.9**2), atol=1e-6)


def test_conductor_derivatives_are_the_analytic_ones(x64):
    def reference(x):
        return exact_conductor(*x)

    gradient = jax.jit(jax.grad(lambda x: fresnel.conductor(x[0], x[1], x[2])))
    for eta, k in METALS:
        for cos_i in (0.05, 0.4, 0.99):
            x = np.array([cos_i, eta, k])
            slopes = gradient(x)
            h = 1e-6
            numeric = [(reference(x + h * e) - reference(x - h * e)) / (2 * h) for e in np.eye(3)]
            # Errors of central differences: h^2 from truncation, 1e-16 / h from rounding.
            np.testing.assert_allclose(slopes, numeric, rtol=1e-6, atol=1e-8)


def exact_conductor_slopes(cos_i, eta, k):
    """Value and derivatives in eta and k, by complex analysis, in long double; eta + i k must not be 0."""
    cos_i, eta, k = (np.asarray(x, np.longdouble) for x in (cos_i, eta, k))
    n = eta + 1j * k
    w = np.sqrt(np.where(eta < 0.5, n * n - (1 - cos_i) * (1 + cos_i), (n - 1) * (n + 1) + cos_i**2))
    dw, sin2 = n / w, (1 - cos_i) * (1 + cos_i)
    # c - w comes from factored squares where n may be near 1; r_p is r_s times a ratio.
    c_w = np.where(eta < 0.5, cos_i - w, (1 - n) * (1 + n) / (cos_i + w))
    r_s, dr_s = c_w / (cos_i + w), -2 * cos_i * dw / (cos_i + w) ** 2
    ratio, d_ratio = (w * cos_i - sin2) / (w * cos_i + sin2), 2 * sin2 * cos_i * dw / (w * cos_i + sin2) ** 2
    r_p, dr_p = r_s * ratio, dr_s * ratio + r_s * d_ratio
    slope = np.conj(r_s) * dr_s + np.conj(r_p) * dr_p  # |r|^2 changes by 2 Re(conj(r) dr), dn is 1 or i
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2, slope.real, -slope.imag


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_conductor_and_its_derivatives_keep_their_digits(x64, dtype):
    """For eta and k from 0 to 1e6, from normal to grazing incidence, for reflectances from nearly 0 to nearly 1."""
    numbers = [0, *np.geomspace(1e-7, 1e6, 14), 0.999, 1.001, 1.5, 2, 3.9]
    cosines = [*np.geomspace(1e-6, 0.1, 6), 0.3, 0.5, 0.7, 0.9, 0.99, 0.9999, 1]
    c, e, k = (x.ravel().astype(dtype) for x in np.meshgrid(cosines, numbers, numbers))
    c, e, k = (x[(e > 0) | (k > 0)] for x in (c, e, k))
    results = jax.jit(jax.vmap(jax.value_and_grad(fresnel.conductor, (1, 2))))(c, e, k)
    value, slopes = jax.tree.map(np.asarray, results)
    exact, *exact_slopes = exact_conductor_slopes(c, e, k)
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(value, exact, rtol=0, atol=4 * eps)
    # At the angle where a large eta reflects no p-wave, the p-wave's slope is 0 and the rest is a small difference.
    size = np.hypot(*exact_slopes) + np.finfo(dtype).tiny
    for slope, exact_slope in zip(slopes, exact_slopes, strict=True):
        error = np.where(np.abs(c * e - 1) < 0.1, 0, np.abs(slope - exact_slope) / size)
        assert error.max() < 300 * eps, (c[error.argmax()], e[error.argmax()], k[error.argmax()])


def test_conductor_derivatives_have_no_seams():
    """Where cases of the formula meet: the real part of n^2 - sin^2 is 0 or equals the imaginary part, or n is 1."""
    cases = [(1, 1, 1), (1, 2, 2), (0.6, 1, 0.6), (0.0001, 1, 2), (1, 1 + 2**0.5, 1), (1, 0.5, 0.3), (0.5, 1, 0)]
    c, e, k = np.float32(cases).T
    slopes = jax.jit(jax.vmap(jax.grad(fresnel.conductor, (1, 2))))(c, e, k)
    np.testing.assert_allclose(slopes, exact_conductor_slopes(c, e, k)[1:], rtol=2e-5, atol=1e-7)


def test_conductor_derivatives_are_finite_everywhere():
    cosines = 0, 1e-20, 1e-15, 1e-10, 1e-3, 0.7, 1
    cases = [(c, e, k) for c in cosines for e in (0, 1e-3, 1, 2.5) for k in (0, 1e-3, 1, 100)]
    # k = 0 at the critical angle, where the medium turns from transparent to totally reflecting.
    cases += [(critical_cos(0.6), 0.6, 0.0), (0.8, 0.6, 0.0)]
    c, e, k = np.float32(cases).T
    for differentiate in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jax.vmap(differentiate(fresnel.conductor, (0, 1, 2))))(c, e, k)
        bad = [case for case, *s in zip(cases, *slopes, strict=True) if not np.isfinite(s).all()]
        assert not bad
    r = conductor(c, e, k)
    assert np.isfinite(r).all() and r.min() >= 0 and r.max() <= 1 + 1e-6
