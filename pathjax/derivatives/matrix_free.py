"""J v and J^T v for the means of pixels, without J: each costs about one image, whatever the size of v.

J v is carried along paths (`forward`); J^T v is made by a recorded sweep when they have ended (`backward`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.compile import standard_promotion
from pathjax.derivatives import backward, differentiated, forward
from pathjax.derivatives.kept import kept as kept_of
from pathjax.derivatives.kept import of_entries, of_parameter
from pathjax.integrators import pixel
from pathjax.integrators.options import Counts, Options
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

Changes = dict[str, Float[Array, "..."]]


def is_swept(scene: Scene, parameter: Parameter) -> bool:
    """Return whether the recorded sweep can differentiate in the parameter."""
    return not parameter.moves_paths and parameter.path in differentiated.paths(scene)


@standard_promotion
def push(
    scene: Scene, wanted: Mapping[str, Parameter], changes: Changes, pixels, first_sample, spp, seed, options, **how
) -> Float[Array, "N 3"]:
    """Return J v. changes: v, by parameter name; the rest as for `jacobian.pixel_jacobians`."""
    kept = kept_of(scene, wanted.values())
    moved = {name: of_entries(scene, wanted[name], change) for name, change in changes.items()}
    if len(wanted) == 1 and kept.all:
        (v,) = moved.values()  # not copied, as it may be large
    else:
        v = jnp.zeros((kept.count, 3), scene.camera.origin.dtype)
        for name, change in moved.items():
            here = kept.of(scene, wanted[name])
            v = v.at[here.start : here.stop].set(change)
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    options = replace(options, derivative=True, by_vertex=True)
    return forward.push(scene, v, pixels, *numbers, kept=kept, options=options, **how)


@standard_promotion
def pull(
    scene: Scene,
    wanted: Mapping[str, Parameter],
    adjoint: Float[Array, "N 3"],
    pixels: Int[Array | np.ndarray, " N"],
    first_sample: Counts,
    spp: Counts,
    seed: Counts,
    options: Options,
    ring: int | None = None,
    **how,
) -> Changes:
    """Return J^T v, by name, of each parameter's shape.

    Args:
        adjoint: v.
        ring: as returned by `backward.longest_ring`; None: that of the scene.
        others: as for `push`.
    """
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    options = replace(options, derivative=True, by_vertex=True)
    ring = ring or backward.longest_ring(scene)
    kept = kept_of(scene, wanted.values())
    how |= dict(kept=kept, options=options, ring=ring)
    total = backward.pullback(scene, adjoint, pixels, *numbers, **how)

    def of(parameter):
        here = kept.of(scene, parameter)
        found = total[here.start : here.stop, :3]
        found = found if differentiated.of_colors(scene, parameter.path) else found.sum(1)
        return of_parameter(parameter, named.get(scene, parameter.path).shape, found)

    return {name: of(parameter) for name, parameter in wanted.items()}
