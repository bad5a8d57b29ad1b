"""The form for accelerators agrees with lanes up to rounding: images, J, J v, J^T v, output variables, ray queries."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pathjax.derivatives import matrix_free
from pathjax.derivatives.jacobian import pixel_jacobians
from pathjax.integrators.options import Options
from pathjax.rendering.aovs import _render_aovs
from pathjax.rendering.query import _any_hit, _closest_hit
from pathjax.rendering.render import render_pixels
from pathjax.scene import parameters as named

SPP, SEED = 4, 3


def image(scene, names, **how):
    return render_pixels(scene, pixels_of(scene), 0, SPP, SEED, **how)


def jacobian(scene, names, **how):
    scene, wanted = attached(scene, names)
    image, slopes, *others = pixel_jacobians(scene, wanted, pixels_of(scene), 0, SPP, SEED, Options(), **how)
    return image, [slopes[name] for name in names], others


def forwards(scene, names, **how):
    scene, wanted = attached(scene, names)
    changes = {name: jnp.full(parameter.shape, 0.3) for name, parameter in wanted.items()}
    return matrix_free.push(scene, wanted, changes, pixels_of(scene), 0, SPP, SEED, Options(), **how)


def backwards(scene, names, **how):
    scene, wanted = attached(scene, names)
    pixels = pixels_of(scene)
    adjoint = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (len(pixels), 3)), jnp.float32)
    return matrix_free.pull(scene, wanted, adjoint, pixels, 0, SPP, SEED, Options(), **how)


def first_hits(scene, names, **how):
    pixels = pixels_of(scene)
    numbers = (jnp.full(len(pixels), x, jnp.uint32) for x in (0, SPP, SEED))
    return _render_aovs(named.nameless(scene), pixels, *numbers, **how)


def rays(scene, names, **how):
    random = np.random.default_rng(1)
    o, d = (jnp.asarray(random.uniform(-1, 1, (500, 3)), jnp.float32) for _ in range(2))
    hit = _closest_hit(scene.geometry, o, d, **how)
    return hit.t, hit.primitive, _any_hit(scene.geometry, o, d, jnp.full(500, 0.7), **how)


def attached(scene, names):
    wanted = {name: named.find(scene, name) for name in names}
    return named.nameless(named.attached(scene)), wanted


def pixels_of(scene):
    return jnp.arange(64, dtype=jnp.int32)


COLORS = ["white.reflectance", "light.radiance"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kernel", "name", "names"),
    [
        (image, "cornell_box", []),
        (image, "mesh", []),
        (image, "media", []),
        (jacobian, "cornell_box", COLORS),
        (jacobian, "cornell_box", [*COLORS, "red.reflectance"]),
        (jacobian, "textures", ["plain.reflectance"]),
        (jacobian, "glass_ball", ["glass.int_ior"]),
        (forwards, "cornell_box", COLORS),
        (backwards, "cornell_box", COLORS),
        (backwards, "textures", ["plain.reflectance"]),
        (first_hits, "cornell_box", []),
        (rays, "mesh", []),
    ],
)
def test_the_form_for_accelerators_gives_what_lanes_give(shipped, kernel, name, names):
    scene = shipped(name, res=8)
    lanes, vmap = (
        jax.tree.leaves(jax.jit(partial(kernel, names=tuple(names), form=form, devices=1))(scene))
        for form in ("lanes", "vmap")
    )
    assert lanes and any(np.any(x) for x in lanes)
    for a, b in zip(lanes, vmap, strict=True):
        # Rounding sends single paths another way, which changes a pixel or two.
        scale = np.abs(np.asarray(a, float)).max()
        differs = ~np.isclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-3, atol=1e-4 * scale)
        assert differs.mean() < 0.02, (differs.mean(), scale)
