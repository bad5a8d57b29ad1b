"""Render the Neumann series L = Le + T Le + T^2 Le + ..., an image of each term from the same paths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Integer

from pathjax import emitters
from pathjax.compile import is_traced, on_all_devices, register_dataclass, standard_promotion
from pathjax.core.types import Number
from pathjax.derivatives import rules, tangents
from pathjax.errors import InputError
from pathjax.integrators import pixel, terms
from pathjax.integrators.options import DEFAULTS, Options
from pathjax.integrators.reconstruction import map_pixels
from pathjax.rendering import tail
from pathjax.rendering.progressive import error_estimate, replicates
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.scene import Scene
from pathjax.sensors import film

# Every term adds three scalars to the state of each lane.
MOST_TERMS = 64
# Samples of a replicate in one uncompensated sum: float32 keeps 5 digits even where all samples are equal.
_PORTION = 1 << 12
# Size of the `pilot`: enough terms that the last ones are spread evenly over the scene.
PILOT_TERMS, PILOT_PIXELS, PILOT_SPP = 12, 1 << 12, 64


@register_dataclass
@dataclass(frozen=True, eq=False)
class Bounces:
    """Terms of the series: `terms[k]` is T^k Le, the light reflected or refracted k times."""

    terms: jax.Array  # (depth, H, W, 3) linear RGB
    deviation: jax.Array  # (depth, H, W, 3) root of `variance`; float32 may not hold the variance itself
    samples: jax.Array  # (H, W) int32 samples per pixel, for the standard error
    correlation: jax.Array | np.ndarray  # (S, S) of a pixel's noise with that of those around it, `film.correlation`

    @property
    def variance(self) -> jax.Array:
        """(depth, H, W, 3) unbiased estimate of the variance of `terms`, 3 degrees of freedom; nan below 2 spp."""
        return self.deviation**2

    @property
    def standard_error(self) -> np.ndarray:
        """(depth, H, W, 3), pooled over 3 x 3 pixels as in `render_until`."""
        images, variances = np.asarray(self.terms), np.asarray(self.deviation, float) ** 2
        count = np.asarray(self.samples)
        return np.stack([error_estimate.standard_error(*term, count) for term in zip(images, variances, strict=True)])

    def tail(self) -> tail.Tail:
        """Estimate the light beyond these terms, in the mean over the finite pixels.

        Raises:
            InputError: fewer than 3 terms, or no finite pixel.
        """
        means, deviation = (np.asarray(x, float).reshape(len(x), -1, 3) for x in (self.terms, self.deviation))
        known = np.isfinite(means).all((0, 2))
        if not known.any():
            raise InputError("no pixel is finite, so nothing can be told of the light beyond these terms")
        error = np.sqrt(np.asarray(self.correlation).sum() * (deviation[:, known] ** 2).sum(1)) / known.sum()
        return tail.fit(means[:, known].mean(1), error)


@agreed_by_all
@standard_promotion
def render_bounces(
    scene: Scene,
    depth: int,
    spp: Number | Integer[Array | np.ndarray, "height width"] = 64,
    seed: Number = 0,
    strategy: str = "mis",
    *,
    errors: bool = True,
) -> Bounces:
    """Render an image of each of the first `depth` terms of L = Le + T Le + T^2 Le + ..., from the same paths.

    Their sum equals, up to rounding, the image of `render_until(scene, spp=spp, seed=seed)` with max_depth = depth: the
    mean of four replicates, whose spread gives the standard errors. With `errors=False` there is one sequence and no
    standard error, and the sum equals `render(scene, spp, seed)`. Either costs about as much as `render`. The scene's
    own max_depth is ignored.

    Pure. It may be called inside `jax.jit` and under `jax.vmap`, and `terms` may be differentiated in named
    reflectances, radiances and other colours, forwards or backwards. `deviation` and `variance` have no derivative.

    Args:
        depth: number of terms, 1 to 64; 1 is emission alone. Static.
        spp: samples per pixel; or `samples` of a `RenderResult`, whose image is then the sum.
        seed: as for `render`.
        strategy: as for `render`.
        errors: whether to estimate the variance.
    Raises:
        InputError: depth, spp or seed out of range, unknown strategy; differentiation in the IOR of glass or in
            anything other than named parameters.
    """
    _check_depth(depth)
    options = Options(strategy, shared=scene.film.shared)
    options.check_counts(spp, seed)
    options.check_strategy(scene)
    shape = film.image_shape(scene.film)
    if np.shape(spp) not in ((), shape):
        raise InputError(f"spp has the shape {np.shape(spp)}; it is one number, or one for each of the {shape} pixels")
    samples = jnp.broadcast_to(jnp.asarray(spp, jnp.int32), shape)
    return _bounces(scene, int(depth), film.pixels(scene.film), samples, seed, options, errors)


def pilot(scene: Scene) -> tail.Tail:
    """Return the Tail after 12 terms, from 64 samples of at most 4096 pixels, spread evenly over the image."""
    count = film.pixel_count(scene.film)
    pixels = np.unique(np.linspace(0, count - 1, min(PILOT_PIXELS, count)).astype(np.int32))
    samples = jnp.full((1, len(pixels)), PILOT_SPP, jnp.int32)
    return _bounces(scene, PILOT_TERMS, jnp.asarray(pixels), samples, 0, DEFAULTS, True).tail()


def _check_depth(depth) -> None:
    if isinstance(depth, bool) or not isinstance(depth, int | np.integer) or not 1 <= depth <= MOST_TERMS:
        raise InputError(
            f"depth = {depth!r}; it is the number of terms Le, T Le, T^2 Le, ..., an integer in [1, {MOST_TERMS}]: "
            "without a term there is no image, and 1 is emission alone"
        )


def _bounces(scene, depth, pixels, samples, seed, options, errors) -> Bounces:
    """Render the terms. samples: (H, W); pixels: as many, or all of a film that shares samples."""
    shares = _shares(samples) if errors else samples.reshape(1, -1)
    seeds = replicates.seeds(seed) if errors else jnp.asarray(seed, jnp.uint32)[None]
    most = None if is_traced(shares) else int(np.asarray(shares).max())
    estimator = _TermSums(depth, replace(options, by_vertex=True))
    scene = on_all_devices(replace(scene, max_depth=jnp.int32(depth)))
    if most is None or most <= _PORTION:
        sums = rules.estimate(estimator, scene, pixels, 0, shares, seeds)
    else:
        sums = 0
        for first in range(0, most, _PORTION):
            portion = jnp.clip(shares - first, 0, _PORTION)
            sums = sums + rules.estimate(estimator, scene, pixels, first, portion, seeds)
    own = scene.film if options.shared else film.with_own_samples(scene.film)
    return Bounces(*_moments(sums, shares, shape=samples.shape), samples, film.correlation(own))


@jax.jit
def _shares(samples):
    return replicates.shares(samples.ravel())


@partial(jax.jit, static_argnames="shape")
def _moments(sums, shares, *, shape):
    """Return means and deviations (depth, H, W, 3) of sums (R, N, depth, 3) over (R, N) samples.

    See `replicates.moments`.
    """
    sums, shares = list(sums), [x[:, None, None].astype(sums.dtype) for x in shares]  # a loop over lists vectorises
    count = jnp.maximum(sum(shares), 1)
    mean = sum(sums) / count
    apart = [lax.stop_gradient(x / jnp.maximum(n, 1) - mean) for x, n in zip(sums, shares, strict=True)]
    # Scaled, as in a norm: squares of radiances leave the range of float32.
    largest = reduce(jnp.maximum, map(jnp.abs, apart))
    scale = jnp.where(largest > 0, largest, 1)
    spread = sum(n * (x / scale) ** 2 for x, n in zip(apart, shares, strict=True)) / count
    freedom = sum(n > 0 for n in shares) - 1
    deviation = jnp.where(freedom > 0, scale * jnp.sqrt(spread / jnp.maximum(freedom, 1)), jnp.nan)
    depth = mean.shape[1]
    return tuple(jnp.moveaxis(x, 1, 0).reshape(depth, *shape, 3) for x in (mean, deviation))


@dataclass(frozen=True)
class _TermSums:
    """Estimator of the sums (R, N, depth, 3) of pixels (N,). spp: (R, N) per replicate, seeds: (R,)."""

    depth: int
    options: Options

    def value(self, scene, pixels, first_sample, spp, seeds):
        sums, _ = _kernel(scene, pixels, first_sample, spp, seeds, depth=self.depth, options=self.options)
        return sums

    def matrix_free(self, scene, wanted):
        return set()

    def jacobian(self, scene, wanted, *work):
        tangents.refuse_textures(wanted)
        for name, parameter in wanted.items():
            if parameter.moves_paths:
                raise InputError(
                    f"terms of the series are not differentiated in {name}: the IOR of glass moves paths, which takes "
                    "differences; differentiate `render` in it, or `render` of scenes that differ in max_depth"
                )
        colors, options = tangents.places(wanted.values()), replace(self.options, derivative=bool(wanted))
        sums, by_color = _kernel(scene, *work, depth=self.depth, options=options, colors=colors)
        slopes = {name: by_color[:, :, place] for place, name in enumerate(wanted)}
        return sums, {name: tangents.in_parameter(s, bool(wanted[name].shape)) for name, s in slopes.items()}


@partial(jax.jit, static_argnames=("depth", "options", "colors"))
def _kernel(scene, pixels, first_sample, spp, seeds, *, depth, options: Options, colors: tangents.Places = ()):
    """Return sums (R, N, depth, 3), and derivatives (R, N, T, depth, 3) in T colours."""
    choice = emitters.choice(scene.emitters, options.strategy)

    def one_pixel(work, scene, choice, unit_tangents):
        def of(scene):
            return terms.sums(work, scene, choice, depth, options), ()

        sums, by_color, _ = tangents.by_tangent(of, scene, colors, unit_tangents)
        return sums, by_color

    tiled, counts = jnp.tile(pixels, len(seeds)), spp
    if options.shared:
        counts = film.extended(scene.film, spp)
    work = tiled, *pixel.numbers(tiled, first_sample, counts.ravel(), jnp.repeat(seeds, len(pixels)))
    shared = scene, choice, tangents.unit_tangents(scene, colors)
    results = map_pixels(one_pixel, work, *shared, options=options, means=False)
    results = (x.reshape(*spp.shape, *x.shape[1:]) for x in results)
    # A film that shares samples returns means.
    return tuple(x * spp.reshape(*spp.shape, *[1] * (x.ndim - 2)) if options.shared else x for x in results)
