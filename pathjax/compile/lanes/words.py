"""Values of one lane packed into few arrays, as a loop pays for each array that it carries."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import lax


class Words:
    """Layout of values of these shapes and dtypes: their bits, in one array for each size of scalar."""

    def __init__(self, avals):
        self._avals = list(avals)
        self._places: list[slice] = []
        self._counts: dict[np.dtype, int] = {}
        for aval in self._avals:
            word = _word(aval.dtype)
            start = self._counts.get(word, 0)
            self._counts[word] = start + math.prod(aval.shape)
            self._places.append(slice(start, self._counts[word]))

    def of(self, values) -> list[list]:
        """Return the bits of values, each given as a list of its scalars: one list for each array."""
        lists: dict[np.dtype, list] = {word: [] for word in self._counts}
        for aval, numbers in zip(self._avals, values, strict=True):
            word = _word(aval.dtype)
            lists[word] += [lax.bitcast_convert_type(x, word) if x.dtype != word else x for x in numbers]
        return list(lists.values())

    def values(self, arrays) -> list:
        """Return the values that are packed in such arrays."""
        words = dict(zip(self._counts, arrays, strict=True))
        found = []
        for aval, place in zip(self._avals, self._places, strict=True):
            x = words[_word(aval.dtype)][place].reshape(aval.shape)
            found.append(lax.bitcast_convert_type(x, aval.dtype) if x.dtype != aval.dtype else x)
        return found


def _word(dtype) -> np.dtype:
    """Return the dtype in which values of a dtype are stored: an unsigned integer, or bool."""
    dtype = jnp.dtype(dtype)
    return dtype if dtype.kind == "b" else np.dtype(f"u{dtype.itemsize}")
