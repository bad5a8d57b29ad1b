"""What a fit has found so far. The stages `scan`, `approach` and `refine` move it on."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from pathjax.inverse import losses, uncertainty, weights
from pathjax.inverse.compiled_cache import Stepper, compiled, identity
from pathjax.inverse.problem import Problem
from pathjax.inverse.uncertainty import Evidence, Solution
from pathjax.system.interrupts import Interrupts

# Only its steps are taken; when to end, `refine` decides.
_NEWTON = optx.Newton(rtol=1e-6, atol=1e-6)


class State:
    """Values, and what the last renders at them or near them said."""

    def __init__(
        self, problem: Problem, spp: int, seed: int, solver, progress: Callable | None, interrupts: Interrupts
    ):
        self.problem, self.vector, self.groups = problem, problem.vector, problem.groups
        self.spp, self.seed, self.solver = spp, jnp.uint32(seed), solver
        self.progress, self.interrupts = progress, interrupts
        self.dtype = self.groups[0].targets.dtype
        self.values = problem.start.astype(float)  # (n,)
        self.scale = self.vector.scale(self.values)  # (n,) units of `solution`
        self.free = np.ones(len(self.values), bool)  # (n,) the others are held at a bound
        self.evidence: Evidence | None = None
        self.noise: weights.Noise | None = None
        count = sum(views.targets.size for views in self.groups) // 3
        self.weights = np.ones((count, 3), self.dtype)  # (N, 3) 1/variance; 0: left out
        self.solution: Solution | None = None
        self.history: list[dict] = []
        self.draws = 0
        self.started, self.compile_seconds = time.perf_counter(), 0.0

    def next_draw(self) -> jax.Array:
        """A number for renders that are independent of all before."""
        self.draws += 1
        return jnp.uint32(self.draws)

    def program(self, loss: Callable, *arguments, solver=None):
        """A function of `losses` compiled for these arguments; if a solver is given, as `Stepper` of it."""
        function = partial(loss, vector=self.vector)
        make = partial(Stepper, solver, function) if solver else lambda *a: jax.jit(function).lower(*a).compile()
        program, seconds = compiled((loss, identity(solver), self.vector), make, *arguments)
        self.compile_seconds += seconds
        return program

    def newton_step(self, z, base, projector, spp: int, draw) -> np.ndarray:
        """Where Newton's method goes from z (n,), in units of the scale from `base`; leaves the evidence at z."""
        arrays = (jnp.asarray(a, self.dtype) for a in (z, base, self.scale, projector, self.weights))
        z, base, scale, projector, w = arrays
        arguments = base, scale, projector, self.groups, w, jnp.uint32(spp), self.seed, draw
        program = self.program(losses.score, z, arguments, solver=_NEWTON)
        moved, _, evidence, _ = program.step(z, program.begin(z, arguments), arguments)
        self.evidence = jax.tree.map(np.asarray, evidence)
        return np.asarray(moved, float)

    def weigh(self, spp: int, refining: bool = False) -> None:
        """Weights from the noise of renders of `spp` samples at the current values, and of the target's rounding.

        While the values are approached, clipped ones have no weight; when they are refined, neither have those that
        noise may have clipped.
        """
        self.scale = self.vector.scale(self.values)
        nowhere = np.zeros((len(self.values),) * 2)
        self.newton_step(np.zeros(len(self.values)), self.values, nowhere, weights.NOISE_SPP, self.next_draw())
        halves, problem = self.halves(), self.problem
        self.noise = weights.noise(halves, problem, spp)
        usable = [target.usable for target in problem.targets]
        if refining:
            unclipped = weights.surely_unclipped(halves, problem, self.noise)
            usable = [u & sure for u, sure in zip(usable, unclipped, strict=True)]
        by_view = [u / variance for u, variance in zip(usable, self.noise.values, strict=True)]
        self.weights = problem.flat(by_view).astype(self.dtype)

    def solve(self, free: np.ndarray) -> None:
        self.solution = uncertainty.solve(self.evidence, self.weights, self.scale, free, self.problem.scatter)

    def halves(self) -> weights.Halves:
        """Residuals of the two renders, (H, W, 3) each, of each view."""
        return list(zip(*map(self.problem.by_view, self.evidence.residuals), strict=True))

    def structure(self) -> tuple[float, bool]:
        """How well neighbouring residuals agree, and whether that is more than chance."""
        used = [weight > 0 for weight in self.problem.by_view(self.weights)]
        return weights.structure(self.halves(), self.problem, self.noise, used)

    def record(self, stage: str, spp: int, loss: float) -> None:
        values = dict(zip(self.vector.labels, self.values.tolist(), strict=True))
        seconds = time.perf_counter() - self.started
        self.history.append({"stage": stage, "spp": spp, "values": values, "loss": loss, "seconds": seconds})
        if self.progress:
            self.progress(self.history[-1])
        if self.interrupts.heard:  # its exception may have been lost, while Python collected garbage
            raise KeyboardInterrupt
