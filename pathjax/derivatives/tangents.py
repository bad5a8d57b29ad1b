"""Derivatives in colours and other parameters that change what paths carry: detached sampling, all tangents at once.

Light keeps its channel, so one tangent covers the three channels of a colour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pathjax.errors import InputError
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.scene import Scene

# Per parameter: the path to its array, and its index there.
Places = tuple[tuple[tuple, tuple], ...]


def refuse_textures(wanted: Mapping[str, Parameter], unless: str = "") -> None:
    """Refuse textures, whose entries are too many for one tangent each.

    Args:
        unless: words for the error: the condition under which a texture has derivatives.
    Raises:
        InputError: one of the parameters is a texture.
    """
    for name, parameter in wanted.items():
        if parameter.is_texture:
            raise InputError(
                f"{name} is a texture, of whose numbers no derivative is made one by one{unless}; differentiate "
                "`render` in it by jax.grad, jax.vjp or jax.jvp, which take them all at once"
            )


def places(parameters: Iterable[Parameter]) -> Places:
    return tuple((parameter.path, parameter.index) for parameter in parameters)


def in_parameter(slope: Float[Array, "*shape 3"], of_color: bool) -> Float[Array, "..."]:
    """Return the derivative in a colour, (*shape, 3, 3), from that of each channel in its own; in a scalar, `slope`."""
    return slope[..., None] * jnp.eye(3, dtype=slope.dtype) if of_color else slope


def unit_tangents(scene: Scene, colors: Places) -> list[Float[Array, "colors ..."]]:
    """Return, for every table, one tangent per colour of the table's shape: 1 in all channels of the colour."""
    tangents = []
    for table_path in _tables(colors):
        table = named.get(scene, table_path)
        tangent = jnp.zeros((len(colors), *table.shape), table.dtype)
        for number, (its_path, index) in enumerate(colors):
            if its_path == table_path:
                tangent = tangent.at[(number, *index)].set(1)
        tangents.append(tangent)
    return tangents


def by_tangent(
    of: Callable, scene: Scene, colors: Places, tangents: list[Float[Array, "colors ..."]]
) -> tuple[Float[Array, "*shape"], Float[Array, " colors *shape"], object]:
    """Return a value of the scene, its derivatives, and its auxiliary output.

    Args:
        of: scene -> (value, auxiliary output).
        tangents: `unit_tangents` of the colors.
    """
    if not colors:
        value, company = of(scene)
        return value, jnp.zeros((0, *value.shape), value.dtype), company
    paths = _tables(colors)

    def varied(tables):
        changed = scene
        for path, table in zip(paths, tables, strict=True):
            changed = named.put(changed, path, table)
        return of(changed)

    def push(tangents):
        return jax.jvp(varied, ([named.get(scene, path) for path in paths],), (tangents,), has_aux=True)

    return jax.vmap(push, out_axes=(None, 0, None))(tangents)


def _tables(colors: Places):
    """Return the paths of the tables that hold the colours, each once."""
    return list(dict.fromkeys(table_path for table_path, _ in colors))
