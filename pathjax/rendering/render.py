"""Render a scene to an image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
from jaxtyping import Array, Float

from pathjax import emitters
from pathjax.compile import on_all_devices, standard_promotion
from pathjax.core.types import Number
from pathjax.derivatives import matrix_free
from pathjax.derivatives.backward import longest_ring
from pathjax.derivatives.jacobian import pixel_jacobians
from pathjax.derivatives.rules import estimate
from pathjax.errors import InputError
from pathjax.integrators import pixel
from pathjax.integrators.options import DEFAULTS, Options
from pathjax.integrators.reconstruction import map_pixels
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.scene import Scene
from pathjax.sensors import film

# Derivatives in at most this many colours at once can be differentiated again; each costs a tangent of the kernel.
MOST_TWICE = 8


@agreed_by_all
@standard_promotion
def render(
    scene: Scene,
    spp: Number = 64,
    seed: Number = 0,
    strategy: str = "mis",
    *,
    fresnel: str = "exact",
    split_depth: int = 0,
    sampler: str = "lattice",
    control: object = None,
) -> Float[Array, "height width 3"]:
    """Render a scene: linear RGB, unbiased up to the scene's max_depth (except with `fresnel="schlick"`).

    With a filter wider than a pixel, samples count in all pixels under it, and images are ratios of sums
    (`integrators.reconstruction`): their bias is O(1/spp) of the variation of light within a pixel.

    Pure. It may be called inside `jax.jit`, under `jax.vmap` over scenes that differ in parameters or cameras, and be
    differentiated in the entries of `parameters`, forwards or backwards. The derivative is that of `jacobian`, whose
    documentation states its limits. A kernel is compiled once for each scene structure, image size and set of the
    options below; other parameters, cameras, spp and seeds reuse it. A non-finite sample makes the pixels non-finite in
    which it counts, and does not affect the others.

    Args:
        spp: samples per pixel, at least 1.
        seed: other seeds give independent images; the same seed gives the same image, bit for bit, on any number of
            CPU devices.
        strategy: "mis", or "light" or "bsdf" for experiments. "bsdf" is refused where it misses the light of emitters
            that no ray meets.
        fresnel: reflectance of dielectrics, "exact", or "schlick", whose approximation biases the image. This and the
            following options are for experiments; the defaults compile nothing of them.
        split_depth: number of dielectrics, counted along a path, at which both branches are followed instead of a
            random one; 0 to 8. A sample may then be 2^split_depth paths.
        sampler: random numbers: "lattice"; "independent"; or "subpixel": independent, but with a quarter of the samples
            in each of 2 x 2 strata of the pixel's filter; spp is then a multiple of 4.
        control: a `transport.Control`, built by `Operator.control`. Paths end in its light instead of in darkness. The
            mean is the same whatever its light. It seldom pays off: see `pathjax help transport`.
    Raises:
        InputError: an option is unknown or refused, or spp, seed or split_depth is out of range; differentiation in
            anything other than named parameters, or with a sampler, split_depth or control other than the default.
    """
    shared = scene.film.shared
    options = Options(strategy, fresnel, split_depth, sampler, controlled=control is not None, shared=shared)
    options.check_counts(spp, seed)
    options.check_strategy(scene)
    if control is not None:
        _check_control(control, scene)
    shape = film.image_shape(scene.film)
    return render_pixels(scene, film.pixels(scene.film), 0, spp, seed, options, control, shape=shape)


def _check_control(control, scene: Scene) -> None:
    from pathjax.transport import Control  # imports lineax, a quarter of a second

    if not isinstance(control, Control):
        raise InputError(
            f"control = {control!r}; give a transport.Control: op = transport.operator(scene); "
            "control = op.control(op.solve().L)"
        )
    control.check(scene)


@standard_promotion
def render_pixels(
    scene: Scene, pixels, first_sample, spp, seed, options: Options = DEFAULTS, control=None, shape=None, **how
):
    """Return the means (N, 3) over the samples first_sample, ..., first_sample + spp - 1 of pixels (N,) int32.

    Args:
        first_sample, spp, seed: each a scalar, or (N,), one per pixel.
        control: as for `render`, if `options.controlled`.
        shape: (height, width) of the image of the pixels; the means are then (height, width, 3).
        how: `form` and `devices` of `native_map`.
    """
    numbers = pixel.numbers(pixels, first_sample, spp, seed)
    scene = on_all_devices(scene, how.get("devices"))
    means = _PixelMeans(options, tuple(how.items()), longest_ring(scene), shape or pixels.shape)
    return estimate(means, scene, control, pixels, *numbers)


@dataclass(frozen=True)
class _PixelMeans:
    options: Options
    how: tuple[tuple[str, object], ...]
    ring: int  # `backward.longest_ring`, computed here because the scene is traced within `estimate`
    shape: tuple[int, ...]  # of the pixels in the value

    def value(self, scene, control, pixels, *numbers):
        how = dict(self.how, shape=self.shape)
        return pixel_means(scene, pixels, *numbers, control, options=self.options, **how)

    def jacobian(self, scene, wanted, control, pixels, *numbers):
        self.options.check_differentiable()
        how = dict(self.how, ring=self.ring)
        image, derivatives, *_ = pixel_jacobians(scene, wanted, pixels, *numbers, self.options, **how)
        return self._shaped(image), {name: self._shaped(derivatives[name]) for name in wanted}

    def matrix_free(self, scene, wanted):
        # Textures always, colours if there are many.
        swept = {name for name, parameter in wanted.items() if matrix_free.is_swept(scene, parameter)}
        textures = {name for name, parameter in wanted.items() if parameter.is_texture}
        return swept if len(swept) > MOST_TWICE else textures

    def push(self, scene, wanted, changes, control, pixels, *numbers):
        self.options.check_differentiable()
        work = pixels, *numbers, self.options
        return self._shaped(matrix_free.push(scene, wanted, changes, *work, **dict(self.how)))

    def pull(self, scene, wanted, adjoint, control, pixels, *numbers):
        self.options.check_differentiable()
        work = pixels, *numbers, self.options, self.ring
        return matrix_free.pull(scene, wanted, adjoint.reshape(-1, 3), *work, **dict(self.how))

    def _shaped(self, values):
        """Reshape (N, ...) to (*shape, ...)."""
        return values.reshape(*self.shape, *values.shape[1:])


@partial(jax.jit, static_argnames=("options", "form", "devices", "shape"))
def pixel_means(
    scene, pixels, first_sample, spp, seed, control=None, *, options: Options, form=None, devices=None, shape=None
):
    """Do `render_pixels` without derivatives; the same arguments, but first_sample, spp and seed are (N,) uint32."""
    scene = options.applied(scene)
    choice = emitters.choice(scene.emitters, options.strategy)
    work = pixels, first_sample, spp, seed
    of_pixel = partial(pixel.mean, options=options)
    means = map_pixels(of_pixel, work, scene, choice, control, options=options, form=form, devices=devices)
    return means if shape is None else means.reshape(*shape, 3)
