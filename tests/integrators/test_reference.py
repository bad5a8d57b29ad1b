"""The path tracer of `render` against the textbook's: samples are the same if they draw the same random numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.compile import on_all_devices
from pathjax.integrators import pixel, reference
from pathjax.integrators.options import DEFAULTS
from pathjax.rendering.render import pixel_means
from pathjax.scene.parameters import nameless
from pathjax.sensors import film

ROOT = Path(__file__).resolve().parents[2]
NAMES = sorted(path.stem for path in (*ROOT.glob("scenes/*.xml"), *ROOT.glob("tests/scenes/*.xml")))
QUICK = ("cornell_box", "glass_and_mirror")
SPP, SEED = 4, 7
# Rounding error of a sample after some ten vertices, relative to it or to the mean of the image; and the fraction of
# samples that rounding may send another way, at an edge or in roulette. A wrong term changes nearly all samples.
ROUNDING, ASTRAY = {jnp.float32: 1e-3, jnp.float64: 1e-9}, {jnp.float32: 5e-3, jnp.float64: 0}


def rendered(scene):
    """Return (SPP, H, W, 3) samples of `path`, one by one, by the kernel of `render`, which other tests compile too."""
    pixels, how = film.pixels(scene.film), {"options": DEFAULTS, "shape": film.image_shape(scene.film)}
    numbers = (pixel.numbers(pixels, sample, 1, SEED) for sample in range(SPP))
    return np.stack([pixel_means(on_all_devices(scene), pixels, *each, None, **how) for each in numbers])


def assert_same_samples(scene, dtype):
    scene = replace(nameless(scene), hide_emitters=False)  # the textbook's tracer does not hide them
    fast, plain = rendered(scene), np.asarray(reference.samples(scene, SPP, SEED))
    assert fast.dtype == plain.dtype == dtype
    assert plain.mean() > 0
    near = np.isclose(fast, plain, rtol=ROUNDING[dtype], atol=ROUNDING[dtype] * plain.mean()).all(-1)
    assert 1 - near.mean() <= ASTRAY[dtype]


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in NAMES])
def test_samples_are_those_of_the_textbook(shipped, name):
    assert_same_samples(shipped(name, res=16), jnp.float32)


@pytest.mark.parametrize("name", ["cornell_box", pytest.param("glass_and_mirror", marks=pytest.mark.slow)])
def test_in_float64_no_sample_goes_astray(shipped, x64, name):
    with x64():
        assert_same_samples(shipped(name, jnp.float64, res=16), jnp.float64)


@pytest.mark.parametrize("name", ["cornell_box", pytest.param("glass_and_mirror", marks=pytest.mark.slow)])
def test_images_of_other_random_numbers_agree(shipped, estimate, estimate_type, agree, name):
    """With the false-alarm rate of `agree`, 1e-4."""
    scene = shipped(name, res=16)
    images = np.stack([np.asarray(reference.samples(nameless(scene), SPP, seed)).mean(0) for seed in range(101, 229)])
    plain = estimate_type(images.mean(0), images.var(0, ddof=1) / len(images), len(images))
    agree(estimate(scene, spp=64), plain)
