"""A coarse solution as a control variate of the path tracer: roulette that ends paths in L0 instead of in 0.

At a vertex y of a path let S(y) = (T L)(y) be the reflected light, S0(y) its value on the patches, and s the estimate
of S(y) by the rest of the path. With survival probability q, independent of s, the estimate

    S0(y)  if the path ends,        S0(y) + (s - S0(y)) / q  if it goes on,

has the mean of s whatever S0 is, and the variance Var(s) / q + (1 / q - 1) (S(y) - S0(y))^2, where plain roulette has
S(y)^2 in the last term. The first term remains however good S0 is: a perfect S0 saves time at the cost of noise.

Survival is proportional to the share of a path's expected light that is still to be found at y, throughput * S0(y)
over S0 at its first vertex (Vorba and Krivanek 2016, "Adjoint-driven Russian roulette and splitting").
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import dot, safe_divide
from pathjax.errors import InputError
from pathjax.integrators import roulette
from pathjax.scene.scene import Scene
from pathjax.shapes.geometry import Geometry
from pathjax.transport.patches import refuse_media
from pathjax.transport.view import Radiosity, radiance

# First depth of roulette: pixels would show the patches if paths ended at their first vertex.
_FIRST = 2


@register_dataclass
@dataclass(frozen=True)
class Control:
    """Control variate for `pathjax.render`, built by `Operator.control`."""

    reflected: Radiosity  # S0
    effort: jax.Array  # () survival where all of a path's expected light is still to be found

    def check(self, scene: Scene) -> None:
        """Refuse, with an InputError, a scene with other shapes or with media."""
        refuse_media(scene)
        cut, held = self.reflected.patches.first.shape[0], scene.geometry.shape.shape[0]
        if cut != held:
            raise InputError(
                f"control was made of a scene of {cut} primitives, and this one has {held}; make it of this scene: "
                "op = transport.operator(scene); control = op.control(op.solve().L)"
            )

    def roulette(self, shapes: Geometry, path, hit, surface, u):
        """Decide at a vertex, before its light is sampled, whether a path continues.

        Args:
            path: `integrators.path.Path` that has reached the vertex, where `geometry.surface` is `surface`.
            u: () uniform.
        Returns:
            The Path with L and throughput weighted; () bool whether it continues.
        """
        S0 = radiance(self.reflected, shapes, hit.primitive, surface.p, dot(surface.n, path.ray.d) > 0)
        left = path.throughput * S0
        size = left[0] + left[1] + left[2]
        expected = jnp.where(path.depth == 1, size, path.expected)
        # Where the patches expect no light, they give no information.
        share = jnp.where(expected > 0, safe_divide(size, expected), 1)
        survival = roulette.bounded(self.effort * share)
        survival = compute_once(jnp.where(path.depth >= _FIRST, survival, 1))
        survives = u < survival
        L = path.L + left * jnp.where(survives, 1 - 1 / survival, 1)
        return path._replace(L=L, throughput=path.throughput / survival, expected=expected), survives
