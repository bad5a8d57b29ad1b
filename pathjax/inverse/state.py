"""The state of a fit, which the stages `scan`, `approach` and `refine` advance."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pathjax import distributed
from pathjax.inverse import normal, uncertainty, weights
from pathjax.inverse.compiled_cache import Stepper, compiled, identity
from pathjax.inverse.normal import NormalEquations
from pathjax.inverse.problem import Problem
from pathjax.inverse.uncertainty import Solution
from pathjax.system.interrupts import Interrupts


class State:
    """The values, and the results of the last renders at or near them."""

    def __init__(
        self, problem: Problem, spp: int, seed: int, solver, progress: Callable | None, interrupts: Interrupts
    ):
        self.problem, self.vector = problem, problem.vector
        self.groups = [views.everywhere() for views in problem.groups]
        self.spp, self.seed, self.solver = spp, jnp.uint32(seed), solver
        self.progress, self.interrupts = progress, interrupts
        self.dtype = self.groups[0].targets.dtype
        normal.check_memory(self.vector, self.dtype)
        self.values = problem.start.astype(float)  # (n,)
        self.scale = self.vector.scale(self.values)  # (n,) units of `solution`
        self.free = np.ones(len(self.values), bool)  # (n,) False: held at a bound
        self.normal: NormalEquations | None = None  # of the last two renders, in units of `scale`
        self.noise: weights.Noise | None = None
        count = sum(views.targets.size for views in self.groups) // 3
        self.weights = np.ones((count, 3), self.dtype)  # (N, 3) 1/variance; 0: left out
        self.solution: Solution | None = None
        self.history: list[dict] = []
        self.draws = 0
        self.started, self.compile_seconds = time.perf_counter(), 0.0

    def next_draw(self) -> jax.Array:
        """Return the number of a new draw, for renders that are independent of all before."""
        self.draws += 1
        return jnp.uint32(self.draws)

    def program(self, function: Callable, *arguments, solver=None, **static):
        """Return a function of the vector, or with a solver a `Stepper` on it, compiled for these arguments."""
        key = function, identity(solver), self.vector, *static.items()
        function = partial(function, vector=self.vector, **static)
        make = partial(Stepper, solver, function) if solver else lambda *a: jax.jit(function).lower(*a).compile()
        program, seconds = compiled(key, make, *arguments)
        self.compile_seconds += seconds
        return program

    def evaluate(self, spp: int, draw, images: np.ndarray | None = None) -> None:
        """Evaluate the normal equations of two renders at the values. images: (N, 3, K) as for `normal.sums`."""
        if images is None and any(target.step.any() for target in self.problem.targets):
            images = np.zeros((*self.weights.shape, uncertainty.ROUNDING_IMAGES))  # for a single program
        arrays = (jnp.asarray(a, self.dtype) for a in (self.values, self.scale, self.weights))
        images = None if images is None else jnp.asarray(images, self.dtype)
        arguments = self.groups, *arrays, jnp.uint32(spp), self.seed, draw, images
        program = self.program(normal.sums, *arguments, side=self.problem.side)
        self.normal = jax.tree.map(np.asarray, program(*arguments))

    def weigh(self, spp: int, refining: bool = False) -> None:
        """Set the weights from the noise of renders of `spp` samples at the current values and the target's rounding.

        Clipped values of the target have weight 0; when refining, so have those that noise may have clipped.
        """
        self.scale = self.vector.scale(self.values)
        self.evaluate(weights.NOISE_SPP, self.next_draw())
        halves, problem = self.halves(), self.problem
        self.noise = weights.noise(halves, problem, spp)
        usable = [target.usable for target in problem.targets]
        if refining:
            unclipped = weights.surely_unclipped(halves, problem, self.noise)
            usable = [u & sure for u, sure in zip(usable, unclipped, strict=True)]
        by_view = [u / variance for u, variance in zip(usable, self.noise.values, strict=True)]
        self.weights = problem.flat(by_view).astype(self.dtype)

    def solve(self, free: np.ndarray) -> None:
        self.solution = uncertainty.solve(self.normal, free)

    def halves(self) -> weights.Halves:
        """Return the residuals (H, W, 3) of the two renders, for each view."""
        return list(zip(*map(self.problem.by_view, self.normal.residuals), strict=True))

    def structure(self) -> tuple[float, bool]:
        """Return how well neighbouring residuals agree, and whether that is more than chance."""
        used = [weight > 0 for weight in self.problem.by_view(self.weights)]
        return weights.structure(self.halves(), self.problem, self.noise, used)

    def record(self, stage: str, spp: int, loss: float) -> None:
        values = dict(zip(self.vector.labels, self.values.tolist(), strict=True))
        seconds = time.perf_counter() - self.started
        self.history.append({"stage": stage, "spp": spp, "values": values, "loss": loss, "seconds": seconds})
        if self.progress:
            self.progress(self.history[-1])
        distributed.heard(self.interrupts)  # its exception may have been lost during garbage collection
