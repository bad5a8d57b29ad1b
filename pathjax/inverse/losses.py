"""What a fit evaluates: pure functions of the parameters, given views with their targets.

Values of all views stand one after another, (N, 3), in the order of the groups of `problem.Problem`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pathjax.derivatives.jacobian import jacobian
from pathjax.inverse.uncertainty import Evidence
from pathjax.rendering.render import render


def residuals(x, arguments, vector):
    """Weighted residuals of all views, and half their sum of squares; x: unbounded coordinates (n,)."""
    groups, weights, spp, seed, draw = arguments
    r = (_differences(vector.bounded(x), groups, spp, seed, draw, vector) * jnp.sqrt(weights)).ravel()
    return r, jnp.sum(r * r) / 2


def loss(x, arguments, vector):
    """Half the sum of squares, twice: what a minimiser minimises, and what it reports."""
    _, half_squares = residuals(x, arguments, vector)
    return half_squares, half_squares


def misfits(candidates, arguments, vector):
    """(K,) weighted sums of squares of candidate values (K, n)."""
    groups, weights, spp, seed, draw = arguments

    def misfit(values):
        return jnp.sum(weights * _differences(values, groups, spp, seed, draw, vector) ** 2)

    return jax.vmap(misfit)(candidates)


def score(z, arguments, vector):
    """Root function, and the evidence that it comes from; z: steps from `base` in units of `scale`."""
    base, scale, projector, groups, weights, spp, seed, draw = arguments
    rest = jnp.eye(len(scale), dtype=scale.dtype) - projector

    def evaluate(z):
        evidence = _evidence(base + scale * z, groups, spp, seed, draw, vector)
        scaled = evidence._replace(jacobians=evidence.jacobians * scale)
        g = jnp.sum(scaled.scores(weights), 0)
        matrix = projector @ scaled.matrix(weights) @ projector
        # What is not determined stays where it is, by rows of the same size as the others.
        size = jnp.maximum(jnp.max(jnp.abs(matrix)), jnp.finfo(z.dtype).tiny)
        return (projector @ g / size + rest @ z, evidence), matrix / size + rest

    @jax.custom_jvp
    def root(z):
        return evaluate(z)[0]

    @root.defjvp
    def root_jvp(primals, tangents):
        (g, evidence), matrix = evaluate(*primals)
        return (g, evidence), (matrix @ tangents[0], jax.tree.map(jnp.zeros_like, evidence))

    return root(z)


def _differences(values, groups, spp, seed, draw, vector):
    """(N, 3) image - target of one render of each view; values: (n,)."""
    by_name = vector.unpack(values)
    parts = []
    for views in groups:

        def image(scene, seed, views=views):
            return render(views.with_values(scene, by_name), spp, seed) * views.exposure

        images = views.map(image, views.seeds(seed, draw, 0))
        parts.append((images - views.targets).reshape(-1, 3))
    return jnp.concatenate(parts)


def _evidence(values, groups, spp, seed, draw, vector) -> Evidence:
    """Two independent renders of all views, and their Jacobians; values: (n,)."""
    by_name = vector.unpack(values)
    parts = []
    for views in groups:

        def image_and_columns(scene, seed, views=views):
            image, J = jacobian(views.with_values(scene, by_name), views.names, spp, seed)
            return image * views.exposure, vector.columns(J, image.shape) * views.exposure

        seeds = jnp.stack([views.seeds(seed, draw, half) for half in (0, 1)])
        images, columns = jax.vmap(partial(views.map, image_and_columns))(seeds)
        parts.append(((images - views.targets).reshape(2, -1, 3), columns.reshape(2, -1, *columns.shape[-2:])))
    residuals, jacobians = (jnp.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    return Evidence(residuals, jacobians)
