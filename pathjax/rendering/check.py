"""Is a derivative right? The Jacobian against differences of rendered images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from pathjax.compile import usual_promotion
from pathjax.derivatives import ior
from pathjax.derivatives.jacobian import jacobian
from pathjax.errors import InputError
from pathjax.rendering.render import render
from pathjax.scene import parameters as named
from pathjax.scene.parameters import with_parameters
from pathjax.scene.scene import Scene

# Chance that a right derivative is called wrong.
FALSE_ALARM = 1e-3
# Reach of the differences in colours, relative to the value or range.
_REACH = 0.1


@dataclass
class GradientCheck:
    """Jacobian minus differences, over blocks of pixels, in standard errors."""

    z: np.ndarray  # (h, w, 3), a block each; Student's t of `freedom` degrees of freedom where the derivative is right
    freedom: int
    p_value: float  # of the largest |z|, over all blocks (Sidak)
    passed: bool  # p_value is above the false alarm rate of 1e-3
    jacobian: np.ndarray  # (H, W, 3) mean over the seeds; of a colour: each channel in its own
    difference: np.ndarray  # (H, W, 3)

    @property
    def mean_square(self) -> float:
        """Mean z^2; near freedom / (freedom - 2) where the derivative is right."""
        return float((self.z**2).mean())


@usual_promotion
def check_gradient(
    scene: Scene, name: str, spp: int = 64, seed: int = 0, *, seeds: int = 16, block: int = 8
) -> GradientCheck:
    """Compare `jacobian` with differences of `render` at other values of one parameter, with common random numbers.

    The values lie around the present one, within the bounds: five of them for what images depend on smoothly. For the
    IOR of smooth glass they are two, at the step that `jacobian` chose, so that both have the same bias.

    Args:
        name: of a parameter, as `parameters` lists them.
        spp: samples per pixel of each image.
        seed: of the first comparison.
        seeds: number of independent comparisons, at least 3.
        block: side of the blocks of pixels over which derivatives are averaged.
    Returns:
        GradientCheck.
    """
    if seeds < 3:
        raise InputError(f"seeds = {seeds}; at least 3 are needed to estimate their scatter")
    parameter = named.find(scene, name)
    present = np.asarray(named.parameters(scene)[name])
    derivatives, differences = [], []
    for k in range(seed, seed + seeds):
        _, J = jacobian(scene, [name], spp, k)
        d = np.asarray(J[name], float)
        derivatives.append(np.einsum("...cc->...c", d) if parameter.shape else d)
        if parameter.moves_paths:
            nodes = np.array([-1.0, 1.0]) * float(J.step[name]) / abs(float(ior.ratio_by(scene, parameter)))
        else:
            nodes = _nodes(parameter, present)
        images = [np.asarray(render(with_parameters(scene, {name: present + x}), spp, k), float) for x in nodes]
        differences.append(np.tensordot(_weights(nodes), images, 1))
    derivatives, differences = np.array(derivatives), np.array(differences)
    gap = _blocks(derivatives - differences, block)
    size = _blocks(np.abs(derivatives) + np.abs(differences), block).mean(0)
    # What rounding leaves where both agree to the last bits.
    floor = np.finfo(np.float32).eps * (size + np.abs(images[0]).max() / np.abs(nodes).max())
    z = gap.mean(0) / np.sqrt(gap.var(0, ddof=1) / seeds + floor**2)
    p = 2 * stats.t.sf(np.abs(z).max(), seeds - 1)
    p_value = float(-np.expm1(z.size * np.log1p(-min(p, 1 - 1e-16))))
    return GradientCheck(z, seeds - 1, p_value, p_value > FALSE_ALARM, derivatives.mean(0), differences.mean(0))


def _nodes(parameter, present):
    """(5,) offsets that keep all channels within the bounds."""
    low, high = parameter.bounds
    reach = _REACH * (high - low if np.isfinite(high) else max(np.max(present), 1))
    room_below, room_above = np.min(present) - low, high - np.max(present)
    reach = min(reach, room_below + room_above)
    first = -min(max(reach / 2, reach - room_above), room_below)
    return first + reach * np.linspace(0, 1, 5)


def _weights(nodes):
    """Of values at the nodes, those that give the derivative at 0, exact for polynomials."""
    powers = np.arange(len(nodes))
    return np.linalg.solve(nodes[None] ** powers[:, None], (powers == 1).astype(float))


def _blocks(images, side):
    """(K, H, W, 3) to means over blocks (K, h, w, 3); what is left over at the borders is not looked at."""
    count, height, width, _ = images.shape
    side = min(side, height, width)
    h, w = height // side, width // side
    return images[:, : h * side, : w * side].reshape(count, h, side, w, side, 3).mean((2, 4))
