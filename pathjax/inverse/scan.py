"""Initial values of a fit: a scan of IORs over their whole range, since a local method finds only a near minimum."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from pathjax.derivatives import ior
from pathjax.inverse import losses
from pathjax.inverse.approach import approach
from pathjax.inverse.state import State

# Relative IORs that are tried, from nearly 1 to above diamond's; samples per pixel; and how many are tried at a time.
RATIOS, SCAN_SPP, CHUNK = np.geomspace(1.02, 2.6, 64), 4, 16
MOST_CANDIDATES = 3


def scan(state: State) -> list[np.ndarray]:
    """Return initial values (n,), the most promising first; the present ones if there is nothing to scan."""
    parameters = state.vector.parameters
    names = [name for name, parameter in parameters if parameter.moves_paths]
    if not names:
        return [state.values]
    if len(names) < len(parameters):
        # Colours first: a wrong IOR leaves them nearly right, while wrong colours may hide the right IOR.
        approach(state)
    state.weigh(SCAN_SPP)
    for name in names * min(len(names), 2):
        tried = np.stack([_at_ratio(state, name, ratio) for ratio in RATIOS])
        misfits = np.concatenate([_misfits(state, chunk) for chunk in np.split(tried, len(RATIOS) // CHUNK)])
        low = [i for i in range(len(RATIOS)) if misfits[i] == misfits[max(i - 1, 0) : i + 2].min()]
        low = sorted(low, key=lambda i: misfits[i])[:MOST_CANDIDATES]
        candidates = [tried[i] for i in low]
        state.values = candidates[0]
        state.record("scan", SCAN_SPP, float(misfits[low[0]]))
    return candidates


def _misfits(state: State, candidates: np.ndarray) -> np.ndarray:
    """Return the misfits (K,) of values (K, n)."""
    candidates, weights = (jnp.asarray(a, state.dtype) for a in (candidates, state.weights))
    # All candidates see the same noise.
    arguments = state.groups, weights, jnp.uint32(SCAN_SPP), state.seed, jnp.uint32(0)
    return np.asarray(state.program(losses.misfits, candidates, arguments)(candidates, arguments))


def _at_ratio(state: State, name: str, ratio: float) -> np.ndarray:
    """Return the present values with the IOR `name` set so that the relative IOR of its glass is `ratio`."""
    scene = next(scene for scene in state.problem.scenes if name in scene.about.parameters)
    values = state.vector.unpack(state.values.copy())
    values[name] = ior.at_ratio(state.problem.with_values(scene, values), name, ratio)
    return state.vector.pack(values)
