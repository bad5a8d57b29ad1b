"""The last stage of a fit: Newton's method for the root of the score of two independent renders."""

from __future__ import annotations

import numpy as np

from pathjax.inverse import uncertainty, weights
from pathjax.inverse.state import State

# The first steps are made with the samples divided by this.
COARSE_PART = 4
MAX_STEPS = 8
# The method ends with a step below this part of the standard errors; steps are clipped to this part of the scale.
SMALL_STEP, LARGE_STEP = 0.3, 0.3


def refine(state: State) -> tuple[bool, str]:
    """Move the values to the root, and find their covariance; return whether the fit converged, and a message."""
    low, high = state.vector.bounds.T
    _newton(state, max(state.spp // COARSE_PART, 1), small=1)
    while True:
        settled = _newton(state, state.spp, SMALL_STEP)
        outside = state.free & ((state.values < low) | (state.values > high))
        state.values = np.clip(state.values, low, high)
        if not settled or not outside.any():
            break
        # Values that would leave their bounds stay there, and the others are fitted again.
        state.free &= ~outside
    # The curvature also gives the uncertainty of components that a bound holds.
    state.solve(np.ones_like(state.free))
    rounding = _rounding_covariance(state)
    state.solution = state.solution._replace(covariance=state.solution.covariance + rounding)
    agreement, structured = state.structure()
    if structured:
        return False, (
            f"the residuals have structure: neighbouring pixels are correlated by {agreement:.0%}. This is a "
            "local minimum, or the scene cannot look like the target; try other starts, and look at the residuals"
        )
    if not settled:
        return False, f"Newton's method did not settle in {MAX_STEPS} steps; try more spp, or another start"
    message = "converged: the last step is small against the standard errors, the residuals are noise"
    left_out = (state.weights == 0).mean()
    if left_out:
        message += f"; {left_out:.2g} of the target's values are clipped, may be, or are not measured"
    if state.solution.undetermined.size:
        message += "; but the images do not determine all that was asked"
    return True, message


def _newton(state: State, spp: int, small: float) -> bool:
    """Take steps until one is below `small` standard errors; return whether one was."""
    state.scale, draw = state.vector.scale(state.values), state.next_draw()
    for _ in range(MAX_STEPS):
        state.evaluate(spp, draw)
        state.solve(state.free)
        step = np.clip(state.solution.step, -LARGE_STEP, LARGE_STEP)
        state.values = state.values + state.scale * step
        # The loss is the weighted product of the two renders' residuals: the misfit without their noise.
        state.record("refine", spp, float(state.normal.loss))
        sigma = np.sqrt(np.diag(state.solution.covariance))
        if np.all(np.abs(step) <= small * sigma + np.finfo(state.dtype).eps):
            return True
    return False


def _rounding_covariance(state: State) -> np.ndarray:
    """Return the covariance (n, n), in units of the scale, of the error that rounded values share; noise hides it."""
    problem = state.problem
    if not any(target.step.any() for target in problem.targets):
        return np.zeros_like(state.solution.covariance)
    parts = zip(*weights.target_rounding(state.halves(), problem, state.noise), strict=True)
    state.evaluate(state.spp, state.next_draw(), uncertainty.rounding_images(*map(problem.flat, parts)))
    moved = state.solution.inverse @ state.normal.pulled.astype(np.float64)
    return np.einsum("cik,cjk->ij", moved, moved)
