"""Normal equations of least squares, summed over all pixels without storing the Jacobian of the image.

With residuals r = image - target and weights W of the pixels' channels, two independent renders A and B give

    loss = r_A' W r_B / 2,    gradient = (J_A' W r_B + J_B' W r_A) / 2,    matrix = (J_A' W J_B + J_B' W J_A) / 2,

whose means are those of a noise-free image and Jacobian. Pixels are processed in chunks: the kernel makes the rows of J
of a chunk, which are multiplied and summed at once. Light keeps its channel on the way, so a row of J in one channel
depends on the same channel of colours only: it has one entry for each colour, and one for each scalar.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from pathjax.compile import register_dataclass, standard_promotion, sum_of_parts
from pathjax.compile.mapping import ITEMS_OF_A_PART, MOST_BYTES
from pathjax.derivatives.jacobian import pixel_jacobians
from pathjax.errors import InputError
from pathjax.integrators.options import Counts, Options, check_counts
from pathjax.inverse import problem
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.inverse.problem import Views
from pathjax.inverse.target import Target
from pathjax.scene import parameters as named
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.scene import Scene
from pathjax.system import memory

# Groups of pixels over which the matrix is summed; their differences give its noise to 13 %.
GROUPS = 32
# Most blocks whose sums are taken to be independent; more are merged, far apart ones. They give the scatter to 2 %.
MOST_BLOCKS = 4096
# Bytes of the rows of J of one chunk.
CHUNK_BYTES = 1 << 25
# Parts of a sum that are dealt to devices: enough to share the work evenly among many devices.
LEAST_PARTS, MOST_PARTS = 64, 1024


@register_dataclass
@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of P scalars at their present values.

    Attributes:
        matrix: (P, P) Gauss-Newton matrix; unbiased, so it may be indefinite.
        gradient: (P,) of the loss.
        loss: (), half the weighted squared misfit; unbiased, so it may be negative.
        scatter: (P, P) covariance of the gradient, from its scatter over pixels.
        matrices: (G, P, P) of random groups of pixels; their sum is `matrix`, and their scatter gives its noise.
        residuals: (2, N, 3) image - target of the two renders, for the pixels of all views.
        pulled: (3, P, K) J' W times K images, per channel; None if no images were given.
        components: names of the P scalars, such as `white.reflectance.r`.
    """

    matrix: jax.Array
    gradient: jax.Array
    loss: jax.Array
    scatter: jax.Array
    matrices: jax.Array
    residuals: jax.Array
    pulled: jax.Array | None
    components: tuple[str, ...] = field(metadata={"static": True})


@agreed_by_all
@standard_promotion
def normal_equations(
    scene: Scene | Sequence[Scene],
    names: Sequence[str],
    target: Target | ArrayLike | Sequence[Target | ArrayLike],
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    spp: int = 64,
    seed: int = 0,
) -> NormalEquations:
    """Return the normal equations of images and their targets, without the Jacobian of the images.

    The Gauss-Newton step is -matrix^-1 gradient, and matrix^-1 scatter matrix^-1 is the covariance of the values at
    which such steps arrive.

    Args:
        scene: a scene, or a list of views, which share parameters by name.
        names: of parameters, as `parameters` lists them.
        target: linear RGB or a `Target`; or a list of them, one for each view.
        weights: of the values of the target, 1/variance; or a list of them; None: 1. Clipped or unmeasured values
            have weight 0.
        spp: samples per pixel of each of the two renders.
        seed: other seeds give independent renders. Sums have a fixed order, whatever the number of devices.
    Raises:
        InputError: as for `fit`; weights that are negative, not finite or all 0; more parameters than fit into memory.
    Pixels of the renders share no samples here. Where those of a target do, under a wide filter, the scatter is taken
    over blocks of pixels.
    """
    check_counts(spp, seed)
    views = problem.build(scene, target, names, {})
    given = [weights] * len(views.scenes) if weights is None or isinstance(scene, Scene) else list(weights)
    if len(given) != len(views.scenes):
        raise InputError(f"{len(views.scenes)} scenes and weights of {len(given)}; give one for each scene, or None")
    by_view = [_weights(w, target) for w, target in zip(given, views.targets, strict=True)]
    if not any(w.any() for w in by_view):
        raise InputError("no pixel has a weight: all weights are 0, or the target is clipped or not measured there")
    dtype = views.groups[0].targets.dtype
    check_memory(views.vector, dtype)
    flat = jnp.asarray(views.flat(by_view) / views.exposure**2, dtype)
    values = jnp.asarray(views.start, dtype)
    numbers = (jnp.uint32(x) for x in (spp, seed, 0))
    groups, ones = [group.everywhere() for group in views.groups], jnp.ones_like(values)
    found = _compiled(groups, values, ones, flat, *numbers, vector=views.vector, side=views.side)
    return replace(found, residuals=found.residuals / views.exposure)


def _weights(weights, target: Target) -> np.ndarray:
    try:
        weights = np.broadcast_to(np.asarray(1.0 if weights is None else weights, np.float64), target.image.shape)
    except ValueError:
        given = np.shape(weights)
        raise InputError(f"weights have the shape {given}; those of their target are {target.image.shape}") from None
    if not (np.isfinite(weights) & (weights >= 0)).all():
        raise InputError("weights must be finite and not negative; give 0 where a value is not to be used")
    return np.where(target.usable, weights, 0)


def check_memory(vector: ParameterVector, dtype) -> None:
    """Refuse parameters whose matrices do not fit into memory."""
    count = vector.count
    # Matrices of groups by channel and by component, each with a copy; and the solver's, in float64.
    needed = 4 * GROUPS * count**2 * np.dtype(dtype).itemsize + 8 * count**2 * 8 + 6 * CHUNK_BYTES
    remedy = "name fewer parameters; fit takes textures without them"
    memory.check(needed, f"the normal equations of {count} numbers", remedy)


def sums(
    groups: Sequence[Views],
    values: Float[Array, " P"],
    scale: Float[Array, " P"],
    weights: Float[Array, "N 3"],
    spp: Counts,
    seed: Counts,
    draw: Counts,
    images: Float[Array, "N 3 K"] | None = None,
    *,
    vector: ParameterVector,
    side: int = 1,
    halves: int = 2,
    devices: int | None = None,
) -> NormalEquations:
    """Return the normal equations of some views, with parameters in units of `scale`.

    Args:
        weights: of all pixels, in the order of `Problem.flat`; so are `images`, for `NormalEquations.pulled`.
        spp: of each render.
        seed, draw: as for `Views.seeds`.
        side: of squares of pixels beyond which the noise of a target is independent.
        halves: 2, or 1: a single render, whose noise biases all that is quadratic.
        devices: as for `native_map`; from the same rows, sums are bitwise the same for every number of devices.
    """
    by_name, by_column = vector.unpack(values), vector.by_column(scale)
    groups = [views.placed(by_name) for views in groups]
    count = min(GROUPS, *(len(_blocks(*views.targets.shape[1:3], side)) for views in groups))
    parts, first = [], 0
    for views in groups:
        here = slice(first, first + views.targets.size // 3)
        first = here.stop
        shape = views.targets.shape
        given = [views.targets, weights[here].reshape(shape)]
        given += [] if images is None else [images[here].reshape(*shape, -1)]
        seeds = jnp.stack([views.seeds(seed, draw, half) for half in range(halves)])
        numbers = views, by_name, by_column, spp, seeds
        parts.append(_of_views(numbers, given, vector, side, count, devices))
    residuals, totals = zip(*parts, strict=True)
    total = jax.tree.map(lambda *x: sum(x[1:], x[0]), *totals)
    column, seen = vector.entries
    matrices = sum(total["matrices"][:, c, column][..., column] * np.outer(seen[c], seen[c]) for c in range(3))
    matrices = (matrices + matrices.swapaxes(1, 2)) / 2
    gradient = total["gradient"]
    scatter = total["squares"] - jnp.outer(gradient, gradient) / total["blocks"]
    pulled = None if images is None else total["pulled"][:, column] * seen[..., None]
    residuals = jnp.concatenate(residuals, axis=1)
    labels = tuple(vector.labels)
    return NormalEquations(matrices.sum(0), gradient, total["loss"], scatter, matrices, residuals, pulled, labels)


def _rows(numbers, vector, devices, pixels, there):
    """Return images (R, V, n, 3) and rows of J (R, V, n, Q, 3) of n pixels, for seeds (R, V)."""
    views, by_name, scale, spp, seeds = numbers
    counts = jnp.where(there, spp, 1)

    def of_view(scene, seed):
        scene = views.with_values(scene, by_name)
        wanted = {name: named.find(scene, name) for name in views.names}
        work = wanted, pixels, 0, counts, seed, Options()
        image, J, *_ = pixel_jacobians(named.nameless(scene), *work, devices=devices)
        return image * views.exposure, vector.columns(J, image) * (scale * views.exposure)

    return lax.map(partial(views.map, of_view), seeds)


def _of_views(
    numbers: tuple,
    given: list[Float[Array, "V H W ..."]],
    vector: ParameterVector,
    side: int,
    groups: int,
    devices: int | None,
) -> tuple[Float[Array, "R N 3"], dict]:
    """Return the residuals of the N pixels of views of one size, and sums over them.

    Args:
        numbers: the views, values by name, scale of the columns of J, spp and seeds (R, V).
        given: target, weights, and images if any, of each view.
        groups: as for `_chunks`.
    """
    views, height, width, *_ = given[0].shape
    given = [x.reshape(views, height * width, *x.shape[3:]) for x in given]
    dtype, (column, _) = given[0].dtype, vector.entries
    columns, components, halves = int(column[-1]) + 1, len(column), len(numbers[-1])
    # Noise of J is independent from pixel to pixel: where blocks are few, each pixel of a block forms its own groups.
    summed = groups * (side**2 if groups < GROUPS else 1)
    shapes = {
        "matrices": (summed, 3, columns, columns),
        "gradient": (components,),
        "squares": (components, components),
        "loss": (),
    }
    if len(given) > 2:
        shapes["pulled"] = 3, columns, given[2].shape[-1]
    parts = _parts(height * width * views, sum(map(math.prod, shapes.values())) * dtype.itemsize)
    blocks, bytes_of_pixel = _blocks(height, width, side), 3 * columns * dtype.itemsize * halves * views
    chunks = _chunks(blocks, groups, bytes_of_pixel, parts)
    product = partial(jnp.einsum, precision=lax.Precision.HIGHEST)

    def of_chunk(pixels, numbers, given, devices):
        there = pixels.ravel() >= 0
        each = jnp.maximum(pixels.ravel(), 0)
        target, w, *images = (x[:, each] for x in given)
        w = jnp.where(there[:, None], w, 0)
        # The barrier keeps the sums one program, apart from the kernel, whatever the number of devices.
        r, J = lax.optimization_barrier(_rows(numbers, vector, devices, each, there))
        r = r - target
        (ra, Ja), (rb, Jb) = (r[0], J[0]), (r[-1], J[-1])
        scores = (Ja * (w * rb)[..., None, :] + Jb * (w * ra)[..., None, :]) / 2
        scores = vector.by_component(scores).reshape(-1, pixels.shape[-1], components).sum(1)
        a, b = (x.reshape(views, len(pixels), summed, -1, *x.shape[2:]) for x in (Ja, w[..., None, :] * Jb))
        new = {
            "matrices": product("vbgsqc,vbgsrc->gcqr", a, b),
            "gradient": scores.sum(0),
            "squares": product("bi,bj->ij", scores, scores),
            "loss": (w * ra * rb).sum() / 2,
        }
        if images:
            new["pulled"] = product("vnqc,vnck->cqk", (Ja + Jb) / 2 * w[..., None, :], images[0])
        return new, r

    def of_chunks(chunks, numbers, given, devices):
        def add(total, pixels):
            new, r = of_chunk(pixels, numbers, given, devices)
            return jax.tree.map(jnp.add, total, new), r

        return lax.scan(add, {name: jnp.zeros(shape, dtype) for name, shape in shapes.items()}, chunks)

    if parts == 1:
        total, residuals = of_chunks(jnp.asarray(chunks), numbers, given, devices)
    else:
        dealt = jnp.asarray(chunks).reshape(parts, -1, *chunks.shape[1:])
        of_part = partial(of_chunks, devices=1)
        total, residuals = sum_of_parts(of_part, dealt, numbers, given, devices=devices)
        residuals = residuals.reshape(-1, *residuals.shape[2:])
    # (chunks, R, V, n, 3) to the order of pixels.
    place = np.argsort(np.where(chunks < 0, chunks.size, chunks).ravel())[: height * width]
    residuals = jnp.moveaxis(residuals, 0, 2).reshape(*residuals.shape[1:3], -1, 3)[:, :, place]
    return residuals.reshape(residuals.shape[0], -1, 3), {**total, "blocks": views * len(blocks)}


def _parts(pixels: int, bytes_of_sums: int) -> int:
    """Return the number of parts in which sums over pixels are dealt to devices, the same for any number of devices.

    1: too few parts for many devices, so these share each kernel, and its rows are gathered and multiplied.
    """
    parts = min(pixels // ITEMS_OF_A_PART, MOST_BYTES // bytes_of_sums, MOST_PARTS)
    return 1 << (parts.bit_length() - 1) if parts >= LEAST_PARTS else 1


def _blocks(height: int, width: int, side: int) -> Int[np.ndarray, "B S"]:
    """Return the pixels of blocks that are independent of each other, -1 beyond the image."""
    down, right = -(-height // side), -(-width // side)
    pixels = np.full((down * side, right * side), -1, np.int32)
    pixels[:height, :width] = np.arange(height * width).reshape(height, width)
    blocks = pixels.reshape(down, side, right, side).swapaxes(1, 2).reshape(-1, side * side)
    # In random order, so that groups differ as pixels do, and chunks cost the same.
    blocks = blocks[np.random.default_rng(0).permutation(len(blocks))]
    together = -(-len(blocks) // MOST_BLOCKS)
    count = -(-len(blocks) // together)
    return _padded(blocks, count * together).reshape(count, -1)


def _chunks(
    blocks: Int[np.ndarray, "B S"], groups: int, bytes_of_pixel: int, parts: int = 1
) -> Int[np.ndarray, "C each G S"]:
    """Return the blocks of each group in each chunk, with the same number of chunks in each part."""
    chunks = parts * -(-blocks.size * bytes_of_pixel // (parts * CHUNK_BYTES))
    each = -(-len(blocks) // (chunks * groups))
    return _padded(blocks, chunks * each * groups).reshape(chunks, each, groups, -1)


def _padded(blocks: Int[np.ndarray, "B S"], count: int) -> Int[np.ndarray, "count S"]:
    return np.pad(blocks, [(0, count - len(blocks)), (0, 0)], constant_values=-1)


_compiled = jax.jit(sums, static_argnames=("vector", "side", "halves", "devices"))
