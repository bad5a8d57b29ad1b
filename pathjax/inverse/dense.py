"""Fits of some thousand texels: Gauss-Newton with the matrix itself, solved exactly, which states exact errors.

Light keeps its channel, so each channel has equations of its own, in Q colours:

    (J' W J + P) step = J' W (target - image) + P (mean - values),        errors C (J' W V W J + P) C

with C = (J' W J + P)^-1 and V the variance of what pixels miss. J is the mean of two independent renders, whose
difference tells how much of a pixel's row is noise. That noise adds to J' W J what no pixel knows, as if texels were
known that are not; so a pixel weighs as much less as its row is less than sure, and V is what it was.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from pathjax import distributed
from pathjax.derivatives.jacobian import has_rows
from pathjax.inverse.many import Search
from pathjax.inverse.problem import Problem
from pathjax.inverse.uncertainty import MAX_RELATIVE_ERROR

# Up to so many numbers: a matrix of each channel is then 8 MB, and solved within a second. And up to so many products
# of two entries of a pixel's row: to sum them up takes some seconds.
MOST_NUMBERS, MOST_PRODUCTS = 3072, 1 << 34


def is_dense(problem: Problem) -> bool:
    """Whether the fit is of colours alone, few enough for `Dense`."""
    count, pixels = problem.vector.count, sum(target.image.size // 3 for target in problem.targets)
    if count > MOST_NUMBERS or pixels * (count // 3) ** 2 > MOST_PRODUCTS:
        return False
    return all(has_rows(views.scene, views.wanted.values()) for views in problem.groups)


class Equations(NamedTuple):
    """The normal equations of each channel, for Q colours."""

    matrix: np.ndarray  # (3, Q, Q) J' W J
    gradient: np.ndarray  # (Q, 3) J' W (image - target)
    known: np.ndarray  # (Q, 3) diagonal of J' V^-1 J, to which noise of J adds nothing
    scatter: np.ndarray  # (3, Q, Q) J' W V W J, if asked for


class Dense(Search):
    """`Search`, of few enough numbers that their matrix is kept."""

    # All pixels count: few would save little, and one may be the only one that knows of a texel.
    least_told = 0.0

    def step(self) -> None:
        self.equations = found = self.sums()
        self.prior_matrix = self.prior.of_channel()
        gradient = found.gradient.ravel() + self.prior.gradient(self.values)
        self.free = self.inside(gradient)
        damping = self.damping * np.einsum("cqq->qc", found.matrix).ravel()
        self.values = np.clip(self.values + self.solve(-gradient, damping), self.low, self.high)

    def sums(self, scatter: bool = False) -> Equations:
        """Sum up the normal equations over the kept pixels, with as many samples of J as the image had.

        Parts of the pixels are dealt to devices, and to processes, and added up in their order.
        """
        products, count = self.products, len(self.values) // 3
        samples, draws = max(self.samples // 2, 1), (products.next_draw(), products.next_draw())
        shapes = (3, count, count), (count, 3), (count, 3), (3 * scatter, count, count)
        found = Equations(*map(np.zeros, shapes))
        ends = np.cumsum([x.size for x in found])

        def of_part(part) -> np.ndarray:
            """Equations of a part of the pixels, and their trust, as words of float64, which JAX would round."""
            a, b = part.rows()
            J, w = (a + b) / 2, self.weights[part.places]
            whole = (J * J).sum((0, 2))
            trust = np.clip((a * b).sum((0, 2)) / np.where(whole > 0, whole, 1), 0, 1)[:, None] ** 2
            mine, trusts = Equations(*map(np.zeros, shapes)), np.zeros(products.most_rows)
            trusts[: len(trust)] = trust[:, 0]
            for c in range(3):
                here, of_channel = (trust * w)[:, c, None] * J[c], w[:, c]
                mine.matrix[c] = here.T @ J[c]
                mine.gradient[:, c] = here.T @ self.residual[part.places, c]
                mine.known[:, c] = of_channel @ (a[c] * b[c])
                if scatter:
                    mine.scatter[c] = here.T @ (trust * J[c])
            return np.concatenate([x.ravel() for x in (*mine, trusts)]).view(np.uint32)

        parts = products.rows(self.values, samples, draws)
        for part, words in distributed.dealt(of_part, parts, lambda: self.interrupts.heard):
            if words is None:
                raise KeyboardInterrupt
            *sums, trusts = np.split(words.view(np.float64), ends)
            for total, mine in zip(found, sums, strict=True):
                total += mine.reshape(total.shape)
            self.trust[part.places] = trusts[: len(part.places), None]
        return found

    def solve(self, right: np.ndarray, damping: np.ndarray | float = 0.0) -> np.ndarray:
        """What solves the equations of the last step; 0 where values stay at a bound."""
        right, free = right.reshape(-1, 3), self.free.reshape(-1, 3)
        more = np.broadcast_to(damping, len(self.values)).reshape(-1, 3)
        solution = np.zeros_like(right)
        for c, matrix in enumerate(self.equations.matrix):
            here = np.flatnonzero(free[:, c])
            A = (matrix + self.prior_matrix + np.diag(more[:, c]))[np.ix_(here, here)]
            solution[here, c] = linalg.solve(A, right[here, c], assume_a="pos")
        return solution.ravel()

    def determined(self) -> np.ndarray:
        parts = [linalg.solve(m + self.prior_matrix, m, assume_a="pos") for m in self.equations.matrix]
        return np.stack([np.diag(part) for part in parts], -1).ravel()

    def draw(self) -> np.ndarray:
        e = self.random.normal(size=(len(self.values) // 3, 3))
        score = [linalg.cholesky(m + self.prior_matrix).T @ e[:, c] for c, m in enumerate(self.equations.matrix)]
        return self.solve(np.stack(score, -1).ravel())

    def find_errors(self, larger: float) -> None:
        equations, P = self.sums(scatter=True), self.prior_matrix
        variances = np.zeros_like(equations.known)
        for c, (matrix, scatter) in enumerate(zip(equations.matrix, equations.scatter, strict=True)):
            C = linalg.inv(matrix + P)
            variances[:, c] = ((C @ (larger**2 * scatter + P)) * C).sum(1)
        found, most = np.sqrt(variances).ravel(), MAX_RELATIVE_ERROR * self.prior.scale
        unseen = (equations.known.ravel() * most**2 < larger**2) | (found > most)
        self.standard_errors = np.where(unseen, np.inf, found)
