"""The differentiation rule of all estimates of a scene: they are differentiable in named parameters, and nothing else.

The kernel of an estimate E(theta) also makes its Jacobian J, and the tangent of E is J d(theta). That is linear in
d(theta), so JAX transposes it: `jax.jvp`, `jax.linearize`, `jax.jacfwd`, `jax.grad` and optimistix's solvers all work,
and all run the same kernel. For many scalars, such as textures, J is never made: J v and J^T v have kernels of their
own, each the transpose of the other.

The scene says what d(theta) is: `with_parameters` keeps traced values by name in `Scene.varied`, and puts them into the
tables detached. A tangent that arrives through a table all the same was set by other means: it counts as the tangent of
all parameters in that table, and is refused where there are none.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from pathjax.compile import is_symbolic_zero, linear, standard_promotion
from pathjax.errors import InputError
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Type of a key in the path to a leaf -> the attribute that holds its name or index.
KEYS = {jax.tree_util.GetAttrKey: "name", jax.tree_util.SequenceKey: "idx", jax.tree_util.DictKey: "key"}


@runtime_checkable
class Estimator(Protocol):
    """An estimate of a scene."""

    def value(self, scene: Scene, *work) -> jax.Array: ...

    def jacobian(self, scene: Scene, wanted: dict[str, Parameter], *work) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Return the value and, by name, its derivative (*shape of the value, *shape of the parameter).

        Raises:
            InputError: the estimate cannot be differentiated in one of the parameters.
        """

    def matrix_free(self, scene: Scene, wanted: dict[str, Parameter]) -> set[str]:
        """Return the names in which differentiating by `push` and `pull` is better than by the Jacobian."""


@runtime_checkable
class MatrixFree(Estimator, Protocol):
    """An estimate that can be differentiated without its Jacobian too."""

    def push(self, scene: Scene, wanted: dict[str, Parameter], changes: dict[str, jax.Array], *work) -> jax.Array:
        """Return J v for names from `matrix_free`."""

    def pull(self, scene: Scene, wanted: dict[str, Parameter], adjoint: jax.Array, *work) -> dict[str, jax.Array]:
        """Return J^T v for names from `matrix_free`."""


def estimate(estimator: Estimator, scene: Scene, *work) -> jax.Array:
    """Return `estimator.value` of the scene without names, differentiable in the scene's named parameters."""
    parameters = {} if scene.about is None else scene.about.parameters
    return _estimate((estimator, parameters), named.nameless(scene), scene.varied, *work)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _estimate(static, scene, varied, *work):
    estimator, _ = static
    return estimator.value(scene, *work)


@partial(_estimate.defjvp, symbolic_zeros=True)
@standard_promotion
def _estimate_jvp(static, primals, tangents):
    estimator, parameters = static
    scene, varied, *work = primals
    scene_tangent, varied_tangent, *_ = tangents
    changes = _changes(parameters, scene_tangent, varied_tangent)
    wanted = {name: parameters[name] for name in changes}
    named.refuse_constant(scene, wanted)
    free = {name: wanted.pop(name) for name in sorted(estimator.matrix_free(scene, wanted))}
    if free:
        # Attaching the values would copy texels.
        scene, _ = differentiated_once((scene, varied), "an image in a texture, or in many colours,")
    else:
        # Values are attached for second derivatives.
        scene = named.with_values(scene, varied, parameters)
    value, J = estimator.jacobian(scene, wanted, *work) if wanted else (estimator.value(scene, *work), {})
    tangent = jnp.zeros_like(value)
    for name in wanted:
        tangent = tangent + jnp.tensordot(J[name], changes[name], changes[name].ndim)
    if free:
        tangent = tangent + _moved(estimator, free, {name: changes[name] for name in free}, scene, work)
    return value, tangent


def _moved(estimator: MatrixFree, free: dict[str, Parameter], changes: dict[str, jax.Array], scene: Scene, work):
    """J v as a function whose transpose is J^T v."""

    def there(known, changes):
        scene, work = known
        return estimator.push(scene, free, changes, *work)

    def back(known, adjoint):
        scene, work = known
        return estimator.pull(scene, free, adjoint, *work)

    return linear(there, back, (scene, work), changes)


def _changes(parameters: Mapping[str, Parameter], scene_tangent, varied_tangent) -> dict[str, jax.Array]:
    """Return the tangents of named parameters, by name, without those that are symbolic zeros."""
    changes = {name: x for name, x in varied_tangent.items() if not is_symbolic_zero(x)}
    leaves, _ = jax.tree_util.tree_flatten_with_path(scene_tangent, is_leaf=is_symbolic_zero)
    for keys, leaf in leaves:
        if is_symbolic_zero(leaf):
            continue
        place = tuple(getattr(key, KEYS[type(key)]) for key in keys)
        held = {name: parameter for name, parameter in parameters.items() if parameter.path == place}
        if not held:
            raise InputError(
                f"a derivative in scene.{'.'.join(map(str, place))} was asked for, and pathjax does not differentiate "
                "in it; set named parameters by with_parameters and differentiate in their values (`pathjax info` "
                "lists them)"
            )
        for name, parameter in held.items():
            changes[name] = changes.get(name, 0) + parameter.get(leaf)
    return {name: changes[name] for name in parameters if name in changes}


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def differentiated_once(scene, where: str):
    """Return the scene, refusing derivatives in it. where: words for the error: what is differentiated already."""
    return scene


@partial(differentiated_once.defjvp, symbolic_zeros=True)
def _refuse(where, primals, tangents):
    raise InputError(f"second derivatives are not supported where {where} is differentiated")
