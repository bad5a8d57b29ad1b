"""The rule of differentiation of whatever is estimated of a scene: in named parameters, and in nothing else.

An estimate E(theta) is differentiated by the Jacobian J that its own kernel makes beside it: the tangent of E is
J d(theta). That is linear in d(theta), so JAX transposes it: `jax.jvp`, `jax.linearize`, `jax.jacfwd`, `jax.grad` and
optimistix's solvers all work, and what they ask of the kernel is always the same. Of many numbers, as those of
textures, J is never made: J v and J^T v come by kernels of their own, the transpose of each other.

What d(theta) is, the scene says: `with_parameters` keeps traced values by name in `Scene.varied`, and puts them into
the tables detached. A derivative that arrives by a table all the same was asked for by other means; it is that of all
parameters in the table, and where there are none it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from pathjax.compile import is_symbolic_zero, linear, usual_promotion
from pathjax.errors import InputError
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# The field of a step down to a leaf that says where it goes.
KEYS = {jax.tree_util.GetAttrKey: "name", jax.tree_util.SequenceKey: "idx", jax.tree_util.DictKey: "key"}


@runtime_checkable
class Estimator(Protocol):
    """Something that is estimated of a scene."""

    def value(self, scene: Scene, *work) -> jax.Array: ...

    def jacobian(self, scene: Scene, wanted: dict[str, Parameter], *work) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The value, and by name its derivative, (*shape of the value, *shape of the parameter).

        Raises:
            InputError: what it is not differentiated in.
        """

    def matrix_free(self, scene: Scene, wanted: dict[str, Parameter]) -> set[str]:
        """Names in which it is better differentiated by `push` and `pull` than by the Jacobian."""


@runtime_checkable
class MatrixFree(Estimator, Protocol):
    """What is estimated, and differentiated without its Jacobian too."""

    def push(self, scene: Scene, wanted: dict[str, Parameter], changes: dict[str, jax.Array], *work) -> jax.Array:
        """J v of such names."""

    def pull(self, scene: Scene, wanted: dict[str, Parameter], adjoint: jax.Array, *work) -> dict[str, jax.Array]:
        """J^T v of such names."""


def estimate(estimator: Estimator, scene: Scene, *work) -> jax.Array:
    """`estimator.value` of a scene without names, differentiable in the named parameters of the scene."""
    parameters = {} if scene.about is None else scene.about.parameters
    return _estimate((estimator, parameters), named.nameless(scene), scene.varied, *work)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _estimate(static, scene, varied, *work):
    estimator, _ = static
    return estimator.value(scene, *work)


@partial(_estimate.defjvp, symbolic_zeros=True)
@usual_promotion
def _estimate_jvp(static, primals, tangents):
    estimator, parameters = static
    scene, varied, *work = primals
    scene_tangent, varied_tangent, *_ = tangents
    changes = _changes(parameters, scene_tangent, varied_tangent)
    wanted = {name: parameters[name] for name in changes}
    named.refuse_constant(scene, wanted)
    free = {name: wanted.pop(name) for name in sorted(estimator.matrix_free(scene, wanted))}
    if free:
        # Not attached, which would copy texels.
        scene, _ = differentiated_once((scene, varied), "an image in a texture, or in many colours,")
    else:
        # Attached, for derivatives of the derivative.
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
    """Tangents of named parameters, by name; those that are known to be zero are left out."""
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
    """The scene; a derivative in it is refused. where: what is differentiated, in words."""
    return scene


@partial(differentiated_once.defjvp, symbolic_zeros=True)
def _refuse(where, primals, tangents):
    raise InputError(f"second derivatives are not supported where {where} is differentiated")
