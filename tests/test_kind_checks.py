"""`pathjax.testing`: kinds of the package pass its checks, and faults are found. (For bsdfs: tests/bsdfs.)"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from pathjax import emitters, testing
from pathjax.core.warp import SPHERE_PDF
from pathjax.emitters import Area, Constant, Directional, Point, Spot
from pathjax.kinds import Color
from pathjax.textures import Bitmap, Checkerboard

TEXELS = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32)


@pytest.mark.parametrize(
    "kind, values",
    [(Checkerboard, {}), (Bitmap, {"texels": TEXELS}), (Bitmap, {"texels": TEXELS[:1, :1], "wrap": "clamp"})],
)
def test_textures_of_the_package_pass(kind, values):
    testing.check_texture(kind, **values)


@pytest.mark.parametrize(
    "kind, values",
    [
        (Area, {}),
        (Constant, {}),
        (Point, {}),
        (Point, {"position": (0.3, -2, 1), "intensity": (1, 0, 2)}),
        (Spot, {}),
        (Spot, {"position": (0.3, -2, 1), "direction": (0, 0.6, -0.8), "cutoff_angle": 90, "beam_width": 90}),
        (Directional, {}),
        (Directional, {"direction": (0, 0.6, -0.8), "irradiance": 0}),
    ],
)
def test_emitters_of_the_package_pass(kind, values):
    testing.check_emitter(kind, **values)


class Brighter(Checkerboard):
    """Twice as bright as its `span` says."""

    @staticmethod
    def look_up(p, uv, surface):
        return 2 * Checkerboard.look_up(p, uv, surface)


class Pole(Checkerboard):
    """Not finite where v is 0 or below."""

    @staticmethod
    def look_up(p, uv, surface):
        return p.color0 * jnp.log(uv[1])


class Numb(Checkerboard):
    """Has no derivative in its colours."""

    @staticmethod
    def look_up(p, uv, surface):
        return lax.stop_gradient(Checkerboard.look_up(p, uv, surface))


@pytest.mark.parametrize(
    "kind, complaint", [(Brighter, "`span` says"), (Pole, "not finite"), (Numb, "derivative in color0")]
)
def test_a_fault_of_a_texture_is_found_and_named(kind, complaint):
    with pytest.raises(AssertionError, match=complaint):
        testing.check_texture(kind)


class Uneven(Constant):
    """Samples the upper half only, but claims to sample all directions."""

    @staticmethod
    def sample(p, u, u_part):
        d = Constant.sample(p, u, u_part)
        return jnp.stack([d[0], d[1], jnp.abs(d[2])])


class HalfSeen(emitters.Background):
    """Emits in all directions, but never samples the lower half."""

    radiance = Color(1.0, textured=False, radiance=True)
    power, emitted = Constant.power, Constant.emitted

    @staticmethod
    def sample(p, u, u_part):
        return Uneven.sample(p, u, u_part)

    @staticmethod
    def density(p, d):
        return jnp.where(d[2] > 0, 2 * SPHERE_PDF, 0)


class Negative(Area):
    """Emits negative radiance on one side."""

    @staticmethod
    def emitted(p, d):
        return p.radiance * d[0]


@pytest.mark.parametrize(
    "kind, complaint", [(Uneven, "do not follow"), (HalfSeen, "never drawn"), (Negative, "`emitted` is -")]
)
def test_a_fault_of_an_emitter_is_found_and_named(kind, complaint):
    with pytest.raises(AssertionError, match=complaint):
        testing.check_emitter(kind, samples=20_000)
