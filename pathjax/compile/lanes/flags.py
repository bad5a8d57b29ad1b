"""Flags of lanes, packed into words, and loops over the lanes whose flag is set."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax

from pathjax.compile.lanes.columns import entry

_BITS = 32


def packed(flags):
    """Pack flags (W,) bool into the bits of words (K,) uint32: bit b of word k is the flag of lane K b + k.

    It combines halves by SIMD, as XLA would reduce flags one by one.
    """
    count = -(-len(flags) // _BITS)
    words = jnp.pad(flags, (0, count * _BITS - len(flags))).astype(jnp.uint32)
    while len(words) > count:
        low, high = jnp.split(words, 2)
        words = low | high << (len(low) // count)
    return words


def any_set(words):
    """Return whether any flag is set, () bool."""
    return lax.reduce_or(words, (0,)) != 0


def for_each_lane(words, act: Callable, state):
    """Apply act(lane, state) -> state to the lanes whose flag is set in these words, one after another."""
    count = len(words)

    def next_nonzero(k, word):
        """Return index and value of the first word from this one on that is not 0, or of the last word."""

        def is_empty(state):
            k, word = state
            return (word == 0) & (k < count - 1)

        return lax.while_loop(is_empty, lambda state: (state[0] + 1, entry(words, state[0] + 1)), (k, word))

    def step(state):
        k, word, state = state
        lowest = lax.population_count((word & -word) - 1).astype(jnp.int32)
        return *next_nonzero(k, word & (word - 1)), act(count * lowest + k, state)

    return lax.while_loop(lambda state: state[1] != 0, step, (*next_nonzero(jnp.int32(0), words[0]), state))[2]
