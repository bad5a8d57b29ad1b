"""Random numbers as a function: (seed, pixel, sample, dimension) -> [0, 1), float32 multiples of 2^-24.

Directions and points come from a two-dimensional Sobol' sequence, padded: each pair of dimensions has its own hashed
Owen scramble and its own order of the points (Burley 2020, JCGT 9(4); hash constants by Vegdahl). Choices are hashed.
Every pixel and every seed is an independent randomisation; within one, the numbers are a (0, 2)-net in every pair.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax


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
    """uint32 -> float32 in [0, 1): its upper 24 bits."""
    return (x >> 8).astype(jnp.float32) * jnp.float32(2**-24)


def reverse_bits(x):
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & jnp.uint32(mask)) | ((x & jnp.uint32(mask)) << shift)
    return (x >> 16) | (x << 16)


def _owen_reversed(x, seed):
    """Owen scramble of numbers whose bits are stored lowest first (Laine and Karras 2011, Vegdahl's constants)."""
    x = x ^ (x * jnp.uint32(0x3D20ADEA))
    x = x + seed
    x = x * ((seed >> 16) | jnp.uint32(1))
    x = x ^ (x * jnp.uint32(0x05526C56))
    return x ^ (x * jnp.uint32(0x53A22864))


def _pascal(x):
    """Generator matrix of the second Sobol' dimension, binomials mod 2, bits lowest first on both sides."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        x = x ^ ((x >> shift) & jnp.uint32(mask))
    return x


def sobol_pair(stream, sample, pair):
    """Two dimensions of one sample: (2,) float32.

    Args:
        stream: () uint32, of `pixel_stream`.
        sample: () uint32 number of the sample.
        pair: () int32 which two.
    """
    seed = combine(pair, stream)
    index = reverse_bits(_owen_reversed(reverse_bits(_u32(sample)), seed))
    seed, index = lax.optimization_barrier((seed, index))
    x = reverse_bits(_owen_reversed(index, hash_u32(seed + jnp.uint32(1))))
    y = reverse_bits(_owen_reversed(_pascal(index), hash_u32(seed + jnp.uint32(2))))
    return jnp.stack([to_unit(x), to_unit(y)])


def pixel_stream(seed, pixel):
    """() uint32: the stream of one pixel; different for every seed and pixel."""
    return combine(pixel, hash_u32(_u32(seed)))


def path_key(stream, sample):
    """() uint32: what `hashed` hashes for one sample. Apart from `sobol_pair`, which hashes otherwise."""
    return combine(stream ^ jnp.uint32(0x5BF03635), _u32(sample))


def hashed(key, dimension, count: int):
    """(count,) float32 independent numbers for dimensions dimension, ..., dimension + count - 1 of a path."""
    return to_unit(hash_u32(key + (_u32(dimension) + jnp.arange(count, dtype=jnp.uint32)) * jnp.uint32(0x9E3779B9)))
