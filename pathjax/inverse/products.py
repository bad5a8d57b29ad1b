"""Evaluations for a fit of many scalars: images, J v and J^T v for the kept pixels of all views, and rows of J.

Arrays over pixels are (N, 3), for the kept pixels of all views one after another; those over parameters are (n,), in
float64. One kernel evaluates a part of the pixels, so that a fit compiles few kernels, whichever pixels it keeps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.compile import devices_of_a_call
from pathjax.derivatives import backward
from pathjax.derivatives.kept import kept as kept_of
from pathjax.derivatives.row_slopes import Place, by_column
from pathjax.integrators import pixel
from pathjax.integrators.options import Options
from pathjax.inverse.compiled_cache import compiled
from pathjax.inverse.problem import Problem, Views
from pathjax.rendering.render import render_pixels
from pathjax.scene import parameters as named

# Parts in which pixels are rendered; and the least pixels of a part that are worth the start of a kernel.
PARTS, LEAST_PART = 8, 4096
# Rows of J are made for fewer pixels at once, by each device for its own: parts of all pixels, bytes of a part, and the
# least pixels that are worth a kernel.
ROWS_PARTS, ROWS_BYTES, LEAST_ROWS = 64, 1 << 26, 1024


class RowsPart(NamedTuple):
    """Some pixels: their indices (n,) in (N,), and for each draw a call that renders their rows, in any thread."""

    places: np.ndarray
    new: np.ndarray  # (V, part) bool; the others belong to another part, or are not kept
    calls: list[Callable[[], np.ndarray]]

    def rows(self) -> list[np.ndarray]:
        """Return rows of J (3, n, Q) for each draw."""
        return [np.ascontiguousarray(np.moveaxis(call()[self.new], -1, 0)) for call in self.calls]


class Products:
    """The kept pixels of a problem, and the kernels for them."""

    def __init__(self, problem: Problem, seed: int):
        self.problem, self.vector, self.seed = problem, problem.vector, jnp.uint32(seed)
        self.dtype = problem.groups[0].targets.dtype
        self.compile_seconds, self.draws = 0.0, 0
        # Values, and the groups that hold them: for kernels on all devices, and for those on one.
        self.placed: tuple[np.ndarray, list[Views], list[Views]] | None = None
        self.keep([np.ones(t.image.shape[:2], bool) for t in problem.targets])

    def keep(self, masks: list[np.ndarray]) -> None:
        """Evaluate from now on the pixels in these masks, (H, W) bool per view."""
        self.masks = masks
        self.parts: list[tuple[int, jax.Array, np.ndarray]] = []  # group, pixels (V, part), their indices in (N,)
        first = np.cumsum([0, *(int(mask.sum()) for mask in masks)])
        self.count = int(first[-1])
        for group, views in enumerate(self.problem.groups):
            own = [np.flatnonzero(masks[number].ravel()) for number in views.numbers]
            part = min(max(masks[views.numbers[0]].size // PARTS, LEAST_PART), masks[views.numbers[0]].size)
            for begin in range(0, max(map(len, own), default=0), part):
                pixels = np.zeros((len(own), part), np.int32)
                places = np.full((len(own), part), self.count)  # N: no pixel
                for row, (number, mine) in enumerate(zip(views.numbers, own, strict=True)):
                    here = mine[begin : begin + part]
                    pixels[row, : len(here)] = here
                    places[row, : len(here)] = first[number] + begin + np.arange(len(here))
                self.parts.append((group, jnp.asarray(pixels), places))

    def next_draw(self) -> jax.Array:
        """Return the number of a new draw, for renders that are independent of all before."""
        self.draws += 1
        return jnp.uint32(self.draws)

    def images(self, values: np.ndarray, spp: int, draw) -> np.ndarray:
        """Return the image (N, 3), exposed."""
        found = np.zeros((self.count + 1, 3))
        for group, pixels, places in self.parts:
            found[places] = self._run(_image, values, group, pixels, spp, draw)
        return found[:-1]

    def push(self, values: np.ndarray, change: np.ndarray, spp: int, draw) -> np.ndarray:
        """Return J change: (n,) -> (N, 3)."""
        found = np.zeros((self.count + 1, 3))
        change = jnp.asarray(change, self.dtype)
        for group, pixels, places in self.parts:
            found[places] = self._run(_push, values, group, pixels, spp, draw, change)
        return found[:-1]

    def pull(self, values: np.ndarray, adjoint: np.ndarray, spp: int, draw) -> np.ndarray:
        """Return J^T adjoint: (N, 3) -> (n,)."""
        padded = np.concatenate([adjoint, np.zeros((1, 3))])
        total = np.zeros(len(values))
        for group, pixels, places in self.parts:
            mine = jnp.asarray(padded[places], self.dtype)
            total += self._run(_pull, values, group, pixels, spp, draw, mine)
        return total

    @property
    def most_rows(self) -> int:
        """Most pixels of a part of `rows`, over all its views."""
        fit = min(ROWS_BYTES // (self.vector.count * 4), self.count // ROWS_PARTS)
        return max(fit, LEAST_ROWS, *(len(pixels) for _, pixels, _ in self.parts))

    def rows(self, values: np.ndarray, spp: int, draws: tuple) -> Iterator[RowsPart]:
        """Yield parts of the pixels: enough to share the work evenly among many devices, and small enough for memory.

        Parameters are Q colours or Q scalars. Light keeps its channel: J[c] is the derivative of channel c in channel c
        of colours.
        """
        for group, pixels, places in self.parts:
            most = max(self.most_rows // len(pixels), 1)
            each = -(-pixels.shape[1] // -(-pixels.shape[1] // most))
            for first in range(0, pixels.shape[1], each):
                begin = min(first, pixels.shape[1] - each)  # the last part is as large as the others: one kernel
                here = places[:, begin : begin + each]
                new = here < self.count
                new[:, : first - begin] = False
                calls = [self._call(_rows, values, group, pixels[:, begin : begin + each], spp, d) for d in draws]
                yield RowsPart(here[new], new, calls)

    def spread(self, kept: np.ndarray) -> list[np.ndarray]:
        """Return arrays (H, W, C) per view from (N, C) of the kept pixels, with 0 elsewhere."""
        parts = np.split(kept, np.cumsum([int(mask.sum()) for mask in self.masks])[:-1])
        images = []
        for mask, part in zip(self.masks, parts, strict=True):
            image = np.zeros((*mask.shape, kept.shape[1]))
            image[mask] = part
            images.append(image)
        return images

    def kept(self, by_view: list[np.ndarray]) -> np.ndarray:
        """The inverse of `spread`."""
        return np.concatenate([image[mask] for image, mask in zip(by_view, self.masks, strict=True)])

    def _run(self, *call):
        return self._call(*call)()

    def _at(self, values: np.ndarray, everywhere: bool = True) -> list[Views]:
        """Return the groups with these values, on all devices or on one, so that kernels need not copy their arrays."""
        if self.placed is None or not np.array_equal(values, self.placed[0]):
            self.placed = None  # memory for one at a time
            by_name = self.vector.unpack(jnp.asarray(values, self.dtype))
            groups = [views.placed(by_name) for views in self.problem.groups]
            self.placed = values.copy(), [views.everywhere() for views in groups], groups
        return self.placed[1 if everywhere else 2]

    def _call(self, function: Callable, values, group: int, pixels, spp: int, draw, *more) -> Callable:
        """Compile a kernel in the calling thread, and return a function that runs it in any thread."""
        views = self._at(values, everywhere=function is not _rows)[group]
        values = jnp.asarray(values, self.dtype)
        arguments = values, views, pixels, jnp.uint32(spp), views.seeds(self.seed, draw, 0), *more
        bound = partial(function, vector=self.vector)
        program, seconds = compiled((function, self.vector), lambda *a: jax.jit(bound).lower(*a).compile(), *arguments)
        self.compile_seconds += seconds
        return lambda: np.asarray(program(*arguments), float)


def _image(values, views: Views, pixels, spp, seeds, vector):
    """Return the images (V, part, 3)."""
    by_name = vector.unpack(values)

    def one(scene, work):
        seed, pixels = work
        return render_pixels(views.with_values(scene, by_name), pixels, 0, spp, seed) * views.exposure

    return views.map(one, (seeds, pixels))


def _push(values, views, pixels, spp, seeds, change, vector):
    return jax.jvp(lambda values: _image(values, views, pixels, spp, seeds, vector), (values,), (change,))[1]


def _pull(values, views, pixels, spp, seeds, adjoint, vector):
    return jax.vjp(lambda values: _image(values, views, pixels, spp, seeds, vector), values)[1](adjoint)[0]


def _rows(values, views, pixels, spp, seeds, vector):
    """Return rows of J (V, part, Q, 3), by a kernel for `concurrently`."""
    by_name, options = vector.unpack(values), Options(derivative=True, by_vertex=True)

    def one(scene, work):
        seed, pixels = work
        scene = named.nameless(views.with_values(scene, by_name))
        kept = kept_of(scene, views.wanted.values())
        how = dict(kept=kept, options=options, ring=backward.longest_ring(scene))
        numbers = pixel.numbers(pixels, 0, spp, seed)
        _, found = backward.rows(scene, pixels, *numbers, devices=devices_of_a_call(), **how)

        def of_pixel(row):
            columns = []
            for name, parameter in vector.parameters:
                column = jnp.zeros((math.prod(parameter.shape) // vector.systems, 3), row.dtype)
                if name in views.names:
                    here = kept.of(scene, views.wanted[name])
                    column = by_column(Place.of(scene, here, views.wanted[name]), row[here.start : here.stop])
                columns.append(column)
            return jnp.concatenate(columns) * views.exposure

        return jax.vmap(of_pixel, in_axes=1)(found.all()[..., :3])

    return views.map(one, (seeds, pixels))
