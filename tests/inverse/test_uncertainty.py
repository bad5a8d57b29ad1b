"""The statistics of a fit on known linear problems: bias, covariance, undetermined directions, structure."""

from typing import NamedTuple

import numpy as np
import pytest

from pathjax.inverse import uncertainty
from pathjax.inverse.normal import NormalEquations

N, TRUTH = 2000, np.array([0.3, -0.2, 0.5])
FREE = np.ones(3, bool)


class Evidence(NamedTuple):
    """Two independent renders of N pixels."""

    residuals: np.ndarray  # (2, N, 3)
    jacobians: np.ndarray  # (2, N, 3, n)

    def solve(self, free=FREE):
        (ra, rb), (Ja, Jb) = self
        scores = (np.einsum("pci,pc->pi", Ja, rb) + np.einsum("pci,pc->pi", Jb, ra)) / 2
        groups = [np.einsum("pci,pcj->ij", Ja[k::32], Jb[k::32]) for k in range(32)]
        matrices = np.array([(matrix + matrix.T) / 2 for matrix in groups])
        spread = scores - scores.mean(0)
        gradient, loss, scatter = scores.sum(0), (ra * rb).sum() / 2, spread.T @ spread
        return uncertainty.solve(
            NormalEquations(matrices.sum(0), gradient, loss, scatter, matrices, self.residuals, None, ("abc",)), free
        )


def evidence(rng, truth=TRUTH, at=None, jacobian_noise=0.5, render_noise=0.5, target_noise=0.3):
    """Return renders of a linear model: image = J v + noise, with noise in J too; all correlated between channels."""
    J = np.random.default_rng(1).normal(size=(N, 3, len(truth)))
    at = np.zeros(len(truth)) if at is None else at

    def noise(size, *shape):
        return size * (rng.normal(size=(N, 1, *shape)) + rng.normal(size=(N, 3, *shape))) / np.sqrt(2)

    target = J @ truth + noise(target_noise)
    jacobians = [J + noise(jacobian_noise, len(truth)) for _ in range(2)]
    return Evidence(np.array([J @ at + noise(render_noise) - target for _ in range(2)]), np.array(jacobians))


def test_steps_are_unbiased_and_scatter_as_stated():
    """400 steps at the truth, where a fit ends: the mean is known to 1/20 of a standard error, a variance to 7 %."""
    rng = np.random.default_rng(0)
    solutions = [evidence(rng, at=TRUTH).solve() for _ in range(400)]
    z = np.array([s.step / np.sqrt(np.diag(s.covariance)) for s in solutions])
    assert np.abs(z.mean(0)).max() < 4 / np.sqrt(400)
    assert (np.abs(z.var(0) - 1) < 4 * np.sqrt(2 / 400)).all()


def test_steps_from_afar_are_not_too_short():
    """A single noisy Jacobian J would make J'J too large, here by a quarter, and the step too short, by a fifth."""
    rng = np.random.default_rng(0)
    steps = np.array([evidence(rng).solve().step for _ in range(100)])
    error = steps.std(0) / np.sqrt(len(steps))
    assert (np.abs(steps.mean(0) - TRUTH) < 4 * error + 1e-3).all()


def test_a_parameter_without_influence_is_not_determined():
    rng = np.random.default_rng(2)
    e = evidence(rng)
    e.jacobians[..., 1] = 0
    solution = e.solve()
    assert solution.undetermined.shape == (3, 1)
    np.testing.assert_allclose(np.abs(solution.undetermined[:, 0]), [0, 1, 0], atol=1e-9)
    assert solution.step[1] == pytest.approx(0, abs=1e-12)


def test_a_parameter_that_is_noise_alone_is_not_determined():
    """Its Jacobians differ from zero by chance only, and a single one would seem to determine it."""
    rng = np.random.default_rng(3)
    e = evidence(rng)
    e.jacobians[..., 1] = rng.normal(size=e.jacobians.shape[:-1])
    solution = e.solve()
    assert solution.undetermined.shape == (3, 1)
    assert abs(solution.undetermined[1, 0]) > 0.99


def test_only_the_combination_of_two_is_determined():
    rng = np.random.default_rng(4)
    e = evidence(rng)
    e.jacobians[..., 1] = 2 * e.jacobians[..., 0]
    solution = e.solve()
    assert solution.undetermined.shape == (3, 1)
    direction = solution.undetermined[:, 0] / solution.undetermined[1, 0]
    np.testing.assert_allclose(direction, [-2, 1, 0], atol=1e-6)
    np.testing.assert_allclose(solution.inverse @ solution.undetermined, 0, atol=1e-9)


def test_components_that_are_not_free_stay():
    free = np.array([True, False, True])
    solution = evidence(np.random.default_rng(5)).solve(free)
    assert solution.step[1] == 0 and not solution.undetermined.size
    np.testing.assert_array_equal(solution.inverse[1], 0)


def test_where_nothing_is_free_nothing_moves():
    solution = evidence(np.random.default_rng(5)).solve(np.zeros(3, bool))
    assert not solution.step.any() and not solution.covariance.any()


@pytest.mark.parametrize("noise", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("pattern", ["flat", "gradient", "patches"])
def test_errors_of_rounding_are_as_stated(pattern, noise):
    """A level is the mean of 400 rounded values that may have a pattern in common; 400 levels, steps of 1.

    The mean square of z is known to 7 %. It is too small where errors cancel over a gradient without noise, which the
    scatter over pixels does not show.
    """
    rng = np.random.default_rng(12)
    shapes = {"flat": [0.0], "gradient": np.linspace(0, 5.3, 400), "patches": [0, 0.3, 1.7, 2.45]}
    shape = np.repeat(shapes[pattern], 400 // len(shapes[pattern]))
    influence, z = np.full((400, 1, 1), 1 / 400), []
    for level in rng.uniform(50, 60, 400):
        exact = level + shape
        target = np.rint(exact + noise * rng.normal(size=400))
        scatter = (target - exact).var() / 400
        phase, sd = (exact - target)[:, None], np.full((400, 1), noise)
        parts = uncertainty.rounding_images(np.ones((400, 1)), phase, sd)
        common = (np.einsum("pci,pck->cik", influence, parts) ** 2).sum()
        z.append((target - exact).mean() / np.sqrt(scatter + common))
    assert 0.3 < np.mean(np.square(z)) < 1.3


def residuals(rng, size=40, smooth=0.0):
    """Return mean residuals of two renders of a view against one target: independent noise and a smooth misfit."""
    y, x = np.mgrid[0:size, 0:size] / 6
    misfit = smooth * (np.sin(x) * np.cos(y))[..., None]
    target = rng.normal(size=(size, size, 3))
    return misfit - target + rng.normal(size=(2, size, size, 3)).mean(0)


def structure(view):
    return uncertainty.structure([view / uncertainty.deviation(view[view != 0])])


def test_noise_has_no_structure():
    rng = np.random.default_rng(6)
    z = np.array([structure(residuals(rng))[1] for _ in range(100)])
    # For normal noise these are standard normal: one of 100 lies beyond 4 with a probability of 0.6 %.
    assert np.abs(z).max() < 4
    assert abs(z.mean()) < 4 / np.sqrt(len(z)) and abs(z.var() - 1) < 4 * np.sqrt(2 / len(z))


def test_noise_that_is_the_same_in_all_channels_has_no_structure():
    rng = np.random.default_rng(8)
    z = np.array([structure(np.repeat(residuals(rng)[..., :1], 3, -1))[1] for _ in range(100)])
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / len(z))


def test_a_misfit_of_the_size_of_the_noise_has_structure():
    rng = np.random.default_rng(7)
    for _ in range(20):
        assert structure(residuals(rng, smooth=2))[1] > 2 * uncertainty.STRUCTURE_SIGNIFICANCE


def test_a_misfit_far_below_the_noise_has_structure_in_a_large_image():
    """It is 1/4 of the noise's standard deviation, and 50 standard deviations over all 256 x 256 pixels together."""
    agreement, significance = structure(residuals(np.random.default_rng(9), size=256, smooth=0.6))
    assert agreement < 0.1 and significance > uncertainty.STRUCTURE_SIGNIFICANCE


@pytest.mark.parametrize("size", [32, 64])
def test_a_few_neighbours_that_are_far_off_have_structure(size):
    """A lamp covers 1/64 of the image, and its residuals dominate any sum of squares."""
    for seed in range(10):
        view = residuals(np.random.default_rng(seed), size)
        view[2 : 2 + size // 8, 5 : 5 + size // 8] -= 200
        assert structure(view)[1] > uncertainty.STRUCTURE_SIGNIFICANCE


@pytest.mark.parametrize("where", [np.s_[7, 7], np.s_[7, 7:9]], ids=["alone", "side by side"])
def test_a_firefly_is_no_structure(where):
    for seed in range(10):
        view = residuals(np.random.default_rng(seed), 16)
        view[where] = -1000
        assert structure(view)[1] < uncertainty.STRUCTURE_SIGNIFICANCE


def test_pixels_without_noise_do_not_matter():
    """As where a small object is seen before a black background."""
    view = residuals(np.random.default_rng(10))
    wide = np.zeros((40, 400, 3))
    wide[:, :40] = view
    np.testing.assert_allclose(structure(wide), structure(view))
    assert uncertainty.structure([np.zeros((40, 40, 3))]) == (0, 0)


# Weights by which a Gaussian filter of standard deviation 1/2 spreads noise over pixels.
SHARED = np.exp(-2.0 * np.arange(-2, 3) ** 2)


def shared_noise(rng, size=48):
    """Return noise (size, size, 3) of variance 1, correlated like pixels that share samples."""
    noise = rng.normal(size=(size + 4, size + 4, 3))
    for axis in (0, 1):
        noise = np.apply_along_axis(np.convolve, axis, noise, SHARED, "valid")
    return noise / (SHARED**2).sum()


def test_shared_samples_are_no_structure():
    """Of 100 images of noise none is significant, and a smooth misfit below the noise is."""
    rng = np.random.default_rng(3)
    correlation = np.convolve(SHARED, SHARED) / (SHARED**2).sum()
    alike = (correlation**2).sum() ** 2
    found = np.array([uncertainty.structure([shared_noise(rng)], 3, alike)[1] for _ in range(100)])
    assert np.abs(found).max() < 4 and 0.8 < found.std() < 1.2
    slope = 0.5 * np.sin(np.arange(48) / 8)[:, None, None]
    assert uncertainty.structure([shared_noise(rng) + slope], 3, alike)[1] > uncertainty.STRUCTURE_SIGNIFICANCE
