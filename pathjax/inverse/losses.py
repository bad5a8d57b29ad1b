"""Losses of the first stages of a fit: pure functions of the parameters, given views with their targets.

Pixels of all views are concatenated, (N, 3), in the order of the groups of `problem.Problem`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pathjax.inverse.normal import sums
from pathjax.rendering.render import render


def residuals(x, arguments, vector):
    """Return n + 1 residuals that are enough for a solver, and half their sum of squares; x: unbounded vector (n,).

    They replace the weighted residuals r of all views. With J = Q R and the rest e = r - Q Q' r, which no x changes to
    first order, Q' r and |e| have the same sum of squares and gradient as r, and R' R = J' J. All follow from the
    normal equations of one render, so that neither J nor Q is made.
    """
    groups, weights, spp, seed, draw = arguments

    def reduced(x):
        values, slopes = jax.jvp(vector.bounded, (x,), (jnp.ones_like(x),))
        normal = sums(groups, values, slopes, weights, spp, seed, draw, vector=vector, halves=1)
        # The root of the matrix, in units in which its diagonal is 1, so that float32 resolves all components alike.
        diagonal = jnp.diagonal(normal.matrix)
        unit = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
        square, vectors = jnp.linalg.eigh(normal.matrix / jnp.outer(unit, unit))
        known = square > len(x) * jnp.finfo(x.dtype).eps
        root = jnp.sqrt(jnp.where(known, square, 1))
        r = jnp.where(known, vectors.T @ (normal.gradient / unit) / root, 0)
        R = jnp.where(known, root, 0)[:, None] * vectors.T * unit
        rest = jnp.sqrt(jnp.maximum(2 * normal.loss - r @ r, 0))
        return jnp.append(r, rest), jnp.append(R, jnp.zeros_like(x)[None], axis=0)

    @jax.custom_jvp
    def of(x):
        return reduced(x)[0]

    @of.defjvp
    def _(primals, tangents):
        r, R = reduced(*primals)
        return r, R @ tangents[0]

    r = of(x)
    return r, r @ r / 2


def loss(x, arguments, vector):
    """Return half the sum of squares, twice: as the value to minimise, and as the one to report."""
    _, half_squares = residuals(x, arguments, vector)
    return half_squares, half_squares


def misfits(candidates, arguments, vector):
    """Return weighted sums of squared residuals (K,) for candidate values (K, n)."""
    groups, weights, spp, seed, draw = arguments

    def misfit(values):
        by_name, parts = vector.unpack(values), []
        for views in groups:

            def image(scene, seed, views=views):
                return render(views.with_values(scene, by_name), spp, seed) * views.exposure

            images = views.map(image, views.seeds(seed, draw, 0))
            parts.append((images - views.targets).reshape(-1, 3))
        return jnp.sum(weights * jnp.concatenate(parts) ** 2)

    return jax.vmap(misfit)(candidates)
