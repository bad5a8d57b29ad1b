"""What a fit evaluates: pure functions of the parameters, given views with their targets."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pathjax.derivatives.gradient import jacobian
from pathjax.inverse.uncertainty import Evidence
from pathjax.rendering.render import render


def residuals(x, arguments, coordinates):
    """Weighted residuals of all views, and half their sum of squares; x: unbounded coordinates (n,)."""
    groups, weights, spp, seed, draw = arguments
    values = coordinates.unpack(coordinates.bounded(x))
    parts = []
    for views, weight in zip(groups, weights, strict=True):
        images = views.map(partial(_image, views=views, values=values, spp=spp), views.seeds(seed, draw, 0))
        parts.append(((images - views.targets) * jnp.sqrt(weight)).ravel())
    r = jnp.concatenate(parts)
    return r, jnp.sum(r * r) / 2


def loss(x, arguments, coordinates):
    """The latter, twice: what a minimiser minimises, and what it tells."""
    _, half_squares = residuals(x, arguments, coordinates)
    return half_squares, half_squares


def score(z, arguments, coordinates):
    """Root function, and the evidence that it comes from; z: steps from `base` in units of `scale`."""
    base, scale, projector, groups, weights, spp, seed, draw = arguments
    rest = jnp.eye(len(scale), dtype=scale.dtype) - projector

    def evaluate(z):
        evidence = _evidence(base + scale * z, groups, spp, seed, draw, coordinates)
        flat = jnp.concatenate([weight.reshape(-1, 3) for weight in weights])
        scaled = evidence._replace(jacobians=evidence.jacobians * scale)
        g = jnp.sum(scaled.scores(flat), 0)
        matrix = projector @ scaled.matrix(flat) @ projector
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


def _evidence(v, groups, spp, seed, draw, coordinates) -> Evidence:
    """Two independent renders of all views, and their Jacobians; v: values (n,)."""
    values = coordinates.unpack(v)
    parts = []
    for views in groups:

        def image_and_columns(scene, seed, views=views):
            image, J = jacobian(views.with_values(scene, values), views.names, spp, seed)
            return image * views.exposure, coordinates.columns(J, image.shape) * views.exposure

        seeds = jnp.stack([views.seeds(seed, draw, half) for half in (0, 1)])
        images, columns = jax.vmap(partial(views.map, image_and_columns))(seeds)
        parts.append(((images - views.targets).reshape(2, -1, 3), columns.reshape(2, -1, *columns.shape[-2:])))
    residuals, jacobians = (jnp.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    return Evidence(residuals, jacobians)


def misfits(candidates, arguments, coordinates):
    """(K,) of candidate values (K, n)."""
    groups, weights, spp, seed, draw = arguments

    def misfit(v):
        values = coordinates.unpack(v)
        total = 0.0
        for views, weight in zip(groups, weights, strict=True):
            images = views.map(partial(_image, views=views, values=values, spp=spp), views.seeds(seed, draw, 0))
            total = total + jnp.sum(weight * (images - views.targets) ** 2)
        return total

    return jax.vmap(misfit)(candidates)


def _image(scene, seed, views, values, spp):
    return render(views.with_values(scene, values), spp, seed) * views.exposure
