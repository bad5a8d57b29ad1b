"""Fits of many scalars, such as texels: Gauss-Newton with J v and J^T v, without J. (`dense` stores J' W J.)

    (J' W J + P + damping) step = J' W (target - image) + P (mean - values)

is solved by conjugate gradients, with P the precision of a `Prior`. All products of a step use the same paths for J,
independent of those of the image, so that noise does not bias the right-hand side; every step has fresh ones. Samples
are few at first, and more once the image misses the target by no more than its noise. Pixels that tell nearly nothing
are left out.

Standard errors come from draws of the posterior: with e1 and e2 unit normal vectors, the solution for the right-hand
side J' W^(1/2) e1 + P^(1/2) e2 has the covariance (J' W J + P)^-1 (Papandreou and Yuille 2010, NIPS).
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.sparse.linalg import LinearOperator, cg

from pathjax import distributed
from pathjax.errors import InputError
from pathjax.inverse import weights
from pathjax.inverse.prior import Prior, is_grid
from pathjax.inverse.problem import Problem
from pathjax.inverse.products import Products
from pathjax.inverse.uncertainty import MAX_RELATIVE_ERROR
from pathjax.system import memory
from pathjax.system.interrupts import Interrupts

# The samples of the last level are divided by these at each level.
LEVELS = 16, 4, 1
# Least samples of the products of J, which have at most those of the image. Noise of J adds false information to
# J' W J, as if texels that share a pixel were known apart: it may be this part of the pixels' information.
PRODUCT_SPP, PRETENDED = 8, 0.1
MAX_STEPS, MAX_ITERATIONS, TOLERANCE = 4, 30, 0.03
# A level ends when the squared misfit is below this part of the variance of noise.
SETTLED = 1.0
# Residuals show the target's noise where the parameters leave at least this part of the pixels unexplained; elsewhere
# the noise is taken to be no less than that of the image.
LEAST_LEFT = 0.1
# A step is taken back if the misfit has grown by this many standard errors; and the least damping from then on.
GROWN, DAMPING = 4, 0.1
# More steps are taken, with new weights, if the noise turns out to differ from what was assumed by this factor.
OTHER_NOISE = 1.5
# Tolerated correlation of neighbouring residuals: the prior of texels shows in many pixels, faintly.
MOST_AGREEMENT = 0.05
# Draws of the posterior. Variances of texels are averaged over windows of this width, those of other parameters not.
TEXEL_DRAWS, OTHER_DRAWS, WINDOW = 4, 16, 5
# Renders that give the variance of a pixel; widths in pixels to smooth it, and to average its surroundings; and floors,
# as parts of that average and of the mean over all pixels.
BATCHES, SMOOTHED, FLOOR, LEAST = 4, (0.8, 2.0), 0.1, 1e-3
# float64 arrays of the size of the parameters that a fit holds at once.
ARRAYS = 24


class Search:
    """The state of a fit: its values, and what the last renders showed."""

    # Half of all information comes from the most informative pixels. Pixels are left out that have less than this part
    # of what the least informative of these has.
    least_told = 0.02

    def __init__(
        self, problem: Problem, spp: int, seed: int, prior: Prior, tell: Callable | None, interrupts: Interrupts
    ):
        count = len(problem.start)
        memory.check(8 * ARRAYS * count, f"fits of {count} numbers", "fit a smaller texture, or fewer at once")
        self.problem, self.vector, self.prior = problem, problem.vector, prior
        self.products, self.random = Products(problem, seed), np.random.default_rng(seed)
        self.values = problem.start.astype(float)
        self.low, self.high = self.vector.bounds.T
        self.spp = 2 * spp
        self.target_part: float | None = None  # variance of the target over that of one sample; None: unknown
        self.standard_errors = np.full(len(self.values), np.nan)
        self.halves: weights.Halves = []  # of all pixels, from the last survey
        self.noise: weights.Noise | None = None
        self.accepted: tuple[np.ndarray, np.ndarray] | None = None  # values, (N, 3) squared misfits
        self.damping = 0.0
        self.sharp = PRODUCT_SPP  # samples that J needs, as far as known
        self.history: list[dict] = []
        self.tell, self.interrupts, self.started = tell, interrupts, time.perf_counter()

    def run(self) -> tuple[bool, str]:
        """Find values and standard errors; return whether the fit converged, and a message."""
        self.survey()
        for part in LEVELS:
            if part == LEVELS[-1]:
                self.survey()
            self.descend(whole(self.spp / part), part == LEVELS[-1])
        supposed, found = 2 * self.render_part, self.check()
        if not 1 / OTHER_NOISE < found / supposed < OTHER_NOISE:
            self.descend(whole(self.spp), True)
            supposed, found = self.render_part + self.target_part, self.check()
        self.find_errors(np.sqrt(found / supposed))
        self.survey()
        return self.verdict()

    def descend(self, samples: int, last: bool) -> None:
        """Take steps with this many samples per pixel, until the misfit is no more than noise."""
        for _ in range(MAX_STEPS):
            excess = self.look(samples)
            self.step()
            self.record(samples)
            self.deviation = self.draw()
            self.told = self.determined()
            self.prior.estimate(self.values, self.deviation, self.told, self.determined_waves())
            if excess < SETTLED and (not last or self.renders > 1):
                break

    def check(self) -> float:
        """Check the result of the last step; return the variance of target and image over that of one sample."""
        equations = self.weights, self.render_part
        self.excess = self.look(whole(self.spp))
        self.weights, self.render_part = equations
        # The expectation of `told`, summed, is the number of parameters that the pixels determine: so many pixel values
        # are fitted with their noise, and the others miss the noise of the target.
        used = ((self.weights > 0) * self.trust).sum()
        left = used - self.told.sum()
        # Where the parameters explain nearly all pixels, little is left that shows the target's noise alone, and with
        # noise of J more parameters may be counted than there are pixels.
        least = 0.0 if left > LEAST_LEFT * used else self.render_part
        self.target_part = float(np.clip(self.missed / max(left, LEAST_LEFT * used), least, 1))
        return self.render_part + self.target_part

    # ---- pixels -----------------------------------------------------------------------------------------------------

    def survey(self) -> None:
        """Render all pixels with few samples for their noise and misfit; keep those that depend on the parameters."""
        problem, products = self.problem, self.products
        products.keep([np.ones(t.image.shape[:2], bool) for t in problem.targets])
        self.accepted = None  # its misfits are those of the pixels kept before
        self.trust = np.ones((products.count, 1))  # part of each pixel's information that is not noise of J
        self.renders, self.each, self.variances = 0, 0, [np.zeros(t.image.shape) for t in problem.targets]
        self.target = products.kept([t.image for t in problem.targets])
        spread = [products.spread(half) for half in self.render(2 * weights.NOISE_SPP)]
        self.halves = list(zip(*spread, strict=True))
        self.noise = weights.noise(self.halves, problem, self.spp)
        sure = weights.surely_unclipped(self.halves, problem, self.noise)
        usable = [t.usable & unclipped for t, unclipped in zip(problem.targets, sure, strict=True)]
        slope = products.spread(products.push(self.values, self.prior.scale, PRODUCT_SPP, products.next_draw()))
        told = [(u * s**2 / v).sum(-1) for s, u, v in zip(slope, usable, self.variance(), strict=True)]
        most = np.sort(np.concatenate([each.ravel() for each in told]))[::-1]
        if not most[0] > 0:
            raise InputError("no pixel of the target that may be used depends on what is to be fitted")
        least = self.least_told * most[np.searchsorted(np.cumsum(most), most.sum() / 2)]
        self.usable = usable
        products.keep([each > least for each in told])
        self.target = products.kept([t.image for t in problem.targets])
        self.trust = np.ones((products.count, 1))

    def render(self, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, 3) of two independent renders with half the samples each; update the variances."""
        products, each = self.products, samples // BATCHES
        batches = [products.images(self.values, each, products.next_draw()) for _ in range(BATCHES)]
        variance = np.var(batches, axis=0, ddof=1)
        if self.renders:
            # The variance of a mean may fall faster than as 1 / samples.
            ratio = float(np.mean(variance / products.kept(self.variance())))
            self.render_part = max(ratio, 1 / samples**2) / BATCHES
        if each > self.each:  # fewer samples are spread less evenly and may have other noise per sample
            self.each, self.renders, self.variances = each, 0, [np.zeros_like(v) for v in self.variances]
        spread = products.spread(variance * each)
        self.variances = [known + more for known, more in zip(self.variances, spread, strict=True)]
        self.renders += 1
        a, b = (np.mean(half, 0) - self.target for half in (batches[: BATCHES // 2], batches[BATCHES // 2 :]))
        return a, b

    def variance(self) -> list[np.ndarray]:
        """Return the variance (H, W, 3) of one sample, for each view."""
        found = []
        for total, mask in zip(self.variances, self.products.masks, strict=True):
            smooth, around = (ndimage.gaussian_filter(total / self.renders, (s, s, 0), truncate=2) for s in SMOOTHED)
            found.append(smooth + FLOOR * around + LEAST * smooth[mask].mean(0) + self.problem.rounding**2)
        return found

    def look(self, samples: int) -> float:
        """Render the kept pixels at the values; return their squared misfit over the variance of noise.

        If the misfit has grown, the last step is taken back, and the next ones are damped (Levenberg).
        """
        problem, products = self.problem, self.products
        # The noise is that of earlier renders, so that pixels do not weigh less for being bright by chance.
        variance = products.kept(self.variance())
        rounding = products.kept([np.broadcast_to(t.step, t.image.shape) for t in problem.targets]) ** 2 / 12
        usable = products.kept(self.usable)
        a, b = self.render(samples)
        self.samples = samples
        target_part = self.render_part if self.target_part is None else self.target_part
        self.weights = usable / (variance * (self.render_part + target_part) + rounding)
        # Both in the same units: more samples may be spread more evenly, with other noise per sample.
        pairs = a * b, self.accepted[1] if self.accepted else a * b
        here, before = ((usable * self.trust * missed / variance).sum(-1) for missed in pairs)
        error = np.sqrt((here.var() + before.var()) / len(here))
        if here.mean() - before.mean() > GROWN * error:
            self.values, self.damping = self.accepted[0], max(10 * self.damping, DAMPING)
            a, b = self.render(samples)
        else:
            self.accepted, self.damping = (self.values, a * b), self.damping / 10
        self.residual = (a + b) / 2
        self.missed = float((usable * self.trust * a * b / variance).sum())
        self.loss = float((self.weights * self.trust * a * b).sum() / 2)
        return 2 * self.loss / max((usable * self.trust).sum(), 1)

    def determined(self) -> np.ndarray:
        """Return how much of each parameter the pixels determine (n,), noisy; find the samples that J needs."""
        products, spp, v = self.products, self.product_spp, self.deviation
        other = products.next_draw()
        a, b = products.push(self.values, v, spp, products.next_draw()), products.push(self.values, v, spp, other)
        self.response = products.pull(self.values, self.weights * a, spp, other)
        told = v * self.response
        pretended = (self.weights * (a - b) ** 2).sum() / 2
        self.sharp = int(np.ceil(spp * pretended / max(PRETENDED * told.sum(), 1)))
        return told

    def determined_waves(self) -> dict[str, np.ndarray]:
        """Return per texture (h, w) how much of each cosine wave the pixels determine, channels summed; noisy."""
        one, other = self.prior.waves_of(self.deviation), self.prior.waves_of(self.response)
        return {name: (amplitudes * other[name]).sum(-1) for name, amplitudes in one.items()}

    # ---- parameters -------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Take a Gauss-Newton step from the values, with the results of `look`."""
        products, prior, values, w = self.products, self.prior, self.values, self.weights
        draw, n = products.next_draw(), len(values)
        spp = self.product_spp = max(min(self.sharp, self.samples), PRODUCT_SPP)
        self.pull = lambda adjoint: products.pull(values, adjoint, spp, draw)
        self.push = lambda change: products.push(values, change, spp, draw)
        gradient = self.pull(w * self.residual) + prior.gradient(values)
        free = self.inside(gradient)
        # J >= 0 for parameters that multiply light, so row sums of J' W J bound its diagonal.
        self.rows = np.abs(self.pull(w * self.push(np.ones(n))))
        self.diagonal = self.rows + prior.diagonal()
        self.free = free

        def times(x):
            x = np.where(free, x, 0)
            return np.where(free, self.pull(w * self.push(x)) + prior.times(x), 0)

        self.times = times
        self.values = np.clip(values + self.solve(-gradient, self.damping * self.diagonal), self.low, self.high)

    def inside(self, gradient: np.ndarray) -> np.ndarray:
        """Return (n,) bool: False for values at a bound that a step would push beyond it; they stay there."""
        return ~((self.values <= self.low) & (gradient > 0) | (self.values >= self.high) & (gradient < 0))

    def solve(self, right: np.ndarray, damping: np.ndarray | float = 0.0) -> np.ndarray:
        """Solve the equations of the last step; 0 where values stay at a bound."""
        shape = (len(right), len(right))
        matrix = LinearOperator(shape, lambda x: self.times(x) + damping * x, dtype=float)
        preconditioner = LinearOperator(shape, lambda x: x / (self.diagonal + damping), dtype=float)
        how = dict(rtol=TOLERANCE, maxiter=MAX_ITERATIONS, M=preconditioner, callback=self.listen)
        return cg(matrix, np.where(self.free, right, 0), **how)[0]

    def draw(self, larger: float = 1.0) -> np.ndarray:
        """Draw a deviation (n,) from the values from the posterior.

        larger: noise of pixels over that in their weights.
        """
        noise = larger * self.random.normal(size=self.weights.shape)
        return self.solve(self.pull(np.sqrt(self.weights) * noise) + self.prior.draw(self.random))

    def find_errors(self, larger: float) -> None:
        """Set the standard errors; inf for parameters that the pixels, without the prior, do not determine.

        larger: noise of pixels over that in their weights, in which the target may count as just as noisy as the image.
        """
        grids = all(is_grid(p) for _, p in self.vector.parameters)
        count = TEXEL_DRAWS if grids else OTHER_DRAWS
        draws = [self.draw(larger) for _ in range(count)]
        known = [self.known() for _ in range(count)]
        # The diagonal gives how variances differ from texel to texel, and the draws how much larger they are.
        ratio = self.local_mean(np.mean(np.square(draws), 0) * self.diagonal)
        found = np.sqrt(ratio / self.diagonal)
        rows = np.where(self.rows > 0, self.rows, 1)
        known = self.local_mean(np.mean(known, 0) / rows) * self.rows
        unseen = known * (MAX_RELATIVE_ERROR * self.prior.scale) ** 2 < 1
        self.standard_errors = np.where(unseen, np.inf, found)

    def known(self) -> np.ndarray:
        """Estimate the diagonal (n,) of J' W J without bias, from two independent J, whose noise adds nothing."""
        products = self.products
        noisy = np.sqrt(self.weights) * self.random.normal(size=self.weights.shape)
        a, b = (products.pull(self.values, noisy, self.product_spp, products.next_draw()) for _ in range(2))
        return a * b

    def local_mean(self, x: np.ndarray) -> np.ndarray:
        """Return means (n,) over windows of texels; other parameters unchanged."""
        parts = self.vector.unpack(x)
        for name, p in self.vector.parameters:
            if is_grid(p):
                size = (WINDOW, WINDOW) + (1,) * (len(p.shape) - 2)
                parts[name] = ndimage.uniform_filter(parts[name], size)
        return self.vector.pack(parts)

    # ---- the end ----------------------------------------------------------------------------------------------------

    def verdict(self) -> tuple[bool, str]:
        self.noise = weights.noise(self.halves, self.problem, weights.NOISE_SPP)
        agreement, structured = weights.structure(self.halves, self.problem, self.noise, self.usable)
        if structured and agreement > MOST_AGREEMENT:
            return False, (
                f"the residuals have structure: neighbouring pixels are correlated by {agreement:.0%}. The scene "
                "cannot look like the target, or what is supposed of texels is too strong; look at the residuals"
            )
        if self.excess > SETTLED:
            return (
                False,
                f"the image still misses the target by more than its noise after {MAX_STEPS} steps; try more spp",
            )
        message = "converged: what the image misses is noise"
        unseen = int(np.isinf(self.standard_errors).sum())
        if unseen:
            message += (
                f"; of {unseen} of {len(self.values)} numbers the pixels tell nothing: they are what was supposed"
            )
        return True, message

    def record(self, samples: int) -> None:
        self.listen()
        values = {name: float(np.mean(value)) for name, value in self.vector.unpack(self.values).items()}
        seconds = time.perf_counter() - self.started
        entry = {"stage": "descend", "spp": samples, "values": values, "loss": self.loss, "seconds": seconds}
        self.history.append(entry)
        if self.tell:
            self.tell(entry)

    def listen(self, _=None) -> None:
        distributed.heard(self.interrupts)  # its exception may have been lost during garbage collection


def whole(samples: float) -> int:
    """Round a number of samples down to a multiple of BATCHES, but not to 0."""
    return max(int(samples) // BATCHES, 1) * BATCHES
