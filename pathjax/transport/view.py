"""Look up light on patches: at a surface point, and through the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.compile import native_map, register_dataclass, standard_promotion
from pathjax.core import sampler
from pathjax.core.math import at, dot
from pathjax.errors import InputError
from pathjax.integrators import reconstruction
from pathjax.integrators.options import check_counts
from pathjax.integrators.pixel import camera_ray
from pathjax.scene.parameters import nameless
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.shapes import geometry
from pathjax.shapes.geometry import Geometry
from pathjax.transport.patches import Patches, patch_at, refuse_media


@register_dataclass
@dataclass(frozen=True)
class Radiosity:
    """Light on the patches of a scene, for look-ups within kernels; pass it to them whole, like the scene."""

    patches: Patches
    L: jax.Array  # (U + 1, 3) radiance that leaves each patch; the last row, black, is for points of no patch


@standard_promotion
def radiosity(patches: Patches, L) -> Radiosity:
    """Return light L (U, 3) on the patches as a Radiosity, for look-ups."""
    return Radiosity(patches, jnp.concatenate([L, jnp.zeros_like(L[:1])]))


def radiance(light: Radiosity, shapes: Geometry, primitive, p, back):
    """Look up the radiance (3,) that leaves a surface point, including emission; for code of one ray.

    Args:
        shapes: geometry of the scene that was divided into patches, or of one with other colours.
        primitive: () int32, of a hit.
        p: (3,) the point of `geometry.surface`.
        back: () bool, seen from the side that the geometric normal points away from: dot(surface.n, ray.d) > 0.
    """
    return at(light.L, patch_at(light.patches, shapes, primitive, p, back))


@standard_promotion
def image(scene: Scene, light: Radiosity, spp: int = 16, seed: int = 0) -> jax.Array:
    """Render the light on patches through the camera: (H, W, 3).

    Camera rays are those of `pathjax.render` with the same spp and seed, so the two images share the noise of film
    sampling; nothing else is random. Linear in `light.L`, and differentiable in it.

    Raises:
        InputError: spp or seed out of range; a scene that hides its emitters, or has media.
    """
    check_counts(spp, seed)
    refuse_media(scene)
    if scene.hide_emitters:
        raise InputError(
            "this scene hides its emitters from the camera, and patches show them; load it with hide_emitters false"
        )
    pixels, shape = film.pixels(scene.film), (*film.image_shape(scene.film), 3)
    if scene.film.shared:
        return _shared(nameless(scene), light, pixels, jnp.uint32(seed), spp=spp).reshape(shape)
    total = jnp.zeros((len(pixels), 3), light.L.dtype)
    for number in range(spp):
        total = _with_sample(total, nameless(scene), light, pixels, jnp.uint32(number), jnp.uint32(seed))
    return (total / spp).reshape(shape)


@partial(jax.jit, static_argnames="spp")
def _shared(scene, light, pixels, seed, *, spp):
    """Render the image through a filter under which pixels share their samples."""
    sampled = replace(scene, film=film.of_samples(scene.film))
    numbers = jnp.broadcast_to(jnp.arange(spp, dtype=jnp.uint32)[:, None], (spp, len(pixels)))
    seen = [_seen(sampled, light.patches, pixels, numbers[number, 0], seed)[0] for number in range(spp)]
    u = reconstruction.film_numbers(sampled, pixels, numbers, seed)
    return reconstruction.image_of_samples(scene.film, u, light.L[jnp.stack(seen)])


@jax.jit
def _with_sample(total, scene, light, pixels, number, seed):
    patch, weight = _seen(scene, light.patches, pixels, number, seed)
    return total + weight[:, None] * light.L[patch]


@jax.jit
def _seen(scene, patches, pixels, number, seed):
    return native_map(_one, pixels, scene, patches, number, seed)


def _one(pixel, scene, patches, number, seed):
    """Return the patch that the ray of a sample meets, and the sample's weight."""
    ray, weight = camera_ray(scene, pixel, sampler.pixel_stream(seed, pixel), number)
    hit = geometry.closest_hit(scene.geometry, ray)
    surface = geometry.surface(scene.geometry, ray, hit)
    primitive = jnp.maximum(hit.primitive, 0)
    patch = patch_at(patches, scene.geometry, primitive, surface.p, dot(surface.n, ray.d) > 0)
    return jnp.where(hit.primitive >= 0, patch, patches.count), lax.stop_gradient(weight)
