"""Get and set the parameters of a scene by name."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from pathjax.compile import is_traced, standard_promotion
from pathjax.errors import InputError
from pathjax.kinds.parameter import Parameter, with_textures
from pathjax.scene.scene import Scene


@standard_promotion
def parameters(scene: Scene) -> dict[str, jax.Array]:
    """Return all parameters of the scene by name, `ID.field`."""
    scene = attached(scene)
    return {name: p.get(get(scene, p.path)) for name, p in scene.described.parameters.items()}


@standard_promotion
def with_parameters(scene: Scene, values: Mapping[str, ArrayLike | Sequence[float]]) -> Scene:
    """Return the scene with other values for some of its parameters; nothing is compiled again.

    Args:
        values: name -> value of the parameter's shape; a scalar sets all channels. Values may be traced.
    Raises:
        InputError: a name is unknown, or a value has the wrong shape or lies outside the parameter's bounds.
    """
    new = {}
    for name, value in values.items():
        parameter = find(scene, name)
        new[name] = checked(name, value, parameter, get(scene, parameter.path).dtype)
    varied = {name: value for name, value in scene.varied.items() if name not in new}
    varied |= {name: value for name, value in new.items() if is_traced(value)}
    new = {name: lax.stop_gradient(value) for name, value in new.items()}
    return replace(with_values(scene, new, scene.described.parameters), varied=varied)


def attached(scene: Scene) -> Scene:
    """Return the scene with `varied` in its tables, for code that differentiates through the tables."""
    return with_values(scene, scene.varied, scene.described.parameters) if scene.varied else scene


def with_values(
    scene: Scene, values: Mapping[str, jax.Array], parameters: Mapping[str, Parameter], placed: bool = False
) -> Scene:
    """Return the scene with values of parameters in its tables, unchecked.

    Args:
        placed: the arrays hold the values already, and only derived data is updated.
    """
    textures: dict[tuple, list[tuple[Parameter, jax.Array]]] = {}
    for name, value in values.items():
        parameter = parameters[name]
        if parameter.is_texture and not placed:
            textures.setdefault(parameter.path, []).append((parameter, value))
        elif not placed:
            scene = put(scene, parameter.path, parameter.put(get(scene, parameter.path), value))
    for path, found in textures.items():
        scene = put(scene, path, with_textures(get(scene, path), found))
    given = {(parameters[name].path, parameters[name].index): value for name, value in values.items()}
    for mean in dict.fromkeys(mean for name in values for mean in parameters[name].means):
        total = np.array(mean.rest)
        for share, part in mean.parts:
            value = given.get((part.path, part.index))
            value = part.get(get(scene, part.path)) if value is None else value
            # Concrete values as the builders compute with them, equal to the last bit.
            value = lax.stop_gradient(value) if is_traced(value) else np.asarray(value, np.float64)
            total = total + share * (value.reshape(-1, 3).mean(0) if part.is_texture else value)
        scene = put(scene, mean.path, get(scene, mean.path).at[mean.row].set(total))
    changed: dict[tuple, list[str]] = {}
    for parameter in (parameters[name] for name in values):
        if parameter.table is not None:
            changed.setdefault(parameter.table, []).append(parameter.field)
    for path, fields in changed.items():
        table = get(scene, path)
        scene = put(scene, path, table.kind.derived(table, fields))
    return scene


def nameless(scene: Scene) -> Scene:
    """Return the scene as kernels get it: without names, so that scenes of one structure share kernels."""
    return replace(scene, about=None, varied={})


def find(scene: Scene, name: str) -> Parameter:
    known = scene.described
    if name in known.parameters:
        return known.parameters[name]
    if name in known.refused:
        raise InputError(known.refused[name])
    near = difflib.get_close_matches(str(name), known.parameters, n=3, cutoff=0.3)
    raise InputError(f"no parameter is named {name!r}; " + _suggestion(near, known.parameters))


def _suggestion(near, parameters):
    if not parameters:
        return "this scene has none"
    return "did you mean " + " or ".join(near) + "?" if near else "the scene has " + ", ".join(parameters)


def checked(name, value, parameter: Parameter, dtype):
    """Return the value as an array of the parameter's shape; concrete values must lie within its bounds."""
    given = value
    try:
        # Values that are not JAX arrays go through NumPy, which compiles nothing.
        own = isinstance(given, jax.Array) or is_traced(given)
        value = given if own else np.broadcast_to(np.asarray(given, dtype), parameter.shape)
        value = jnp.broadcast_to(jnp.asarray(value, dtype), parameter.shape)
    except (TypeError, ValueError):
        if parameter.is_texture:
            given = " x ".join(map(str, np.shape(given)))
            raise InputError(f"{name} has the shape {parameter.shape}, and cannot be set to {given} numbers") from None
        wanted = f"{parameter.shape[0]} numbers" if parameter.shape else "one number"
        raise InputError(f"{name} takes {wanted}, not {given!r}") from None
    if not is_traced(value):
        low, high = parameter.bounds
        known = np.asarray(value)  # compared by NumPy, which compiles nothing
        if not np.all((known >= low) & (known <= high) & np.isfinite(known)):
            given = "a value" if parameter.is_texture else np.asarray(value).tolist()
            raise InputError(f"{name} = {given} lies outside its bounds [{low:g}, {high:g}]")
    return value


def refuse_constant(scene: Scene, wanted: Mapping[str, Parameter]) -> None:
    """Refuse a derivative in a parameter whose value is concrete and not above its least value."""
    for name, parameter in wanted.items():
        values = get(scene, parameter.path)
        if not math.isfinite(parameter.least) or parameter.is_texture or is_traced(values):
            continue
        value = parameter.get(np.asarray(values))
        if value <= parameter.least:
            raise InputError(
                f"{name} = {value:g} has no derivative: what is below {parameter.least:g} counts as that, so no image "
                "changes with it; set a larger value"
            )


def get(tree, path):
    """Return the part of a tree that `path` leads to."""
    for step in path:
        tree = tree[step] if isinstance(step, int) or isinstance(tree, Mapping) else getattr(tree, step)
    return tree


def put(tree, path, value):
    """Return the tree with the part that `path` leads to replaced by `value`."""
    if not path:
        return value
    step, rest = path[0], path[1:]
    if isinstance(tree, Mapping):
        return {**tree, step: put(tree[step], rest, value)}
    if isinstance(step, int):
        return (*tree[:step], put(tree[step], rest, value), *tree[step + 1 :])
    return replace(tree, **{step: put(getattr(tree, step), rest, value)})
