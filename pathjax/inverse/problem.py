"""The problem of a fit: views, targets and parameters, checked before anything is rendered, stacked for the kernel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.compile import on_all_devices, register_dataclass
from pathjax.errors import InputError
from pathjax.images.metrics import ROUNDING
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.inverse.target import Target
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.scene.metadata import Names
from pathjax.scene.scene import Scene
from pathjax.sensors import film

# Up to this many scalars are fitted by their Jacobian.
MOST_COLUMNS = 300


@register_dataclass
@dataclass(frozen=True)
class Views:
    """Views of one structure, stacked where they differ."""

    scene: Scene
    targets: jax.Array  # (V, H, W, 3), exposed
    exposure: jax.Array  # () factor of renders
    names: tuple[str, ...] = field(metadata={"static": True})  # fitted parameters that these views hold
    axes: tuple[int | None, ...] = field(metadata={"static": True})  # per leaf of the scene: 0 where stacked
    numbers: tuple[int, ...] = field(metadata={"static": True})  # index of each view in the caller's list

    def map(self, f, seeds):
        """Return f(scene, seed) for one view after the other, by one kernel; seeds: (V,) uint32."""
        leaves, tree = jax.tree.flatten(self.scene)

        def one(varying, seed):
            rest = iter(varying)
            merged = [leaf if axis is None else next(rest) for leaf, axis in zip(leaves, self.axes, strict=True)]
            return f(jax.tree.unflatten(tree, merged), seed)

        stacked = [leaf for leaf, axis in zip(leaves, self.axes, strict=True) if axis == 0]
        return lax.map(lambda each: one(*each), (stacked, seeds))

    def seeds(self, seed, draw, half: int):
        """Return seeds (V,) uint32 for one of two independent halves, different for every draw.

        Their upper bit keeps them apart from any seed that a user can give.
        """
        mixed = (seed * jnp.uint32(4099) + 2 * draw + half) * jnp.uint32(2053) + jnp.asarray(self.numbers, jnp.uint32)
        return mixed | jnp.uint32(1 << 31)

    @property
    def wanted(self) -> dict[str, Parameter]:
        """The fitted parameters that these views hold."""
        return {name: named.find(self.scene, name) for name in self.names}

    def placed(self, values) -> Views:
        """Return the views with the values of textures in their arrays, for `with_values`.

        A kernel that did this itself would copy the texels of all textures of the scene on each run.
        """
        scene, axes = self.scene, jax.tree.unflatten(jax.tree.structure(self.scene), self.axes)
        for name, parameter in self.wanted.items():
            if parameter.is_texture:
                stacked = named.get(axes, parameter.path) == 0
                array = _put(named.get(scene, parameter.path), values[name], parameter, stacked)
                scene = named.put(scene, parameter.path, array)
        return replace(self, scene=scene)

    def everywhere(self) -> Views:
        """Return the views with replicated arrays, which kernels on all devices would else copy on each run."""
        return replace(self, scene=on_all_devices(self.scene))

    def with_values(self, scene: Scene, values) -> Scene:
        """Return a scene of `map` with the values of parameters; those of textures must be `placed` already."""
        textures = {name: values[name] for name, parameter in self.wanted.items() if parameter.is_texture}
        scene = named.with_parameters(scene, {name: values[name] for name in self.names if name not in textures})
        known = {name: lax.stop_gradient(value) for name, value in textures.items()}
        scene = named.with_values(scene, known, self.wanted, placed=True)
        return replace(scene, varied=scene.varied | textures)


@partial(jax.jit, static_argnums=(2, 3))
def _put(array, value, parameter: Parameter, stacked: bool):
    """Return the array that holds a texture, or those of all views stacked, with a new value of the texture."""
    put = partial(parameter.put, value=value)
    return jax.vmap(put)(array) if stacked else put(array)


@dataclass(frozen=True)
class Problem:
    scenes: list[Scene]
    targets: list[Target]  # exposed, all fields but the ceiling (H, W, 3); the image is 0 where it is not measured
    exposure: float  # a power of 2 that brings the targets to a level near 1: squares of radiances may leave float32
    rounding: float  # rounding error of a pixel's mean at that level, to which scenes without noise are fitted
    groups: list[Views]
    vector: ParameterVector
    start: np.ndarray  # (n,) values

    @property
    def reach(self) -> int:
        """How far the noise of targets may be correlated, in pixels, assuming the film of the fitted scenes."""
        return max(each.film.reach if each.film.shared else 0 for each in self.scenes)

    @property
    def side(self) -> int:
        """Side of the squares of pixels that are taken to have independent noise."""
        return 2 * self.reach + 1 if self.reach else 1

    @property
    def alike(self) -> float:
        """Sum of squared correlations of a pixel's noise with that of the pixels around it, and its own."""
        return max(float((film.correlation(each.film) ** 2).sum()) for each in self.scenes)

    @staticmethod
    def with_values(scene: Scene, values) -> Scene:
        """Return the scene with those of the values by name that it holds."""
        return named.with_parameters(scene, {name: v for name, v in values.items() if name in scene.about.parameters})

    def by_view(self, flat: np.ndarray) -> list[np.ndarray]:
        """Return arrays (H, W, 3) per view, in the caller's order, from (N, 3) of all groups one after another."""
        images, first = {}, 0
        for views in self.groups:
            stack = flat[first : first + views.targets.size // 3].reshape(views.targets.shape)
            images.update(zip(views.numbers, stack, strict=True))
            first += views.targets.size // 3
        return [images[number] for number in range(len(images))]

    def flat(self, by_view: list[np.ndarray]) -> np.ndarray:
        """The inverse of `by_view`."""
        return np.concatenate([by_view[number].reshape(-1, 3) for views in self.groups for number in views.numbers])


def build(scene, target, names, start) -> Problem:
    """Check and stack the views and targets; arguments and errors are those of `fit`."""
    scenes = [scene] if isinstance(scene, Scene) else list(scene)
    targets = [target] if isinstance(scene, Scene) else list(target)
    if isinstance(names, str):
        raise InputError(f"names is a list of names; write [{names!r}]")
    names = list(names)
    if not scenes or not names:
        raise InputError(f"nothing to fit: give at least one {'parameter by name' if scenes else 'scene'}")
    if len(scenes) != len(targets):
        raise InputError(f"{len(scenes)} scenes and {len(targets)} targets; give one target for each scene")
    if len(set(names)) < len(names):
        raise InputError(f"{next(n for n in names if names.count(n) > 1)} is named twice")
    values, found = {}, {}
    for name in names:
        holder = next((s for s in scenes if name in s.described.parameters), scenes[0])
        found[name] = named.find(holder, name)
        values[name] = named.parameters(holder)[name]
    for name, value in start.items():
        if name not in found:
            raise InputError(f"start names {name}, which is not fitted; fitted are {', '.join(names)}")
        dtype = scenes[0].camera.origin.dtype
        values[name] = named.checked(f"start of {name}", value, found[name], dtype)
    for each in scenes:
        held = {name: parameter for name, parameter in found.items() if name in each.described.parameters}
        named.refuse_constant(Problem.with_values(each, values), held)
    targets = [_target(s, t, i, len(scenes)) for i, (s, t) in enumerate(zip(scenes, targets, strict=True))]
    vector = ParameterVector(tuple(found.items()))
    pixels = sum(int(t.usable.any(-1).sum()) for t in targets)
    if not pixels:
        raise InputError("every pixel of the target is clipped or left out; give one that is exposed for the scene")
    if pixels < vector.count and not is_large(vector):
        raise InputError(f"{pixels} pixels cannot determine {vector.count} numbers; give larger targets or more views")
    level = np.concatenate([target.image[target.usable] for target in targets]).mean()
    exposure = float(np.exp2(-np.floor(np.log2(level)))) if level > 0 else 1.0
    targets = [
        replace(t, image=t.image * exposure, step=t.step * exposure, ceiling=t.ceiling * exposure) for t in targets
    ]
    rounding = ROUNDING * max(level * exposure, np.finfo(np.float32).tiny ** 0.25)  # its square must not underflow
    # Pixels that share samples would not be independent, as the uncertainty of a fit assumes.
    own = [replace(each, film=film.with_own_samples(each.film)) for each in scenes]
    groups = _groups(own, targets, exposure, names)
    return Problem(scenes, targets, exposure, rounding, groups, vector, vector.pack(values))


def is_large(vector: ParameterVector) -> bool:
    """Return whether there is a texture, or more scalars than a Jacobian should have columns."""
    return vector.count > MOST_COLUMNS or any(p.is_texture for _, p in vector.parameters)


def _target(scene, target, number, count) -> Target:
    which = "the target" if count == 1 else f"target {number}"
    target = target if isinstance(target, Target) else Target(target)
    image, wanted = np.minimum(np.asarray(target.image, np.float64), target.ceiling), (*film.image_shape(scene.film), 3)
    if image.shape != wanted:
        raise InputError(f"{which} has the shape {image.shape}; its scene renders {wanted}")
    try:
        step = np.broadcast_to(np.asarray(target.step, np.float64), wanted)
        measured = np.broadcast_to(np.asarray(target.measured, bool), wanted)
    except ValueError:
        raise InputError(f"{which}: step and measured must be one for all, or of the shape {wanted}") from None
    if not target.ceiling > 0 or not (np.isfinite(step) & (step >= 0))[measured].all():
        raise InputError(f"{which}: its ceiling must be above 0, and its steps finite and not negative")
    lost = measured & ~np.isfinite(image)
    if lost.any():
        raise InputError(
            f"{which} holds {int(lost.sum())} values that are not finite; correct it, or leave them out by "
            "Target(image, measured=...)"
        )
    negative = int((image[measured] < 0).sum())
    if negative:
        raise InputError(f"{which} holds {negative} negative values; it must be linear radiance")
    return Target(np.where(measured, image, 0), np.where(measured, step, 0), target.ceiling, measured)


def _groups(scenes, targets, exposure, names) -> list[Views]:
    groups: dict = {}
    for number, scene in enumerate(scenes):
        leaves, tree = jax.tree.flatten(named.nameless(scene))
        held = Names(tuple((name, scene.about.parameters[name]) for name in names if name in scene.about.parameters))
        key = tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), held
        groups.setdefault(key, []).append((number, leaves))
    views = []
    for (_, _, held), members in groups.items():
        numbers, leaves = zip(*members, strict=True)
        stacked, axes = [], []
        for same in zip(*leaves, strict=True):
            equal = all(x is same[0] or np.array_equal(x, same[0], equal_nan=True) for x in map(np.asarray, same))
            stacked.append(same[0] if equal else jnp.stack(same))
            axes.append(None if equal else 0)
        first = scenes[numbers[0]]
        # With only these names, a scene that is loaded again has the same structure, and its fit the same programs.
        structure = jax.tree.structure(replace(first, about=held))
        scene = jax.tree.unflatten(structure, stacked)
        dtype = first.camera.origin.dtype
        here = jnp.asarray(np.stack([targets[i].image for i in numbers]), dtype)
        views.append(Views(scene, here, jnp.asarray(exposure, dtype), tuple(held.parameters), tuple(axes), numbers))
    return views
