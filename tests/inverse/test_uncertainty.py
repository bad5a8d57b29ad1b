"""The statistics of a fit on linear problems that are known: bias, covariance, what is not determined, structure."""

import numpy as np
import pytest

from pathjax.inverse import uncertainty
from pathjax.inverse.uncertainty import Evidence

N, TRUTH = 2000, np.array([0.3, -0.2, 0.5])
FREE = np.ones(3, bool)
WEIGHTS = np.ones((N, 3))


def evidence(rng, truth=TRUTH, at=None, jacobian_noise=0.5, render_noise=0.5, target_noise=0.3):
    """Renders of a linear model: image = J v + noise, with noise in J too; all correlated between channels."""
    J = np.random.default_rng(1).normal(size=(N, 3, len(truth)))
    at = np.zeros(len(truth)) if at is None else at

    def noise(size, *shape):
        return size * (rng.normal(size=(N, 1, *shape)) + rng.normal(size=(N, 3, *shape))) / np.sqrt(2)

    target = J @ truth + noise(target_noise)
    jacobians = [J + noise(jacobian_noise, len(truth)) for _ in range(2)]
    return Evidence(np.array([J @ at + noise(render_noise) - target for _ in range(2)]), np.array(jacobians))


def test_steps_are_unbiased_and_scatter_as_stated():
    """At the truth, where a fit ends. 400 steps: the mean is known to 1/20 of a standard error, a variance to 7 %."""
    rng = np.random.default_rng(0)
    solutions = [uncertainty.solve(evidence(rng, at=TRUTH), WEIGHTS, np.ones(3), FREE) for _ in range(400)]
    z = np.array([s.step / np.sqrt(np.diag(s.covariance)) for s in solutions])
    assert np.abs(z.mean(0)).max() < 4 / np.sqrt(400)
    assert (np.abs(z.var(0) - 1) < 4 * np.sqrt(2 / 400)).all()


def test_steps_from_afar_are_not_too_short():
    """One noisy Jacobian J makes J'J too large: here by a quarter, and the step by a fifth too short."""
    rng = np.random.default_rng(0)
    steps = np.array([uncertainty.solve(evidence(rng), WEIGHTS, np.ones(3), FREE).step for _ in range(100)])
    error = steps.std(0) / np.sqrt(len(steps))
    assert (np.abs(steps.mean(0) - TRUTH) < 4 * error + 1e-3).all()


def test_a_parameter_without_influence_is_not_determined():
    rng = np.random.default_rng(2)
    e = evidence(rng)
    e.jacobians[..., 1] = 0
    solution = uncertainty.solve(e, WEIGHTS, np.ones(3), FREE)
    assert solution.undetermined.shape == (3, 1)
    np.testing.assert_allclose(np.abs(solution.undetermined[:, 0]), [0, 1, 0], atol=1e-9)
    assert solution.step[1] == pytest.approx(0, abs=1e-12)


def test_a_parameter_that_is_noise_alone_is_not_determined():
    """Its Jacobians differ from zero by chance only, and a single one would seem to determine it."""
    rng = np.random.default_rng(3)
    e = evidence(rng)
    e.jacobians[..., 1] = rng.normal(size=e.jacobians.shape[:-1])
    solution = uncertainty.solve(e, WEIGHTS, np.ones(3), FREE)
    assert solution.undetermined.shape == (3, 1)
    assert abs(solution.undetermined[1, 0]) > 0.99


def test_only_the_combination_of_two_is_determined():
    rng = np.random.default_rng(4)
    e = evidence(rng)
    e.jacobians[..., 1] = 2 * e.jacobians[..., 0]
    solution = uncertainty.solve(e, WEIGHTS, np.ones(3), FREE)
    assert solution.undetermined.shape == (3, 1)
    direction = solution.undetermined[:, 0] / solution.undetermined[1, 0]
    np.testing.assert_allclose(direction, [-2, 1, 0], atol=1e-6)
    np.testing.assert_allclose(solution.projector @ solution.undetermined, 0, atol=1e-9)


def test_components_that_are_not_free_stay():
    free = np.array([True, False, True])
    solution = uncertainty.solve(evidence(np.random.default_rng(5)), WEIGHTS, np.ones(3), free)
    assert solution.step[1] == 0 and not solution.undetermined.size
    np.testing.assert_array_equal(solution.projector[1], 0)


def residuals(rng, smooth=0.0):
    """Two renders of a view of 40 x 40 against one target: independent noise, and a smooth misfit common to both."""
    y, x = np.mgrid[0:40, 0:40] / 6
    misfit = smooth * (np.sin(x) * np.cos(y))[..., None]
    target = rng.normal(size=(40, 40, 3))
    return np.stack([misfit - target + rng.normal(size=(40, 40, 3)) for _ in range(2)])


def structured(share, significance):
    return share > uncertainty.STRUCTURE_SHARE and significance > uncertainty.STRUCTURE_SIGNIFICANCE


def test_noise_has_no_structure():
    rng = np.random.default_rng(6)
    found = [uncertainty.structure([residuals(rng)], [np.ones((40, 40, 3))]) for _ in range(100)]
    assert not any(structured(*f) for f in found)
    z = np.array([significance for _, significance in found])
    assert abs(z.mean()) < 4 / np.sqrt(len(z))


def test_a_misfit_of_the_size_of_the_noise_has_structure():
    rng = np.random.default_rng(7)
    for _ in range(20):
        assert structured(*uncertainty.structure([residuals(rng, smooth=2)], [np.ones((40, 40, 3))]))
