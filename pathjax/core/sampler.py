"""Random numbers as a function: (seed, pixel, sample, dimension) -> (0, 1), float32, odd multiples of 2^-24.

The points of a pixel's paths are a rank-1 lattice in many dimensions at once, ordered by the radical inverse so that
the first 2^m of them are a lattice for every m, and moved as a whole by a random shift (Dick, Kuo and Sloan 2013, Acta
Numerica 22). So every number is uniform and the estimate unbiased, and the numbers of several vertices are stratified
jointly, which padded pairs of a Sobol' sequence are not. The numbers for other choices are hashed. Every pixel and
every seed is an independent randomisation. POINTS also holds the points of classic path tracers, for comparison.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, UInt

from pathjax.compile import compute_once
from pathjax.core.math import at
from pathjax.core.types import Number

# Generating vector of an extensible lattice sequence for a path tracer, up to 2^20 points. Rows are the four dimensions
# of a vertex: film and lens, then light sample and bsdf sample. The light sample of a vertex is never multiplied with
# another's, nor with the bsdf samples of its own and later vertices; so each pair was chosen, component by component
# (Dick, Kuo and Sloan), to minimise the shift-averaged error of the terms that contain it: film, lens, bsdf samples of
# the vertices before, and one light or bsdf sample. A dimension weighs 0.3, and 0.7 as much at each further vertex. The
# lowest twelve bits serve 2^3 to 2^12 points together, each further bit twice as many. Some sixty vectors of nearly the
# least error, by several weights, were tried on four scenes; this is among the best, and did as well on six others.
# Deeper vertices reuse the rows under other shifts, which is still unbiased.
_GENERATORS = np.array(
    [
        [1, 273965, 177595, 892119], [574107, 988125, 412389, 873177], [1006923, 598441, 1007947, 797155],
        [891569, 890105, 157007, 576263], [338089, 952587, 338089, 144481], [811793, 867139, 236783, 981827],
        [847547, 653629, 728525, 870891], [547017, 1014435, 501559, 393919], [558429, 452465, 119459, 711633],
        [495941, 141939, 495759, 981589], [289917, 303983, 275445, 495941], [963981, 721515, 289917, 416623],
        [778859, 482953, 963981, 450155], [88381, 384251, 614083, 1001913], [302921, 847757, 95989, 659493],
        [250231, 940849, 603785, 745655],
    ],
    np.uint32,
)  # fmt: skip
DIMENSIONS = 4

Word = UInt[Array, ""]


def _u32(x: Integer[Array, "*shape"] | int) -> UInt[Array, "*shape"]:
    return jnp.asarray(x).astype(jnp.uint32)


def hash_u32(x: Integer[Array, "*shape"] | int) -> UInt[Array, "*shape"]:
    """Hash 32 bits with full avalanche (Wellons' lowbias32)."""
    bits = _u32(x)
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x21F0AAAD)
    bits = (bits ^ (bits >> 15)) * jnp.uint32(0xD35A2D97)
    return bits ^ (bits >> 15)


def combine(
    a: Integer[Array, "*#shape"] | int, b: Integer[Array, "*#shape"] | int
) -> UInt[Array, "*#shape"]:
    """Hash an ordered pair of 32-bit numbers."""
    return hash_u32(_u32(a) * jnp.uint32(0x9E3779B9) ^ hash_u32(_u32(b) + jnp.uint32(0x85EBCA6B)))


def to_unit(x: UInt[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Map 32 bits to float32: the middle of one of 2^23 equal intervals, an odd multiple of 2^-24, so never 0 or 1."""
    return (x >> 9).astype(jnp.float32) * jnp.float32(2**-23) + jnp.float32(2**-24)


def reverse_bits(x: Word) -> Word:
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & jnp.uint32(mask)) | ((x & jnp.uint32(mask)) << shift)
    return (x >> 16) | (x << 16)


def lattice_point(stream: Word, sample: Word, vertex: Number) -> Float[Array, "4"]:
    """Return the four dimensions of one vertex of one path, float32.

    Args:
        stream: from `pixel_stream`.
        sample: index of the sample.
        vertex: index of the vertex, which selects the dimensions.
    """
    vertex = _u32(vertex)
    generators = at(jnp.asarray(_GENERATORS), vertex % len(_GENERATORS))
    place = compute_once(reverse_bits(_u32(sample)))  # shared by all four
    return to_unit(place * generators + _hashes(stream, vertex * DIMENSIONS, DIMENSIONS))


def independent_point(stream: Word, sample: Word, vertex: Number) -> Float[Array, "4"]:
    """Return numbers like those of `lattice_point`, but independent of each other."""
    return to_unit(_point_hashes(stream, sample, vertex))


def subpixel_point(stream: Word, sample: Word, vertex: Number) -> Float[Array, "4"]:
    """Return independent numbers, but four consecutive samples have their film positions, the first pair of vertex 0,
    in different quarters of the unit square, as in smallpt (Beason 2008)."""
    bits, sample = _point_hashes(stream, sample, vertex), _u32(sample)
    quarter = jnp.stack([sample & 1, (sample >> 1) & 1]) << 31
    first = jnp.where(_u32(vertex) == 0, quarter | (bits[:2] >> 1), bits[:2])
    return to_unit(jnp.concatenate([first, bits[2:]]))


def _point_hashes(stream: Word, sample: Word, vertex: Number) -> UInt[Array, "4"]:
    return _hashes(path_key(~stream, sample), _u32(vertex) * DIMENSIONS, DIMENSIONS)


POINTS = {"lattice": lattice_point, "independent": independent_point, "subpixel": subpixel_point}
SUBPIXELS = 4


def pixel_stream(seed: Number, pixel: Number) -> Word:
    """Return the stream of one pixel; different for every seed and pixel."""
    return combine(pixel, hash_u32(_u32(seed)))


def path_key(stream: Word, sample: Word) -> Word:
    """Return the key of one sample for `hashed`."""
    return combine(stream ^ jnp.uint32(0x5BF03635), _u32(sample))


def hashed(key: Word, dimension: Number, count: int) -> Float[Array, " {count}"]:
    """Return independent numbers for the dimensions dimension, ..., dimension + count - 1 of a path."""
    return to_unit(_hashes(key, dimension, count))


def _hashes(key: Word, dimension: Number, count: int) -> UInt[Array, " {count}"]:
    return hash_u32(key + (_u32(dimension) + jnp.arange(count, dtype=jnp.uint32)) * jnp.uint32(0x9E3779B9))
