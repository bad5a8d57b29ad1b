"""Arbitrary output variables: what the camera sees first, for denoisers and for compositing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from pathjax import film, replicates
from pathjax.errors import InputError
from pathjax.integrators import aov, path, pixel
from pathjax.runtime import native_map
from pathjax.scene import Scene

NAMES = aov.FirstHit._fields
MAX_SPP = 16


def render_aovs(scene: Scene, names: Sequence[str], spp: int = MAX_SPP, seed: int = 0) -> dict[str, np.ndarray]:
    """Name -> (H, W, channels) float32, as Mitsuba's `aov` integrator has it; 0 where nothing is seen.

    "depth" (1 channel) is the distance along the ray from the near clip plane, "normal" (3) the shading normal in world
    space, "albedo" (3) the share of light that a reflector sends back, textures and Fresnel's terms included, and 1 for
    glass. Means over the film positions of the first min(spp, 16) samples that `render_until` takes for this seed.

    Raises:
        InputError: unknown or repeated name, spp or seed out of range.
    """
    check_names(names, NAMES)
    path.check_sampling("mis", spp, seed)
    count = np.full(film.pixel_count(scene.film), min(spp, MAX_SPP), np.int32)
    shares = replicates.shares(count)
    pixels = np.arange(len(count), dtype=np.int32)
    kernel_scene, total = replace(scene, about=None), None
    for replicate_seed, share in zip(replicates.seeds(seed), shares, strict=True):
        if not share.any():
            continue
        means = _render_aovs(kernel_scene, pixels, *pixel.numbers(pixels, 0, share, replicate_seed))
        weighted = [np.asarray(x, np.float32) * (share / count).astype(np.float32)[:, None] for x in means]
        total = weighted if total is None else [a + b for a, b in zip(total, weighted, strict=True)]
    height, width = film.image_shape(scene.film)
    images = dict(zip(NAMES, total, strict=True))
    return {name: images[name].reshape(height, width, -1) for name in names}


def check_names(names: Sequence[str], known: Sequence[str]) -> None:
    """Refuse what is not known, and what is named twice."""
    for i, name in enumerate(names):
        if name not in known:
            raise InputError(f"no output variable is named {name!r}; known are {', '.join(known)}")
        if name in names[:i]:
            raise InputError(f"output variable {name} is named twice; name it once")


@partial(jax.jit, static_argnames=("form", "devices"))
def _render_aovs(scene, pixels, first_sample, spp, seed, *, form=None, devices=None):
    return native_map(aov.mean, (pixels, first_sample, spp, seed), scene, form=form, devices=devices)
