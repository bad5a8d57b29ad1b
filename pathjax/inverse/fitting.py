"""Parameters from images, with their uncertainty.

A fixed seed makes a rendered image a deterministic function, which an optimistix solver can fit to a target; but the
square of its noise moves the minimum. So a fit goes in two stages. A solver of least squares approaches, with few
samples. Then two independent renders A and B replace the square by a product: the score

    g = (J_A' W r_B + J_B' W r_A) / 2,    r = image - target,

has mean 0 at the truth, whatever the noise of the renders, and its matrix (J_A' W J_B + J_B' W J_A) / 2 is not too
large either. Newton's method finds its root; its scatter over the pixels, which are independent, gives the covariance.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy import ndimage

from pathjax.compile.runtime import usual_promotion
from pathjax.derivatives.gradient import ior_at, is_glass
from pathjax.errors import InputError
from pathjax.inverse import losses, problem, uncertainty
from pathjax.inverse.problem import Problem
from pathjax.inverse.programs import Stepper, kept
from pathjax.inverse.uncertainty import Evidence
from pathjax.scene.parameters import with_parameters
from pathjax.scene.scene import Scene
from pathjax.system.interrupts import Interrupts

# Samples per pixel of the approach. Newton's method begins with a part of the samples that `fit` is given.
APPROACH_SPP, COARSE_PART = 16, 4
MAX_STEPS, MAX_REJECTED, MAX_NEWTON_STEPS = 30, 3, 8
# Newton's method ends with a step below this part of the standard errors, and takes none beyond this part of the scale.
SMALL_STEP, LARGE_STEP = 0.3, 0.3
# Samples per pixel of each of the two renders that tell how noisy every pixel is.
NOISE_SPP = 8
# Variances are floored at this part of their mean, so that no pixel weighs beyond measure.
NOISE_FLOOR = 0.05
# Pixels are left out that lie this many standard deviations of noise or less below the level where the target is
# clipped: what is then lost of normal noise moves their mean by 1e-4 standard deviations.
CLIP_MARGIN = 4
# What float32 leaves of the mean of a pixel; scenes without noise are fitted to that.
ROUNDING = 1e-5
# Relative indices of refraction to try before a local method begins, from almost none to diamond's; a few at a time.
SCAN, SCAN_SPP, SCAN_CHUNK = np.geomspace(1.02, 2.6, 64), 4, 16
SCAN_CANDIDATES = 3


@dataclass
class Fit:
    """What the images say about the parameters.

    Components are the parameters, or the channels of colours: `white.reflectance.r`.
    """

    values: dict[str, np.ndarray]
    standard_errors: dict[str, np.ndarray]  # inf: the images do not determine it
    covariance: np.ndarray  # (n, n) in the order of `components`; rows of what is not determined: inf, nan beside it
    components: list[str]
    undetermined: list[dict[str, float]]  # directions that the images do not determine: component -> change
    at_bound: list[str]  # components that ended at a bound of their parameter
    converged: bool
    message: str  # why it ended, and what to mind
    images: list[np.ndarray]  # of each view (H, W, 3), at the end
    residuals: list[np.ndarray]  # of each view (H, W, 3): image - target, in standard deviations; nan where left out
    history: list[dict]  # of each step: stage, spp, values, loss, seconds
    compile_seconds: float
    run_seconds: float
    scenes: list[Scene]  # the views, at the fitted values

    @property
    def scene(self) -> Scene:
        """The first view, at the fitted values."""
        return self.scenes[0]

    @property
    def correlation(self) -> np.ndarray:
        """(n, n); nan beside what is not determined."""
        sigma = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(sigma, sigma)


@usual_promotion
def fit(
    scene: Scene | Sequence[Scene],
    target,
    names: Sequence[str],
    *,
    start: Mapping | None = None,
    spp: int = 128,
    seed: int = 0,
    solver=None,
    scan: bool = True,
    progress: bool | Callable[[dict], None] = False,
) -> Fit:
    """Find parameters with which the scene looks like the target.

    Args:
        scene: a scene, or a list of views; views share parameters by name.
        target: linear RGB (H, W, 3) or a `Target`, as `read_target` returns it; or a list of them, one for each view.
            Its noise must be independent from pixel to pixel; how large it is, the fit finds out.
        names: parameters to recover, of `parameters`.
        start: values to begin with; default: the scene's.
        spp: samples per pixel of each of the two independent renders of the last stage.
        solver: an optimistix least-squares solver or minimiser for the approach; default: LevenbergMarquardt.
        scan: try indices of refraction over their whole range first, since a local method finds the nearest minimum.
        progress: True for a line on stderr at each step, or a function that is called with each entry of the history.
    Returns:
        Fit. Ctrl-C ends it with what it has, marked as not converged.
    Raises:
        InputError: an unknown or repeated name, a start outside its bounds, a target of another size, with negative or
            non-finite values, fewer measured pixels than unknowns.
    Standard errors come from the scatter of the scores over pixels (White 1980). They hold the noise of target, its
    rounding, renders and Jacobians, and suppose that the scene can look like the target: `converged` is False where
    neighbouring residuals agree too well for noise (`uncertainty.structure`). The differences that stand for
    derivatives in an IOR have a bias (`jacobian`), which does not move the root of the score.
    Clipped pixels are left out, and so are those that noise may have clipped: to leave out only those that it did clip
    would keep the darker ones. Which these are is told by renders and the noise around, never by the pixel itself.
    """
    if not isinstance(spp, int) or not 1 <= spp < 2**31:
        raise InputError(f"spp = {spp}; it must be an integer in [1, 2^31)")
    if not isinstance(seed, int) or not 0 <= seed < 2**31:
        raise InputError(f"seed = {seed}; it must be an integer in [0, 2^31)")
    solver = solver or optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
    if not isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise InputError(f"{type(solver).__name__} is no least-squares solver or minimiser of optimistix")
    if progress is True:
        progress = _tell
    return _Run(problem.build(scene, target, names, start or {}), spp, seed, solver, progress).run(scan)


def step_text(entry: dict) -> str:
    """One line for an entry of the history."""
    values = "  ".join(f"{label} {value:.4g}" for label, value in entry["values"].items())
    return f"{entry['stage']}, {entry['spp']} spp: {values}"


def _render_variance(a, b) -> np.ndarray:
    """(H, W, 1) variance of each of two independent renders, or of their residuals, smoothed over neighbours."""
    return ndimage.uniform_filter(((a - b) ** 2).mean(-1, keepdims=True) / 2, (3, 3, 1))


def _tell(entry: dict) -> None:
    with contextlib.suppress(OSError):  # a terminal that is gone costs no fit
        print(step_text(entry), file=sys.stderr)


class _Run:
    def __init__(self, problem: Problem, spp: int, seed: int, solver, progress):
        self.problem, self.spp, self.solver, self.progress = problem, spp, solver, progress
        self.coordinates, self.groups = problem.coordinates, problem.groups
        self.dtype = self.groups[0].targets.dtype
        self.seed, self.draw = jnp.uint32(seed), 0
        self.v = problem.start.astype(float)
        self.n = len(self.v)
        self.history: list[dict] = []
        self.started, self.compile_seconds = time.perf_counter(), 0.0
        self.evidence: Evidence | None = None
        self.weights = [jnp.ones_like(views.targets) for views in self.groups]
        # Of each view the variance of a render, and with that of the target's rounding.
        self.noise = self.variances = [np.ones(target.image.shape) for target in problem.targets]
        self._scan = self._approach = self._refine = self.solution = None
        brightness = np.concatenate([target.image[target.usable] for target in problem.targets]).mean()
        self.brightness = max(brightness, np.finfo(np.float32).tiny ** 0.25)
        self.free, self.scale = np.ones(self.n, bool), self.coordinates.scale(self.v)

    def run(self, scan: bool) -> Fit:
        with Interrupts() as interrupts:
            try:
                with interrupts.raised():
                    converged, message = self._stages(scan)
            except KeyboardInterrupt:
                converged, message = False, "interrupted"
            return self._result(converged, message)

    def _stages(self, scan):
        candidates = self._scanned() if scan else [self.v]
        best = None
        for v in candidates:
            # A local method ends in the nearest minimum; a wrong one shows in its residuals.
            self.v = v
            self._approach_with(min(APPROACH_SPP, self.spp))
            self._weigh(self.spp, refining=True)
            agreement, structured = self._structure()
            if best is None or agreement < best[0]:
                best = agreement, self.v
            if not structured:
                break
        if self.v is not best[1]:
            self.v = best[1]
            self._weigh(self.spp, refining=True)
        return self._refined()

    # ---- approach: least squares with a fixed seed ------------------------------------------------------------------

    def _approach_with(self, spp):
        self._weigh(spp)
        x = jnp.asarray(self.coordinates.unbounded(self.v), self.dtype)
        # In units of the noise at this level; but a start far off is no more than 1 on average, since the first steps
        # of solvers suppose numbers of that size.
        squares = self._flat_weights() * self.evidence.residuals[0] ** 2
        shrink = 1 / max(1, float(squares.mean()))
        weights = [weight * shrink for weight in self.weights]
        arguments = self.groups, weights, jnp.uint32(spp), self.seed, self._next_draw()
        if self._approach is None:
            least_squares = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
            fn = self._bind(losses.residuals if least_squares else losses.loss)
            key = losses.residuals if least_squares else losses.loss, repr(self.solver)
            self._approach = self._compiled(key, partial(Stepper, self.solver, fn), x, arguments)
        state = self._approach.begin(x, arguments)
        lowest, rejected = np.inf, 0
        for _ in range(MAX_STEPS):
            x, state, loss, done = self._approach.step(x, state, arguments)
            loss = float(loss) / shrink
            self.v = np.asarray(self.coordinates.bounded(x), float)
            self._record("approach", spp, loss)
            # The solver tells the loss one step late, and the same one again after a step that it took back. A step
            # that gains less than the loss is uncertain by is left to the next stage.
            rejected = rejected + 1 if loss == lowest else 0
            if bool(done) or rejected > MAX_REJECTED or 0 < lowest - loss < max(self.n / 2, np.sqrt(loss)):
                break
            lowest = min(lowest, loss)

    # ---- refinement: the root of the score of two independent renders -----------------------------------------------

    def _refined(self):
        low, high = self.coordinates.bounds.T
        converged = False
        self._newton(max(self.spp // COARSE_PART, 1), small=1)
        while not converged:
            converged = self._newton(self.spp, SMALL_STEP)
            outside = self.free & ((self.v < low) | (self.v > high))
            self.v = np.clip(self.v, low, high)
            if not converged or not outside.any():
                break
            # What wants to leave its bounds stays there, and the others are fitted again.
            self.free &= ~outside
            converged = False
        # Where a bound holds a component, the curvature still says how well it is known.
        everything = np.ones(self.n, bool)
        solution = uncertainty.solve(self.evidence, self._flat_weights(), self.scale, everything)
        self.solution = solution._replace(covariance=solution.covariance + self._rounding_covariance(solution))
        agreement, structured = self._structure()
        if structured:
            return False, (
                f"the residuals have structure: neighbouring pixels are correlated by {agreement:.0%}. This is a "
                "local minimum, or the scene cannot look like the target; try other starts, and look at the residuals"
            )
        if not converged:
            return False, f"Newton's method did not settle in {MAX_NEWTON_STEPS} steps; try more spp, or another start"
        message = "converged: the last step is small against the standard errors, the residuals are noise"
        left_out = (self._flat_weights() == 0).mean()
        if left_out:
            message += f"; {left_out:.2g} of the target's values are clipped, may be, or are not measured"
        if self.solution.undetermined.size:
            message += "; but the images do not determine all that was asked"
        return True, message

    def _newton(self, spp, small) -> bool:
        """Steps until one is below `small` standard errors; whether one was."""
        self.scale = scale = self.coordinates.scale(self.v)
        self.solution = uncertainty.solve(self.evidence, self._flat_weights(), scale, self.free)
        draw, base, z = self._next_draw(), self.v, np.zeros(self.n)
        for _ in range(MAX_NEWTON_STEPS):
            projector = self.solution.projector
            moved = self._newton_step(z, base, scale, projector, spp, draw)
            step = np.clip(moved - z, -LARGE_STEP, LARGE_STEP)
            z = z + step
            self.v = base + scale * z
            self.solution = uncertainty.solve(self.evidence, self._flat_weights(), scale, self.free)
            sigma = np.sqrt(np.diag(self.solution.covariance))
            self._record("refine", spp, float(self._mean_product()))
            same_rank = round(np.trace(projector)) == round(np.trace(self.solution.projector))
            if same_rank and np.all(np.abs(step) <= small * sigma + np.finfo(self.dtype).eps):
                return True
        return False

    def _newton_step(self, z, base, scale, projector, spp, draw):
        """(n,) where Newton's method goes from z; leaves the evidence at z."""
        z, base, scale, projector = (jnp.asarray(a, self.dtype) for a in (z, base, scale, projector))
        arguments = base, scale, projector, self.groups, self.weights, jnp.uint32(spp), self.seed, draw
        if self._refine is None:
            fn, newton = self._bind(losses.score), optx.Newton(rtol=1e-6, atol=1e-6)
            self._refine = self._compiled(losses.score, partial(Stepper, newton, fn), z, arguments)
        moved, _, evidence, _ = self._refine.step(z, self._refine.begin(z, arguments), arguments)
        self.evidence = jax.tree.map(np.asarray, evidence)
        return np.asarray(moved, float)

    def _weigh(self, spp, refining=False):
        """Weights from the noise of renders of `spp` samples at the current values, and of the target's rounding.

        The target's own noise is taken to be like that of the renders. While the values are approached, clipped pixels
        have no weight; when they are refined, neither have those that noise may have clipped.
        """
        zero, scale, nowhere = np.zeros(self.n), self.coordinates.scale(self.v), np.zeros((self.n, self.n))
        self._newton_step(zero, self.v, scale, nowhere, NOISE_SPP, self._next_draw())
        targets, variances = self.problem.targets, []
        for a, b in self._halves():
            variance = _render_variance(a, b) * (NOISE_SPP / spp)
            variances.append(variance + NOISE_FLOOR * variance.mean() + (ROUNDING * self.brightness) ** 2)
        self.variances = variances
        self.noise = [v + target.step**2 / 12 for v, target in zip(variances, targets, strict=True)]
        usable = [target.usable for target in targets]
        if refining:
            ratio = self._target_ratio(2)
            for i, ((a, b), target) in enumerate(zip(self._halves(), targets, strict=True)):
                # The image is known by two renders and three by three pixels.
                image = ndimage.uniform_filter((a + b) / 2 + target.image, (3, 3, 1))
                variance = variances[i] * (ratio + spp / NOISE_SPP / 18) + target.step**2 / 12
                usable[i] = usable[i] & (image + CLIP_MARGIN * np.sqrt(variance) < target.ceiling)
        weights = [u / noise for u, noise in zip(usable, self.noise, strict=True)]
        self.weights = [jnp.asarray(np.stack([weights[i] for i in views.numbers]), self.dtype) for views in self.groups]

    def _target_ratio(self, errors) -> float:
        """Variance of the targets over that of renders of `spp` samples, and so many of its standard errors.

        At most that of one sample per pixel: what is more is a misfit.
        """
        ratios = np.concatenate(
            [
                ((a * b - target.step**2 / 12) / variance)[target.usable]
                for (a, b), target, variance in zip(self._halves(), self.problem.targets, self.variances, strict=True)
            ]
        )
        return float(np.clip(ratios.mean() + errors * ratios.std() / np.sqrt(ratios.size), 0, self.spp))

    # ---- scan: where a local method should begin --------------------------------------------------------------------

    def _scanned(self) -> list[np.ndarray]:
        """Values to begin with, the most promising first."""
        names = [name for name, p in self.coordinates.parameters if is_glass(p)]
        candidates = [self.v]
        if names:
            if len(names) < len(self.coordinates.parameters):
                # Colours first: a wrong index of refraction leaves them nearly right, and wrong ones may hide it.
                self._approach_with(min(APPROACH_SPP, self.spp))
            self._weigh(SCAN_SPP)
        for name in names * min(len(names), 2):
            tried = np.stack([self._at_ratio(name, ratio) for ratio in SCAN])
            misfits = np.concatenate([self._misfits(chunk) for chunk in np.split(tried, len(SCAN) // SCAN_CHUNK)])
            low = [i for i in range(len(SCAN)) if misfits[i] == misfits[max(i - 1, 0) : i + 2].min()]
            low = sorted(low, key=lambda i: misfits[i])[:SCAN_CANDIDATES]
            candidates = [tried[i] for i in low]
            self.v = candidates[0]
            self._record("scan", SCAN_SPP, float(misfits[low[0]]))
        return candidates

    def _misfits(self, candidates):
        candidates = jnp.asarray(candidates, self.dtype)
        # All candidates see the same noise.
        arguments = self.groups, self.weights, jnp.uint32(SCAN_SPP), self.seed, jnp.uint32(0)
        if self._scan is None:
            f = jax.jit(self._bind(losses.misfits))
            self._scan = self._compiled(losses.misfits, lambda *a: f.lower(*a).compile(), candidates, arguments)
        return np.asarray(self._scan(candidates, arguments))

    def _at_ratio(self, name, ratio):
        holder = next(s for s in self.problem.scenes if name in s.about.parameters)
        values = self.coordinates.unpack(self.v.copy())
        return self.coordinates.pack({**values, name: ior_at(self._at_values(holder, values), name, ratio)})

    # ---- the rest ---------------------------------------------------------------------------------------------------

    @staticmethod
    def _at_values(scene, values):
        return with_parameters(scene, {name: v for name, v in values.items() if name in scene.about.parameters})

    def _next_draw(self):
        self.draw += 1
        return jnp.uint32(self.draw)

    def _bind(self, f):
        return partial(f, coordinates=self.coordinates)

    def _compiled(self, key, make, *arguments):
        program, seconds = kept((key, self.coordinates), make, *arguments)
        self.compile_seconds += seconds
        return program

    def _record(self, stage, spp, loss):
        values = dict(zip(self.coordinates.labels, self.v.tolist(), strict=True))
        seconds = time.perf_counter() - self.started
        entry = {"stage": stage, "spp": spp, "values": values, "loss": loss, "seconds": seconds}
        self.history.append(entry)
        if self.progress:
            self.progress(entry)

    def _flat_weights(self):
        return np.concatenate([np.asarray(weight).reshape(-1, 3) for weight in self.weights])

    def _by_view(self, flat):
        """(N, 3) over all views to a list of (H, W, 3) in the caller's order."""
        images, first = {}, 0
        for views in self.groups:
            shape = views.targets.shape
            size = int(np.prod(shape[:3]))
            stack = np.asarray(flat[first : first + size]).reshape(shape)
            images.update(zip(views.numbers, stack, strict=True))
            first += size
        return [images[i] for i in range(len(images))]

    def _flat(self, by_view):
        """The inverse of `_by_view`."""
        return np.concatenate([by_view[i].reshape(-1, 3) for views in self.groups for i in views.numbers])

    def _halves(self):
        """Residuals of the two renders, (H, W, 3) each, of each view."""
        return list(zip(*map(self._by_view, self.evidence.residuals), strict=True))

    def _mean_product(self):
        """Half the weighted product of the two renders' residuals: the misfit without the renders' noise."""
        a, b = self.evidence.residuals
        return (self._flat_weights() * a * b).sum() / 2

    def _rounding_covariance(self, solution):
        """(n, n) of the error that rounded pixels have in common, in units of the scale; noise hides it."""
        if not any(target.step.any() for target in self.problem.targets):
            return np.zeros((self.n, self.n))
        steps, phases, noises, ratio = [], [], [], self._target_ratio(-2)
        for (a, b), target in zip(self._halves(), self.problem.targets, strict=True):
            step = np.where(target.step > 0, target.step, np.inf)
            # Neighbours are of nearly equal value where this matters, and their mean is less noisy.
            image = ndimage.uniform_filter((a + b) / 2 + target.image, (5, 5, 1))
            steps.append(target.step)
            phases.append((image - target.image) / step)
            # Of each channel by itself, without a floor: one may be rounded alike where others are noisy.
            noises.append(np.sqrt(ratio * ndimage.uniform_filter((a - b) ** 2 / 2, (5, 5, 1))) / step)
        jacobian = self.evidence.jacobians.mean(0) * self._flat_weights()[..., None] * self.scale
        return uncertainty.rounding_covariance(
            jacobian @ solution.inverse, *(self._flat(parts) for parts in (steps, phases, noises))
        )

    def _structure(self):
        """How well neighbouring residuals agree, and whether that is no chance."""
        # The noise is that of other renders: a firefly that raised its own would weigh less, and residuals be biased.
        noises, rounding = [np.sqrt(noise) for noise in self.noise], ROUNDING * self.brightness
        means = [(a + b) / 2 for a, b in self._halves()]
        used = [weight > 0 for weight in self._by_view(self._flat_weights())]
        parts = list(zip(means, noises, used, self.problem.targets, strict=True))
        unit = uncertainty.deviation(np.concatenate([(m / n)[u & (np.abs(m) > rounding)] for m, n, u, _ in parts]))
        misfits = []
        for mean, noise, use, target in parts:
            # Of pixels that are clipped, or may be, only what is beyond noise is known to be wrong.
            misfit = target.misfit(target.image + mean, np.where(use, 0, CLIP_MARGIN * noise * unit))
            misfits.append(np.where(np.abs(mean) > rounding, misfit, 0) / (noise * unit))
        agreement, significance = uncertainty.structure(misfits)
        return agreement, significance > uncertainty.STRUCTURE_SIGNIFICANCE

    def _result(self, converged, message) -> Fit:
        labels, values = self.coordinates.labels, self.coordinates.unpack(self.v)
        covariance, undetermined, at_bound = np.full((self.n, self.n), np.nan), [], []
        if self.solution is not None:
            covariance = self.solution.covariance * np.outer(self.scale, self.scale)
            for direction in self.solution.undetermined.T:
                largest = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > uncertainty.NAMED_SHARE]
                undetermined.append({labels[i]: float(direction[i] * self.scale[i]) for i in largest})
            unknown = (np.abs(self.solution.undetermined) > uncertainty.TOUCHED_SHARE).any(1)
            covariance[unknown] = covariance[:, unknown] = np.nan
            covariance[unknown, unknown] = np.inf
            at_bound = [labels[i] for i in np.flatnonzero(~self.free)]
        errors = np.sqrt(np.diag(covariance))
        scenes = [self._at_values(scene, values) for scene in self.problem.scenes]
        images, residuals = [], []
        if self.evidence is not None:
            for (a, b), target, noise in zip(self._halves(), self.problem.targets, self.noise, strict=True):
                mean = (a + b) / 2
                images.append((mean + target.image) / self.problem.exposure)
                # Of both: the scatter of the residuals themselves says how noisy the target is.
                relative = np.where(target.usable, mean / np.sqrt(noise), np.nan)
                spread = np.nanstd(relative) if target.usable.any() else 1.0
                residuals.append(relative / max(spread, np.finfo(float).tiny))
        seconds = time.perf_counter() - self.started
        return Fit(
            values,
            self.coordinates.unpack(errors),
            covariance,
            labels,
            undetermined,
            at_bound,
            converged,
            message,
            images,
            residuals,
            self.history,
            self.compile_seconds,
            seconds - self.compile_seconds,
            scenes,
        )
