"""Parameters by name: where each lives in the scene's tables, and scenes with other values for some of them."""

from __future__ import annotations

import difflib
import weakref
from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile.runtime import usual_promotion
from pathjax.errors import InputError
from pathjax.kinds.parameter import Parameter
from pathjax.scene.metadata import About
from pathjax.scene.scene import Scene


@usual_promotion
def parameters(scene: Scene) -> dict[str, jax.Array]:
    """Return all parameters of the scene by name, `ID.field`."""
    return {name: get(scene, p.path)[p.index] for name, p in about(scene).parameters.items()}


@usual_promotion
def with_parameters(scene: Scene, values: Mapping) -> Scene:
    """Return the scene with other values for some of its parameters; nothing is compiled again.

    Args:
        values: name -> value of the parameter's shape; a number stands for all channels. Values may be traced.
    Raises:
        InputError: a name is unknown, or a value has the wrong shape or lies outside the parameter's bounds.
    """
    known = about(scene)
    traced = dict(known.traced)
    for name, value in values.items():
        parameter = find(scene, name)
        array = get(scene, parameter.path)
        value = checked(name, value, parameter, array.dtype)
        names = traced_in(scene, parameter.path) if isinstance(array, jax.core.Tracer) else frozenset()
        if isinstance(value, jax.core.Tracer):
            names |= {name}
        array = array.at[parameter.index].set(value)
        traced[parameter.path] = weakref.ref(array), names
        scene = replace(put(scene, parameter.path, array), about=replace(known, traced=traced))
    return scene


def traced_in(scene: Scene, path) -> frozenset[str]:
    """Names of the parameters of a table that may hold traced values: all, unless `with_parameters` made the table."""
    known = about(scene)
    made, names = known.traced.get(path, (lambda: None, frozenset()))
    if made() is get(scene, path):
        return names
    return frozenset(name for name, parameter in known.parameters.items() if parameter.path == path)


def about(scene: Scene) -> About:
    if scene.about is None:
        raise InputError("this scene was stripped of its names; take the one that load_scene returned")
    return scene.about


def find(scene: Scene, name: str) -> Parameter:
    known = about(scene)
    if name in known.parameters:
        return known.parameters[name]
    if name in known.refused:
        raise InputError(known.refused[name])
    near = difflib.get_close_matches(name, known.parameters, n=3, cutoff=0.3)
    raise InputError(f"no parameter is named {name!r}; " + _offer(near, known.parameters))


def _offer(near, parameters):
    if not parameters:
        return "this scene has none"
    return "did you mean " + " or ".join(near) + "?" if near else "the scene has " + ", ".join(parameters)


def checked(name, value, parameter: Parameter, dtype):
    """The value as an array of the parameter's shape; values that are known must lie within its bounds."""
    try:
        value = jnp.asarray(value, dtype)
        value = jnp.broadcast_to(value, parameter.shape)
    except (TypeError, ValueError):
        wanted = f"{parameter.shape[0]} numbers" if parameter.shape else "one number"
        raise InputError(f"{name} takes {wanted}, not {value!r}") from None
    if not isinstance(value, jax.core.Tracer):
        low, high = parameter.bounds
        if not bool(jnp.all((value >= low) & (value <= high) & jnp.isfinite(value))):
            raise InputError(f"{name} = {np.asarray(value).tolist()} lies outside its bounds [{low:g}, {high:g}]")
    return value


def get(tree, path):
    """What `path` leads to."""
    for step in path:
        tree = tree[step] if isinstance(step, int) else getattr(tree, step)
    return tree


def put(tree, path, value):
    """The tree with `value` where `path` leads."""
    if not path:
        return value
    step, rest = path[0], path[1:]
    if isinstance(step, int):
        return (*tree[:step], put(tree[step], rest, value), *tree[step + 1 :])
    return replace(tree, **{step: put(getattr(tree, step), rest, value)})
