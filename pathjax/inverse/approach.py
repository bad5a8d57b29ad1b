"""The first stage of a fit: least squares on renders with a fixed seed, which are a deterministic function."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import optimistix as optx

from pathjax.inverse import losses
from pathjax.inverse.state import State

APPROACH_SPP = 16
MAX_STEPS, MAX_REJECTED = 30, 3


def approach(state: State) -> None:
    """Move the values to a nearby minimum, as precisely as few samples allow."""
    spp, vector = min(APPROACH_SPP, state.spp), state.vector
    state.weigh(spp)
    x = jnp.asarray(vector.unbounded(state.values), state.dtype)
    # Residuals in units of the noise at this level; but scaled down to 1 on average where the start is far off, since
    # solvers assume numbers of that size in their first steps.
    squares = state.weights * state.normal.residuals[0] ** 2
    shrink = 1 / max(1, float(squares.mean()))
    weights = jnp.asarray(state.weights * shrink)
    arguments = state.groups, weights, jnp.uint32(spp), state.seed, state.next_draw()
    least_squares = isinstance(state.solver, optx.AbstractLeastSquaresSolver)
    loss = losses.residuals if least_squares else losses.loss
    program = state.program(loss, x, arguments, solver=state.solver)
    solver_state = program.begin(x, arguments)
    lowest, rejected = np.inf, 0
    for _ in range(MAX_STEPS):
        x, solver_state, loss, done = program.step(x, solver_state, arguments)
        loss = float(loss) / shrink
        state.values = np.asarray(vector.bounded(x), float)
        state.record("approach", spp, loss)
        # The solver reports the loss one step late, and repeats it after a step that it took back. Gains below the
        # uncertainty of the loss are left to the next stage.
        rejected = rejected + 1 if loss == lowest else 0
        if bool(done) or rejected > MAX_REJECTED or 0 < lowest - loss < max(len(x) / 2, np.sqrt(loss)):
            break
        lowest = min(lowest, loss)
