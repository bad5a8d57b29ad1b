"""Fits of some thousand texels: Gauss-Newton with the matrix itself, solved exactly, which gives exact errors.

Light keeps its channel, so Q colours have one system of equations for each channel. Q scalars, such as roughnesses,
have one system from all channels. A system is

    (J' W J + P) step = J' W (target - image) + P (mean - values),        errors C (J' W V W J + P) C

with C = (J' W J + P)^-1 and V the variance of the residuals. J is the mean of two independent renders, and half their
difference, D, shows how noisy it is. That noise adds D' W D to J' W J, as if pixels determined texels that they do not.
To first order C is then too small by C D' W D C, so J gets enough samples to make this a small part of C. Against what
remains, a pixel weighs less the noisier its row of J is, and the missing variance is added to the errors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from pathjax import distributed
from pathjax.derivatives.jacobian import has_rows
from pathjax.inverse.many import BATCHES, PRETENDED, PRODUCT_SPP, Search, whole
from pathjax.inverse.prior import waves_of
from pathjax.inverse.problem import Problem
from pathjax.inverse.uncertainty import MAX_RELATIVE_ERROR

# Most colours, or scalars: a matrix is then 8 MB, and solved within a second. And most products of two entries of a
# pixel's row: summing them takes some seconds.
MOST_COLUMNS, MOST_PRODUCTS = 1024, 1 << 34
# Samples of each of the two J: at most this many times those of the image. Where errors need more samples than a first
# try had, they are raised at most this often.
MOST_SAMPLES, RAISED = 4, 2
# Random signs per pixel that estimate the information falsely added by noise of J; and the part of the determined
# texels for which that need not be small.
SIGNS, LEFT_OUT = 16, 0.05
# The result of the last step is checked with the samples divided by this.
CHECK_PART = 4
# Most rounds, each a solution of the equations, to find the values that a step leaves at a bound; about 50 are usual.
ROUNDS = 500


def is_dense(problem: Problem) -> bool:
    """Return whether the fitted parameters are all colours, or all scalars, and few enough for `Dense`."""
    pixels, systems = sum(target.image.size // 3 for target in problem.targets), problem.vector.systems
    columns = problem.vector.count // max(systems, 1)
    if not systems or columns > MOST_COLUMNS or pixels * columns**2 > MOST_PRODUCTS:
        return False
    return all(has_rows(views.scene, list(views.wanted.values())) for views in problem.groups)


def least_within(
    A: np.ndarray, gradient: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise a quadratic within bounds; return the minimum and which values are free, at no bound: (n,), (n,) bool.

    By an active set (Nocedal and Wright 2006, Numerical Optimization, 16.5). Values at a bound are held there. The
    others move to the minimum, or towards it as far as the bounds allow, and those that meet a bound are held. When
    none does, held values that the quadratic draws inwards are released. The quadratic decreases in each round:
    pivoting without that guarantee cycles where values are strongly correlated.

    Args:
        A: (n, n) symmetric, positive definite.
        gradient: (n,) at x.
        x: (n,) start, within the bounds.
    """
    start, slope = x, gradient
    held = (x <= low) & (slope > 0) | (x >= high) & (slope < 0)

    def change(to):
        step = to - start
        return step @ (gradient + A @ step / 2)

    for _ in range(ROUNDS):
        free = np.flatnonzero(~held)
        step = np.zeros(len(x))
        step[free] = -linalg.solve(A[np.ix_(free, free)], slope[free], assume_a="pos")
        bound = np.where(step < 0, low, high)
        beyond = (x + step < low) | (x + step > high)
        if beyond.any():
            part = np.where(beyond, (bound - x) / np.where(beyond, step, 1), np.inf)
            first = np.where(part <= part.min(), bound, np.clip(x + part.min() * step, low, high))
            # Clipping the whole step may be better, and holds more values at once.
            x = min(first, np.clip(x + step, low, high), key=change)
            held |= (x == bound) & (step != 0)
        else:
            x = x + step
        slope = gradient + A @ (x - start)
        if not beyond.any():
            wrong = held & np.where(x <= low, slope < 0, slope > 0)
            if not wrong.any():
                break
            held &= ~wrong
    return x, ~held


class Equations(NamedTuple):
    """The normal equations of S systems: one per channel for Q colours, or a single one for Q scalars."""

    matrix: np.ndarray  # (S, Q, Q) J' W J
    gradient: np.ndarray  # (Q, S) J' W (image - target)
    known: np.ndarray  # (Q, S) diagonal of J' V^-1 J, to which noise of J adds nothing
    pretended: np.ndarray  # (S, Q, K) random vectors whose outer products have the mean D' W D
    scatter: np.ndarray  # (S, Q, Q) J' W V W J, if requested


class Dense(Search):
    """A `Search` with so few parameters that it stores their matrix."""

    # All pixels are used: fewer would save little, and a single one may be all that determines a texel.
    least_told = 0.0

    def step(self) -> None:
        self.prior_matrix = self.prior.of_system()
        found = self.solved()
        gradient = found.gradient.ravel() + self.prior.gradient(self.values)
        damping = self.damping * np.einsum("sqq->qs", found.matrix).ravel()
        self.values = self.bounded(gradient, damping)

    def bounded(self, gradient: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """Return the minimum within the bounds of the quadratic with this gradient and the matrix of `times`.

        If a step were merely clipped, neighbours would still compensate for the part that was cut off.
        """
        values = self.by_system(self.values).copy()
        self.free = np.ones(values.shape, bool)
        by_value = map(self.by_system, (gradient, damping, self.low, self.high))
        for s, (g, d, low, high) in enumerate(zip(*(x.T for x in by_value), strict=True)):
            A = self.equations.matrix[s] + self.prior_matrix + np.diag(d)
            values[:, s], self.free[:, s] = least_within(A, g, values[:, s], low, high)
        return values.ravel()

    def by_system(self, x: np.ndarray) -> np.ndarray:
        """Return x (n,) as (Q, S)."""
        return x.reshape(-1, self.vector.systems)

    def solved(self, variance: np.ndarray | None = None) -> Equations:
        """Sum up and invert the equations; for errors (`variance` as for `sums`) with as many samples of J as needed.

        Steps take the number of samples that the equations before were found to need.
        """
        most = MOST_SAMPLES * self.samples
        for _ in range(1 if variance is None else 1 + RAISED):
            self.product_spp = min(max(self.sharp, PRODUCT_SPP), most)
            self.equations = found = self.sums(variance)
            self.inverse = np.stack([linalg.inv(m + self.prior_matrix) for m in found.matrix])
            self.pretended = ((self.inverse @ found.pretended) ** 2).mean(-1).T.ravel()  # (n,) missing variance
            variances = np.einsum("sqq->qs", self.inverse).ravel()
            known = variances < (MAX_RELATIVE_ERROR * self.prior.scale) ** 2
            part = (self.pretended / variances)[known if known.any() else ...]
            self.sharp = int(np.ceil(self.product_spp * np.quantile(part, 1 - LEFT_OUT) / PRETENDED))
            if self.sharp <= self.product_spp or self.product_spp == most:
                break
        return found

    def times(self, x: np.ndarray) -> np.ndarray:
        """Return the matrix of the last step's equations times x (n,)."""
        x = self.by_system(x)
        return (np.einsum("sqr,rs->qs", self.equations.matrix, x) + self.prior_matrix @ x).ravel()

    def sums(self, variance: np.ndarray | None = None) -> Equations:
        """Sum up the normal equations over the kept pixels; with `scatter` if the residuals' variance (N, 3) is given.

        Parts of the pixels are dealt to devices and to processes, and summed in their order.
        """
        products, systems = self.products, self.vector.systems
        draws, scatter = (products.next_draw(), products.next_draw()), variance is not None
        signs = self.random.choice([-0.5, 0.5], (3, products.count, SIGNS))
        square = systems, (count := len(self.values) // systems), count
        shapes = square, square[1::-1], square[1::-1], (systems, count, SIGNS), (systems * scatter, count, count)
        found = Equations(*map(np.zeros, shapes))
        ends = np.cumsum([x.size for x in found])

        def of_part(part) -> np.ndarray:
            """Return the equations of some pixels, and their trust, as words of float64, which JAX would round."""
            a, b = part.rows()
            J = (a + b) / 2
            whole = (J * J).sum((0, 2))
            trust = np.clip((a * b).sum((0, 2)) / np.where(whole > 0, whole, 1), 0, 1) ** 2
            mine, trusts = Equations(*map(np.zeros, shapes)), np.zeros(products.most_rows)
            trusts[: len(trust)] = trust

            def rows(x):
                """Assign rows to systems: (3, n, ...) -> (S, 3/S n, ...)."""
                return x.reshape(systems, -1, *x.shape[2:])

            w = self.weights[part.places].T
            w, trusted, residual = map(rows, (w, trust * w, self.residual[part.places].T))
            a, b, J, mine_signs = map(rows, (a, b, J, signs[:, part.places]))
            for s in range(systems):
                here = trusted[s, :, None] * J[s]
                mine.matrix[s] = here.T @ J[s]
                mine.gradient[:, s] = here.T @ residual[s]
                mine.known[:, s] = w[s] @ (a[s] * b[s])
                mine.pretended[s] = (a[s] - b[s]).T @ (np.sqrt(trusted[s, :, None]) * mine_signs[s])
                if scatter:
                    mine.scatter[s] = here.T @ (rows(variance[part.places].T)[s, :, None] * here)
            return np.concatenate([x.ravel() for x in (*mine, trusts)]).view(np.uint32)

        parts = products.rows(self.values, self.product_spp, draws)
        for part, words in distributed.dealt(of_part, parts, lambda: self.interrupts.heard):
            if words is None:
                raise KeyboardInterrupt
            *sums, trusts = np.split(words.view(np.float64), ends)
            for total, mine in zip(found, sums, strict=True):
                total += mine.reshape(total.shape)
            self.trust[part.places] = trusts[: len(part.places), None]
        return found

    def solve(self, right: np.ndarray, damping: np.ndarray | float = 0.0) -> np.ndarray:
        """Solve the equations of the last step; 0 where values stay at a bound."""
        right, free = self.by_system(right), self.by_system(self.free)
        more = self.by_system(np.broadcast_to(damping, len(self.values)))
        solution = np.zeros_like(right)
        for s, matrix in enumerate(self.equations.matrix):
            here = np.flatnonzero(free[:, s])
            A = (matrix + self.prior_matrix + np.diag(more[:, s]))[np.ix_(here, here)]
            solution[here, s] = linalg.solve(A, right[here, s], assume_a="pos")
        return solution.ravel()

    def determined(self) -> np.ndarray:
        return np.einsum("sqr,srq->qs", self.inverse, self.equations.matrix).ravel()

    def determined_waves(self) -> dict[str, np.ndarray]:
        places, found = self.vector.unpack(np.arange(len(self.values))), {}
        known, systems = self.inverse @ self.equations.matrix, self.vector.systems
        for name in self.prior.waves:
            h, w, _ = self.prior.shapes[name]
            here = places[name].ravel()[::systems] // systems
            mine = known[:, here][:, :, here].reshape(systems, h, w, h, w)
            found[name] = np.einsum("shwhw->hw", waves_of(waves_of(mine, (1, 2)), (3, 4)))
        return found

    def draw(self) -> np.ndarray:
        e = self.by_system(self.random.normal(size=len(self.values)))
        score = [linalg.cholesky(m + self.prior_matrix).T @ e[:, s] for s, m in enumerate(self.equations.matrix)]
        return self.solve(np.stack(score, -1).ravel())

    def check(self) -> float:
        """Check the result of the last step; return the variance of target and image over that of one sample."""
        equations = self.weights, self.render_part, self.samples, self.variances, self.renders
        self.excess = self.look(whole(self.spp / CHECK_PART))
        # Fewer samples are spread less evenly and have other noise per sample, so that of the earlier renders is kept.
        self.weights, self.render_part, self.samples, self.variances, self.renders = equations
        # Values were fitted to the noise of target and image, as many as the pixels determine: with H the hat matrix,
        # residuals are (1 - H) times the noise of the target, and H times that of the image before the step.
        used = (self.weights > 0) * self.trust
        count, told, image = used.sum(), self.told.sum(), 1 / (BATCHES * self.each)
        single = self.products.kept([variance / self.renders for variance in self.variances])
        share = float((used * single / self.products.kept(self.variance())).sum() / max(count, 1))
        missed = self.missed / share if share > 0 else 0.0
        target = float(np.clip((missed - image * told) / max(count - told, 1), 0, 1))
        self.target_part = share * target
        # The variance (N, 3) of each pixel's residual, from this pixel alone: noisy, but not biased.
        steps = self.products.kept([np.broadcast_to(t.step, t.image.shape) for t in self.problem.targets])
        self.missing = single * (image + target) + steps**2 / 12 + self.problem.rounding**2
        return self.render_part + self.target_part

    def find_errors(self, larger: float) -> None:
        """Set the standard errors, from the variance of each pixel's own residual, which includes `larger`."""
        found, C = self.solved(self.missing), self.inverse
        variances = (C @ (found.scatter + self.prior_matrix) * C).sum(-1).T.ravel() + self.pretended
        most = (MAX_RELATIVE_ERROR * self.prior.scale) ** 2
        unseen = (found.known.ravel() * most < 1) | (variances > most)
        self.standard_errors = np.where(unseen, np.inf, np.sqrt(variances))
