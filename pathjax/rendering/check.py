"""Test a claimed derivative against differences of rendered images."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import overload

import jax
import numpy as np
from jax.typing import ArrayLike
from scipy import stats

from pathjax.compile import standard_promotion
from pathjax.derivatives import ior
from pathjax.derivatives.jacobian import jacobian
from pathjax.errors import InputError
from pathjax.rendering.render import render
from pathjax.scene import parameters as named
from pathjax.scene.parameters import with_parameters
from pathjax.scene.scene import Scene

# (theta, seed) -> image (H, W, channels), and (theta, v, seed) -> its derivative along v, of the same shape.
Render = Callable[[np.ndarray, int], ArrayLike]
Derivative = Callable[[np.ndarray, np.ndarray, int], ArrayLike]

# Probability that a correct derivative is rejected.
FALSE_ALARM = 1e-3
# Reach of the differences, relative to the range between two bounds, or to the value where there is no finite range ...
_REACH = 0.1
# ... but within a range no more than half the value, since the effect of a roughness varies with its logarithm, and no
# less than this part of the range, which float32 resolves.
_OF_VALUE, _LEAST = 0.5, 1e-3


@dataclass
class GradientCheck:
    """Derivative minus differences, over blocks of pixels, in standard errors."""

    z: np.ndarray  # (h, w, channels), per block; if the derivative is right, Student's t
    freedom: int  # degrees of freedom of t
    p_value: float  # of the largest |z|, over all blocks (Sidak); 0 where anything is not finite
    passed: bool  # p_value is above the false alarm rate
    # The slopes on the two sides differ, or the image jumps at a bound, so there is no derivative: z and p_value are
    # then those of the slope that agrees better with the claimed derivative.
    kink: bool
    # Relative error of the derivative, the same everywhere, that half of all checks detect; inf: no error is detected,
    # since no image changes.
    resolution: float
    direction: np.ndarray  # v, of theta's shape: direction of the derivative
    derivative: np.ndarray  # (H, W, channels) as claimed, mean over the seeds
    difference: np.ndarray  # (H, W, channels)

    @property
    def mean_square(self) -> float:
        """Mean z^2; near freedom / (freedom - 2) where the derivative is right."""
        return float((self.z**2).mean())


@overload
def check_gradient(
    of: Scene,
    at: str,
    spp: int = 64,
    seed: int = 0,
    *,
    seeds: int = 16,
    block: int = 8,
    false_alarm: float = FALSE_ALARM,
) -> GradientCheck: ...


@overload
def check_gradient(
    of: Render,
    at: ArrayLike,
    *,
    derivative: Derivative,
    bounds: tuple[float, float] | None = None,
    reach: float | None = None,
    seed: int = 0,
    seeds: int = 16,
    block: int = 8,
    false_alarm: float = FALSE_ALARM,
) -> GradientCheck: ...


@standard_promotion
def check_gradient(
    of: Scene | Render,
    at: str | ArrayLike,
    spp: int = 64,
    seed: int = 0,
    *,
    derivative: Derivative | None = None,
    bounds: tuple[float, float] | None = None,
    reach: float | None = None,
    seeds: int = 16,
    block: int = 8,
    false_alarm: float = FALSE_ALARM,
) -> GradientCheck:
    """Test the derivative of an image in one parameter, of this renderer or of any other.

    It is compared with differences of images at other values of the parameter, which share its random numbers, per
    block of pixels: over independent seeds, the mean of derivative minus difference must be 0 within its standard
    error. All entries of a colour, a texture or any other array move at once, along a random direction v whose entries
    are between 1/2 and 1, or their negatives where the bounds leave no room.

    Differences are those of polynomials through five values around the present one; for the IOR of smooth glass through
    two, at the step that `jacobian` chose, so that both have the same bias. A derivative that does not pass is compared
    with the differences on either side of theta too, if the images have a kink there.

    Args:
        of: a scene; or a function (theta, seed) -> image (H, W, channels).
        at: the name of a parameter of the scene, as `parameters` lists them; or theta, a scalar or an array.
        spp: samples per pixel of each image, for a scene.
        seed: seed of the first comparison.
        derivative: for a function, the derivative to be tested: (theta, v, seed) -> derivative of the image along v;
            for a scalar v = 1. It need not share random numbers with the image, but the test detects more if it does.
        bounds: for a function, bounds of each entry of theta; None: unbounded.
        reach: for a function, distance from the first to the last of the five values; None: a tenth of the value, or of
            the range, if that is finite.
        seeds: number of independent comparisons, at least 3.
        block: side of the blocks of pixels over which derivatives are averaged.
        false_alarm: probability that a correct derivative fails, in (0, 1), if means over blocks are normally
            distributed.
    Returns:
        GradientCheck.
    Raises:
        InputError: an unknown name; a value out of its range; an image of another shape; bounds that leave no room.
    """
    if seeds < 3:
        raise InputError(f"seeds = {seeds}; at least 3 are needed to estimate their scatter")
    if block < 1:
        raise InputError(f"block = {block}; it is the side of blocks of pixels, at least 1")
    if not 0 < false_alarm < 1:
        raise InputError(f"false_alarm = {false_alarm}; it is a probability, between 0 and 1")
    nodes = None
    if isinstance(of, Scene):
        if derivative is not None or bounds is not None or reach is not None:
            raise InputError("derivative, bounds and reach are those of a function; a scene has its own")
        of, derivative, at, bounds, nodes = _of_scene(of, at, spp)
    if derivative is None:
        raise InputError("derivative is missing: of a function it is what is tested, (theta, v, seed) -> derivative")
    theta, bounds = np.asarray(at, float), bounds or (-math.inf, math.inf)
    direction, nodes = _direction(theta, bounds, reach) if nodes is None else (np.ones(theta.shape), nodes)
    derivatives, differences, weights = [], [], [_weights(nodes), *_sides(nodes)]
    for k in range(seed, seed + seeds):
        images = [_image(of(np.clip(theta + x * direction, *bounds), k)) for x in nodes]
        differences.append(np.tensordot(weights, images, 1))
        derivatives.append(_image(derivative(theta, direction, k)))
        if derivatives[-1].shape != images[0].shape:
            raise InputError(f"the derivative has the shape {derivatives[-1].shape}, the image {images[0].shape}")
    largest = np.abs(images[0]).max() / np.abs(nodes).max()
    return _compared(direction, np.array(derivatives), np.array(differences), largest, block, false_alarm)


def _of_scene(scene, name, spp):
    """Return Render, Derivative, value and bounds of a parameter; and nodes, or None to choose them from the value."""
    parameter = named.find(scene, name)
    value = named.parameters(scene)[name]

    def image(theta, seed=0):
        return render(with_parameters(scene, {name: theta}), spp, seed)

    def along(theta, v, seed):
        if parameter.is_texture:
            return jax.jvp(lambda x: image(x, seed), (value,), (np.asarray(v, value.dtype),))[1]
        _, J = jacobian(scene, [name], spp, seed)
        return np.tensordot(J[name], v, v.ndim)

    nodes = None
    if parameter.moves_paths:
        step = float(jacobian(scene, [name], 1)[1].step[name])
        nodes = np.array([-1.0, 1.0]) * step / abs(float(ior.ratio_by(scene, parameter)))
    return image, along, value, parameter.bounds, nodes


def _image(x):
    x = np.asarray(x, float)
    if x.ndim != 3:
        raise InputError(f"an image has the shape {x.shape}; it must have three axes, height, width and channels")
    return x


def _direction(theta, bounds, reach):
    """Return v, of the shape of theta, and (5,) nodes x, such that all theta + x v lie within the bounds."""
    low, high = bounds
    if not theta.size:
        raise InputError("theta holds no number, so no image can change with it")
    if reach is not None and not 0 < reach < math.inf:
        raise InputError(f"reach = {reach}; it must be positive and finite")
    if not (np.isfinite(theta).all() and (theta >= low).all() and (theta <= high).all()):
        raise InputError(f"theta is not finite, or lies outside the bounds [{low:g}, {high:g}]")
    if reach is None:
        size = np.abs(theta).max()
        if np.isfinite(high - low):
            width = high - low
            reach = np.clip(_OF_VALUE * size, _LEAST * width, _REACH * width)
        else:
            reach = _REACH * (size or 1)
    direction = np.ones(theta.shape)
    if theta.ndim:
        direction = np.random.default_rng(0).uniform(0.5, 1, theta.shape) * np.where(high - theta < reach / 2, -1, 1)
    ahead = np.where(direction > 0, high - theta, theta - low).min()
    behind = np.where(direction > 0, theta - low, high - theta).min()
    reach = min(reach, ahead + behind)
    if not reach > 0:
        raise InputError(f"the bounds [{low:g}, {high:g}] leave theta no room")
    first = -min(max(reach / 2, reach - ahead), behind)
    return direction, first + reach * np.linspace(0, 1, 5)


def _weights(nodes):
    """Return the weights of values at the nodes whose weighted sum is the derivative at 0, exact for polynomials."""
    powers = np.arange(len(nodes))
    return np.linalg.solve(nodes[None] ** powers[:, None], (powers == 1).astype(float))


def _sides(nodes):
    """Weights of the slopes to the left and to the right of 0, and of a difference that a kink makes nonzero.

    If all nodes lie on one side, both slopes leave out the node 0, so that a jump there does not affect them. The
    difference is 0 for cubic polynomials. Empty if the nodes are too few, or none is 0.
    """

    def of(used):
        weights = np.zeros(len(nodes))
        weights[used] = _weights(nodes[used])
        return weights

    left, right = nodes <= 0, nodes >= 0
    if len(nodes) < 5 or not (left & right).any():
        return []
    if left.all() or right.all():
        beyond = of(nodes != 0)
        return [beyond, beyond, _weights(nodes) - beyond]
    return [of(left), of(right), of(right) - of(left)]


def _compared(direction, derivatives, differences, largest, block, false_alarm):
    """Compare derivatives (seeds, H, W, channels) with differences; eps * largest is a difference's rounding error.

    differences: (seeds, 1, H, W, channels), or (seeds, 4, H, W, channels) with those of `_sides`.
    """
    seeds = len(derivatives)
    derivatives = np.where(np.isfinite(derivatives), derivatives, np.nan)  # avoids differences of infinities
    claimed, found = _blocks(derivatives, block), [_blocks(x, block) for x in np.moveaxis(differences, 1, 0)]
    # Rounding error, where both agree to the last bits.
    size = _blocks(np.abs(derivatives) + np.abs(differences[:, 0]), block).mean(0)
    floor = np.finfo(np.float32).eps * (size + largest)

    def compared(gap):
        error = np.sqrt(gap.var(0, ddof=1) / seeds + floor**2 + np.finfo(float).tiny)
        return gap.mean(0) / error, error

    def chance(z):
        """Probability that the largest |z| is at least this large, if the derivative is right."""
        worst = np.abs(z).max()
        if not np.isfinite(worst):
            return 0.0
        return -math.expm1(z.size * math.log1p(-min(2 * stats.t.sf(worst, seeds - 1), 1 - 1e-16)))

    difference, *sides = found
    z, error = compared(claimed - difference)
    limit = stats.t.isf(-math.expm1(math.log1p(-false_alarm) / z.size) / 2, seeds - 1)
    slope = np.abs(difference.mean(0))
    resolution = float((limit * error[slope > 0] / slope[slope > 0]).min()) if (slope > 0).any() else math.inf
    p_value, kink = chance(z), False
    if sides and np.isfinite(z).all() and p_value <= false_alarm:
        left, right, apart = sides
        kink = chance(compared(apart)[0]) <= false_alarm
        if kink:
            z = max((compared(claimed - side)[0] for side in (left, right)), key=chance)
            p_value = chance(z)
    means = derivatives.mean(0), differences[:, 0].mean(0)
    return GradientCheck(z, seeds - 1, p_value, p_value > false_alarm, kink, resolution, direction, *means)


def _blocks(images, side):
    """Average (K, H, W, C) over blocks, to (K, h, w, C); incomplete blocks at the borders are ignored."""
    count, height, width, channels = images.shape
    side = min(side, height, width)
    h, w = height // side, width // side
    return images[:, : h * side, : w * side].reshape(count, h, side, w, side, channels).mean((2, 4))
