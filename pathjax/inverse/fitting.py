"""Parameters from images, with their uncertainty.

A fixed seed makes a rendered image a deterministic function, which an optimistix solver can fit to a target; but the
square of its noise moves the minimum. So a fit has two stages. First a least-squares solver approaches the minimum with
few samples. Then two independent renders A and B replace the square by a product: the score

    g = (J_A' W r_B + J_B' W r_A) / 2,    r = image - target,

has mean 0 at the truth, whatever the noise of the renders, and noise does not enlarge its matrix (J_A' W J_B + J_B' W
J_A) / 2 either. Newton's method finds its root; its scatter over pixels gives the covariance. Pixels of the renders are
independent. Those of a target may share samples under a wide filter: then the scatter is taken over blocks of pixels.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Real

from pathjax import distributed
from pathjax.compile import standard_promotion
from pathjax.errors import InputError
from pathjax.integrators.options import check_counts
from pathjax.inverse import problem, uncertainty, weights
from pathjax.inverse.approach import approach
from pathjax.inverse.dense import Dense, is_dense
from pathjax.inverse.many import Search
from pathjax.inverse.prior import KINDS, Prior
from pathjax.inverse.problem import Problem
from pathjax.inverse.refine import refine
from pathjax.inverse.scan import scan as scanned
from pathjax.inverse.state import State
from pathjax.inverse.target import Target
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.scene import Scene
from pathjax.system.interrupts import Interrupts

Seen = Target | Real[Array | np.ndarray, "height width 3"]


@dataclass
class Fit:
    """The result of a fit: values of the parameters and their uncertainty.

    Components are scalar parameters, or the channels of colours: `white.reflectance.r`.
    """

    values: dict[str, np.ndarray]
    standard_errors: dict[str, np.ndarray]  # inf: the images do not determine it
    # (n, n) in the order of `components`; undetermined ones have variance inf, covariances nan. None: many scalars.
    covariance: np.ndarray | None
    components: list[str]
    undetermined: list[dict[str, float]]  # directions that the images do not determine: component -> change
    at_bound: list[str]  # components that ended at a bound of their parameter
    converged: bool
    message: str  # why the fit ended, and warnings
    images: list[np.ndarray]  # (H, W, 3) per view, at the end
    residuals: list[np.ndarray]  # (H, W, 3) per view: image - target, in standard deviations; nan where left out
    history: list[dict]  # per step: stage, spp, values, loss, seconds
    compile_seconds: float
    run_seconds: float
    scenes: list[Scene]  # the views, at the fitted values
    # Per texture with `smoothness`: the assumed difference of neighbours, and the power (`inverse.prior`).
    smoothness: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def scene(self) -> Scene:
        """The first view, at the fitted values."""
        return self.scenes[0]

    @property
    def seen(self) -> dict[str, np.ndarray]:
        """By name, which texels and other parameters the images determine: bool, of their shape without channels."""
        known = self.scene.described.parameters
        return {
            name: np.isfinite(error).all(-1) if known[name].is_color else np.isfinite(error)
            for name, error in self.standard_errors.items()
        }

    @property
    def correlation(self) -> np.ndarray | None:
        """(n, n) correlation; nan for undetermined components. None: fits of many scalars."""
        if self.covariance is None:
            return None
        sigma = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(sigma, sigma)


@agreed_by_all
@standard_promotion
def fit(
    scene: Scene | Sequence[Scene],
    target: Seen | Sequence[Seen],
    names: Sequence[str],
    *,
    start: Mapping[str, ArrayLike | Sequence[float]] | None = None,
    spp: int = 128,
    seed: int = 0,
    solver: object = None,
    scan: bool = True,
    smoothness: float | str | None = None,
    prior: str = KINDS[0],
    progress: bool | Callable[[dict], None] = False,
) -> Fit:
    """Find parameters with which the scene looks like the target.

    Args:
        scene: a scene, or a list of views; views share parameters by name.
        target: linear RGB or a `Target`, as `read_target` returns it; or a list of them, one for each view.
            Its noise must be independent from pixel to pixel, except where pixels share samples under the filter of
            the scene's film; the fit estimates how large it is.
        names: of the parameters to recover, as `parameters` lists them.
        start: initial values by name; default: the scene's.
        spp: samples per pixel of each of the two independent renders of the last stage.
        seed: of the first render; all others follow from it.
        solver: an optimistix least-squares solver or minimiser for the approach; default: LevenbergMarquardt.
        scan: try indices of refraction over their whole range first, since a local method finds the nearest minimum.
        smoothness: for textures, the expected root mean square difference of neighbouring texels, in units of the
            parameter; "auto" estimates it, and the power of the Laplacian; None: nothing is assumed about neighbours.
        prior: "laplacian", for differences that are alike everywhere; or "total variation", for a few large ones, as
            at edges, whose mean is then `smoothness`: see `inverse.prior.Prior`.
        progress: True for a line on stderr at each step, or a function that is called with each entry of the history;
            with several processes, only in the first.
    Returns:
        Fit. Ctrl-C ends it with the values so far, marked as not converged.
    Raises:
        InputError: an unknown or repeated name, a start outside its bounds, a target of another size or with negative
            or non-finite values, fewer measured pixels than unknowns other than texels; smoothness without a texture;
            more parameters than fit into memory.
    Standard errors come from the scatter of the scores over pixels (White 1980). They include the noise of target, its
    rounding, renders and Jacobians, and assume that the scene can look like the target: `converged` is False where
    neighbouring residuals agree too well for noise (`uncertainty.structure`). The differences that replace derivatives
    in an IOR have a bias (`jacobian`), which does not move the root of the score.
    For textures, and for more than 300 scalars together, they are those of the posterior: exact for few enough texels
    and pixels (`dense`), else from a few draws of it and uncertain by 10 to 20 % (`many`); and inf where pixels tell
    nothing about a texel, which keeps its prior value.
    Clipped pixels are left out, and so are those that noise may have clipped: leaving out only those that it did clip
    would keep the darker ones. Renders and the noise around decide which these are, never the pixel itself.
    """
    check_counts(spp, seed)
    chosen, solver = solver, solver or optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
    if not isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise InputError(f"solver is a {type(solver).__name__}; use a least-squares solver or minimiser of optimistix")
    tell = _print_step if progress is True else progress or None
    if distributed.index():
        tell = None
    views = problem.build(scene, target, names, start or {})
    if problem.is_large(views.vector):
        if chosen is not None:
            raise InputError("solver is of fits of few numbers; textures have one of their own, so leave it out")
        return _fit_many(views, spp, seed, Prior(views.vector, views.start, smoothness, prior), tell)
    if smoothness is not None or prior != KINDS[0]:
        raise InputError("smoothness and prior are about the texels of textures, and none is fitted")
    with Interrupts() as interrupts:
        state = State(views, spp, seed, solver, tell, interrupts)
        try:
            with distributed.interruptible(interrupts):
                converged, message = _stages(state, scan)
        except KeyboardInterrupt:
            converged, message = False, "interrupted"
        return _result(state, converged, message)


def _fit_many(problem: Problem, spp: int, seed: int, prior: Prior, tell) -> Fit:
    with Interrupts() as interrupts:
        search = (Dense if is_dense(problem) else Search)(problem, spp, seed, prior, tell, interrupts)
        try:
            with distributed.interruptible(interrupts):
                converged, message = search.run()
        except KeyboardInterrupt:
            converged, message = False, "interrupted"
        vector = problem.vector
        values = vector.unpack(search.values)
        images, residuals = _seen(problem, search.halves, search.noise) if search.noise else ([], [])
        at_bound = (search.values <= search.low) | (search.values >= search.high)
        labels = vector.labels
        return Fit(
            values=values,
            standard_errors=vector.unpack(search.standard_errors),
            covariance=None,
            components=labels,
            undetermined=[],
            at_bound=[labels[i] for i in np.flatnonzero(at_bound)],
            converged=converged,
            message=message,
            images=images,
            residuals=residuals,
            history=search.history,
            compile_seconds=search.products.compile_seconds,
            run_seconds=time.perf_counter() - search.started - search.products.compile_seconds,
            scenes=[problem.with_values(scene, values) for scene in problem.scenes],
            smoothness={name: (difference, prior.power[name]) for name, difference in prior.difference.items()},
        )


def step_text(entry: dict) -> str:
    """One line for an entry of the history."""
    values = "  ".join(f"{label} {value:.4g}" for label, value in entry["values"].items())
    return f"{entry['stage']}, {entry['spp']} spp: {values}"


def _print_step(entry: dict) -> None:
    with contextlib.suppress(OSError):  # the fit goes on if the terminal is gone
        print(step_text(entry), file=sys.stderr)


def _stages(state: State, scan: bool) -> tuple[bool, str]:
    """Approach from each of the initial values until residuals are noise, and refine the best result."""
    best = None
    for values in scanned(state) if scan else [state.values]:
        # A local method ends in the nearest minimum; residuals with structure show a wrong one.
        state.values = values
        approach(state)
        state.weigh(state.spp, refining=True)
        agreement, structured = state.structure()
        if best is None or agreement < best[0]:
            best = agreement, state.values
        if not structured:
            break
    if state.values is not best[1]:
        state.values = best[1]
        state.weigh(state.spp, refining=True)
    return refine(state)


def _result(state: State, converged: bool, message: str) -> Fit:
    problem, vector, solution = state.problem, state.vector, state.solution
    labels, values = vector.labels, vector.unpack(state.values)
    covariance, undetermined = np.full((len(labels),) * 2, np.nan), []
    if solution is not None:
        covariance = solution.covariance * np.outer(state.scale, state.scale)
        for direction in solution.undetermined.T:
            largest = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > uncertainty.NAMED_SHARE]
            undetermined.append({labels[i]: float(direction[i] * state.scale[i]) for i in largest})
        unknown = (np.abs(solution.undetermined) > uncertainty.TOUCHED_SHARE).any(1)
        covariance[unknown] = covariance[:, unknown] = np.nan
        covariance[unknown, unknown] = np.inf
    images, residuals = _seen(problem, state.halves(), state.noise) if state.noise else ([], [])
    return Fit(
        values=values,
        standard_errors=vector.unpack(np.sqrt(np.diag(covariance))),
        covariance=covariance,
        components=labels,
        undetermined=undetermined,
        at_bound=[labels[i] for i in np.flatnonzero(~state.free)],
        converged=converged,
        message=message,
        images=images,
        residuals=residuals,
        history=state.history,
        compile_seconds=state.compile_seconds,
        run_seconds=time.perf_counter() - state.started - state.compile_seconds,
        scenes=[problem.with_values(scene, values) for scene in problem.scenes],
    )


def _seen(problem: Problem, halves: weights.Halves, noise: weights.Noise):
    """Return the images of the views (H, W, 3), and their residuals in standard deviations."""
    images, residuals = [], []
    for (a, b), target, variance in zip(halves, problem.targets, noise.values, strict=True):
        mean = (a + b) / 2
        images.append((mean + target.image) / problem.exposure)
        # Divide by the noise of both: the scatter of the residuals themselves shows how noisy the target is.
        relative = np.where(target.usable, mean / np.sqrt(variance), np.nan)
        spread = np.nanstd(relative) if target.usable.any() else 1.0
        residuals.append(relative / max(spread, np.finfo(float).tiny))
    return images, residuals
