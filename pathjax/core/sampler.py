"""Random numbers as a function: (seed, pixel, sample, dimension) -> (0, 1), float32, odd multiples of 2^-24.

The points of a pixel's paths are a rank-1 lattice in many dimensions at once, ordered by the radical inverse so that
the first 2^m of them are a lattice for every m, and moved as a whole by a random shift (Dick, Kuo and Sloan 2013, Acta
Numerica 22). So every number is uniform and the estimate unbiased, and what a path decides at several vertices is
stratified jointly, which padded pairs of a Sobol' sequence are not. Choices are hashed. Every pixel and every seed is
an independent randomisation. POINTS holds what classic path tracers use instead, for comparison.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from pathjax.core.math import at

# Generating vector of an extensible lattice sequence that is good in all two-dimensional projections up to 2^20 points,
# "order 2" (Cools, Kuo and Nuyens 2006, SIAM J. Sci. Comput. 28(6); in Nuyens' Magic Point Shop exod2_base2_m20_CKN).
# Rows are the four dimensions of a vertex. Deeper vertices use the rows again, under other shifts: still unbiased.
_GENERATORS = np.array(
    [
        [1, 182667, 469891, 498753], [110745, 446247, 250185, 118627], [245333, 283199, 408519, 391023],
        [246327, 126539, 399185, 461527], [300343, 69681, 516695, 436179], [106383, 238523, 413283, 70841],
        [47719, 300129, 113029, 123925], [410745, 211325, 17489, 511893], [40767, 186077, 519471, 255369],
        [101819, 243573, 66189, 152143], [503455, 113217, 132603, 463967], [297717, 157383, 224015, 502917],
        [36237, 94049, 170665, 79397], [123963, 223451, 323871, 303633], [98567, 318855, 494245, 477137],
        [177975, 64483, 26695, 88779],
    ],
    np.uint32,
)  # fmt: skip
DIMENSIONS = 4


def _u32(x):
    return jnp.asarray(x).astype(jnp.uint32)


def hash_u32(x):
    """Avalanche of 32 bits (Wellons' lowbias32)."""
    x = _u32(x)
    x = (x ^ (x >> 16)) * jnp.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) * jnp.uint32(0xD35A2D97)
    return x ^ (x >> 15)


def combine(a, b):
    """Hash of an ordered pair of 32-bit numbers."""
    return hash_u32(_u32(a) * jnp.uint32(0x9E3779B9) ^ hash_u32(_u32(b) + jnp.uint32(0x85EBCA6B)))


def to_unit(x):
    """uint32 -> float32: the odd multiple of 2^-24 in the middle of one of 2^23 equal intervals, so never 0 or 1."""
    return (x >> 9).astype(jnp.float32) * jnp.float32(2**-23) + jnp.float32(2**-24)


def reverse_bits(x):
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & jnp.uint32(mask)) | ((x & jnp.uint32(mask)) << shift)
    return (x >> 16) | (x << 16)


def lattice_point(stream, sample, vertex):
    """(4,) float32, dimensions of one vertex of one path.

    Args:
        stream: () uint32, of `pixel_stream`.
        sample: () uint32 number of the sample.
        vertex: () integer; which four dimensions.
    """
    vertex = _u32(vertex)
    generators = at(jnp.asarray(_GENERATORS), vertex % len(_GENERATORS))
    return to_unit(reverse_bits(_u32(sample)) * generators + _hashes(stream, vertex * DIMENSIONS, DIMENSIONS))


def independent_point(stream, sample, vertex):
    """(4,) float32 of `lattice_point`, none of which knows of another."""
    return to_unit(_point_hashes(stream, sample, vertex))


def subpixel_point(stream, sample, vertex):
    """The same, but of four samples in a row each has the film position, the first pair of vertex 0, in its own quarter
    of the unit square, as in smallpt (Beason 2008)."""
    bits, sample = _point_hashes(stream, sample, vertex), _u32(sample)
    quarter = jnp.stack([sample & 1, (sample >> 1) & 1]) << 31
    first = jnp.where(_u32(vertex) == 0, quarter | (bits[:2] >> 1), bits[:2])
    return to_unit(jnp.concatenate([first, bits[2:]]))


def _point_hashes(stream, sample, vertex):
    return _hashes(path_key(~stream, sample), _u32(vertex) * DIMENSIONS, DIMENSIONS)


POINTS = {"lattice": lattice_point, "independent": independent_point, "subpixel": subpixel_point}
SUBPIXELS = 4


def pixel_stream(seed, pixel):
    """() uint32: the stream of one pixel; different for every seed and pixel."""
    return combine(pixel, hash_u32(_u32(seed)))


def path_key(stream, sample):
    """() uint32: what `hashed` hashes for one sample."""
    return combine(stream ^ jnp.uint32(0x5BF03635), _u32(sample))


def hashed(key, dimension, count: int):
    """(count,) float32 independent numbers for dimensions dimension, ..., dimension + count - 1 of a path."""
    return to_unit(_hashes(key, dimension, count))


def _hashes(key, dimension, count):
    return hash_u32(key + (_u32(dimension) + jnp.arange(count, dtype=jnp.uint32)) * jnp.uint32(0x9E3779B9))
