"""The record of a path vertex: the derivatives of its light and its weight in the values that it looks up.

`forward` and `backward` make J v and J^T v from records. The equations are

    R_{k-1} = Le_k + n_k + w_k R_k                     radiance that arrives at vertex k-1; 0 after the last vertex
    dI/d theta = beta_k (dLe_k/d theta + dn_k/d theta + (dw_k/d theta) R_k)

where Le is the emission that the path meets and n the light sample, both with their MIS weights, w the weight of the
bsdf sample over the survival probability of roulette, and beta the throughput before the vertex. Nothing is divided by
a reflectance, so black surfaces keep their derivative. Directions and probabilities are detached, as in all of pathjax.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pathjax.compile import basis, register_dataclass
from pathjax.core.math import smaller
from pathjax.derivatives import differentiated, places
from pathjax.emitters import Choice
from pathjax.integrators import path
from pathjax.integrators.options import Options
from pathjax.integrators.random_numbers import Bounce
from pathjax.integrators.shadow import none_dimmed, none_passed
from pathjax.scene.scene import Scene


@register_dataclass
@dataclass(frozen=True)
class Slot:
    """Derivatives of a vertex in one value that it looked up, times the throughput and the caller's scale."""

    places: tuple[Int[Array, ""], ...]  # indices, in the list of derivatives, of the entries that the value depends on
    # Weight of each entry in the value, or in each of its channels; None: there is one entry, of weight 1.
    shares: tuple[Float[Array, "..."], ...] | None
    now: Float[Array, "3"]  # d(Le + n)
    later: Float[Array, "3"] | None  # dw, to be multiplied by R; None: 0
    # The value may be the luminance of a texture.
    by_luminance: bool = field(default=False, metadata={"static": True})


class Record(NamedTuple):
    """What the sweep needs of a vertex."""

    begins: Bool[Array, ""]  # first vertex of its path
    ends: Bool[Array, ""]  # last vertex of its path
    gathered: Float[Array, "3"]  # Le + n
    weight: Float[Array, "3"]  # w
    slots: list[Slot]


def extend(
    scene: Scene,
    choice: Choice | None,
    now: path.Path,
    u: Bounce,
    options: Options,
    slots: differentiated.Slots,
    paths: differentiated.Paths,
    scale: Float[Array, "3"],
    number: Int[Array, ""],
) -> tuple[path.Path, Record, Bool[Array, ""]]:
    """Extend a path as `path.extend` does; return it, a Record, and whether that is the Record of the vertex itself.

    Each surface that the vertex's shadow ray passes has a Record of its own, before that of the vertex. The caller sets
    `begins`.

    Args:
        options: with `by_vertex`.
        scale: factor of the derivatives, beside the throughput.
        number: index of the Record among those of the vertex.
    """
    scene = differentiated.prepared(scene, paths, slots, number)
    hit, here, u = path.meet(scene, now, u, options)
    if slots.of_passed or slots.grids:
        now = now._replace(L=now.L._replace(nudged=none_passed(scene), dimmed=none_dimmed(scene, u.along)))
    of_bsdfs, of_lights, of_choices, of_passed, of_grids = slots.numbered()

    def varied(changes):
        changed = differentiated.nudged(scene, slots, changes)
        there = here
        if of_choices:
            change = jnp.dot(changes[of_choices.start : of_choices.stop], places.by_choices(slots, here))
            there = here._replace(weight=here.weight + change)
        on = path.onward(changed, choice, now, hit, there, u, options)
        return (on.L.emission, on.L.light, on.L.weight), on

    count = of_grids.stop
    push = partial(jax.jvp, varied, (jnp.zeros((count,), scale.dtype),), has_aux=True)
    tangents = basis(count, scale.dtype)
    (Le, n, w), changes, on = jax.vmap(lambda change: push((change,)), out_axes=(None, 0, None))(tangents)
    scale = scale * now.throughput
    dLe, dn, dw = changes
    w, dw = jnp.where(on.alive, w, 0), jnp.where(on.alive, dw, 0)
    found = []
    for s, k in enumerate(of_bsdfs if here is not None else ()):
        entries = places.of_bsdf(scene, paths, slots, s, here)
        found.append(Slot(*entries, scale * dn[k], scale * dw[k], slots.by_luminance and s >= slots.colors))
    for s, k in enumerate(of_lights):
        entries = places.of_hit(scene, paths, slots, s, now.ray, hit, here)
        found.append(Slot(*entries, scale * dLe[k], None))
        if choice is not None and here is not None:
            entries = places.of_light_sample(scene, choice, paths, slots, s, here, u)
            found.append(Slot(*entries, scale * dn[k], None))
    for s, k in enumerate(of_choices):
        entries = places.of_choice(scene, paths, slots, s, here)
        found.append(Slot(*entries, scale * dn[k], scale * dw[k], slots.by_luminance))
    end, shadow = smaller(hit.t, now.ray.t_max), on.L.dimmed
    on = on._replace(L=on.L._replace(dimmed=None))
    for nudge, k in zip(slots.grids, of_grids, strict=True):
        entries = places.of_grid(scene, paths, nudge, now.medium, now.ray, end, u, shadow)
        if nudge == "shadow":
            found.append(Slot(*entries, scale * dn[k], None))
        else:
            found.append(Slot(*entries, scale * (dLe[k] + dn[k]), scale * dw[k]))
    record = Record(jnp.bool_(False), ~on.alive, Le + n, w, found)
    if not of_passed:
        return on, record, jnp.bool_(True)

    # The Record of a passed surface has only the derivatives in that surface's own slots.
    passed, on = on.L.nudged, on._replace(L=on.L._replace(nudged=None))
    itself = number >= passed.count
    found = [jax.tree.map(lambda x: jnp.where(itself, x, 0).astype(x.dtype), slot) for slot in found]
    for s, k in enumerate(of_passed):
        entries = places.of_passed(scene, paths, slots, s, passed)
        found.append(Slot(*entries, jnp.where(itself, 0, scale * dn[k]), None, slots.by_luminance))
    gathered, weight = jnp.where(itself, record.gathered, 0), jnp.where(itself, record.weight, 1)
    return on, Record(record.begins, record.ends & itself, gathered, weight, found), itself
