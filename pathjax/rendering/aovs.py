"""Arbitrary output variables of the camera's first hit, for denoisers and compositing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import numpy as np

from pathjax.compile import on_all_devices, standard_promotion
from pathjax.errors import InputError
from pathjax.integrators import aov, pixel
from pathjax.integrators.options import DEFAULTS, Options, check_counts
from pathjax.integrators.reconstruction import map_pixels
from pathjax.rendering.progressive import replicates
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.parameters import nameless
from pathjax.scene.scene import Scene
from pathjax.sensors import film

NAMES = aov.FirstHit._fields
MAX_SPP = 16
# Pixels in one call of the kernel, which bounds its memory.
CHUNK_PIXELS = 1 << 14


@agreed_by_all
@standard_promotion
def render_aovs(scene: Scene, names: Sequence[str], spp: int = MAX_SPP, seed: int = 0) -> dict[str, np.ndarray]:
    """Return images of the camera's first hit, as Mitsuba's `aov` integrator does.

    Each is the mean over the film positions of the first min(spp, 16) samples of `render_until` with this seed, through
    the film's filter.

    Args:
        names: "depth" (1 channel), the distance along the ray from the near clip plane; "normal" (3), the shading
            normal in world space; "albedo" (3), the share of light that a reflector scatters, including textures and
            Fresnel terms, and 1 for glass and where light passes straight on.
        spp: samples per pixel, of which at most 16 are used.
        seed: as for `render_until`.
    Returns:
        name -> (H, W, channels) float32; 0 for misses.
    Raises:
        InputError: a name is unknown or repeated; spp or seed is out of range.
    """
    check_names(names, NAMES)
    check_counts(spp, seed)
    spp = min(spp, MAX_SPP)
    shares = replicates.shares(np.array([spp], np.int32))
    count, seeds = film.pixel_count(scene.film), replicates.seeds(seed)
    options = Options(shared=scene.film.shared)
    sampled = film.pixel_count(film.of_samples(scene.film))
    chunk = sampled if options.shared else min(CHUNK_PIXELS, count)
    images = [np.empty((count, width), np.float32) for width in (1, 3, 3)]
    seen = on_all_devices(nameless(scene))
    for first in range(0, count, chunk):
        # The last call repeats the last pixel up to full length.
        pixels = np.minimum(np.arange(first, first + chunk, dtype=np.int32), sampled - 1)
        tiled = np.tile(pixels, replicates.COUNT)
        numbers = pixel.numbers(tiled, 0, *(np.repeat(x, chunk) for x in (np.maximum(shares, 1), seeds)))
        for image, means in zip(images, _render_aovs(seen, tiled, *numbers, options=options), strict=True):
            means = np.asarray(means, np.float32).reshape(replicates.COUNT, -1, image.shape[1])
            mean = (means * (shares / np.float32(spp))[..., None]).sum(0, dtype=np.float32)
            image[first : first + chunk] = mean[: count - first]
    height, width = film.image_shape(scene.film)
    return {name: dict(zip(NAMES, images, strict=True))[name].reshape(height, width, -1) for name in names}


def check_names(names: Sequence[str], known: Sequence[str]) -> None:
    """Refuse names that are not a list, and unknown or repeated names."""
    if isinstance(names, str):
        raise InputError(f"names is a list of output variables; write [{names!r}]")
    for i, name in enumerate(names):
        if name not in known:
            raise InputError(f"no output variable is named {name!r}; known are {', '.join(known)}")
        if name in names[:i]:
            raise InputError(f"output variable {name} is named twice; name it once")


@partial(jax.jit, static_argnames=("options", "form", "devices"))
def _render_aovs(scene, pixels, first_sample, spp, seed, *, options=DEFAULTS, form=None, devices=None):
    work = pixels, first_sample, spp, seed
    return map_pixels(aov.mean, work, scene, options=options, form=form, devices=devices)
