"""An environment map, in Mitsuba's latitude-longitude layout.

Columns are azimuths; texel centres lie at (i + 1/2) / width of a turn from -z over x, and columns repeat. Rows are
polar angles from +y: the first row is the zenith and the last one the nadir. Between centres radiance is bilinear.

Directions are sampled by the luminance above its mean over the sphere: bsdf samples find even light with less noise,
and a constant background is left to them altogether (Karlik et al. 2019, "MIS compensation"). A patch between four
texels is drawn in proportion to that, integrated over its solid angle, by two searches: for its row among all rows, and
for its column in that row. Within the patch the density interpolates its corners. It is bilinear in the azimuth and in
the cosine of the polar angle, so that it is sampled exactly; in all but a few rows it is close to the luminance above
the mean. (At the rim of a sun four texels wide, most patches are bright on one side only.)
"""

from __future__ import annotations

import gc
import math
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax.compile import compute_once, is_traced
from pathjax.core.cumulated import STEP, cumulated, search
from pathjax.core.math import at, cos_sin_turns, luminance, safe_atan2, safe_divide, safe_sqrt, turns
from pathjax.emitters.emitter import Background
from pathjax.images import read_rgb
from pathjax.kinds import Number, Parameter, PerRow, Rotation, Row, Shared, Unused
from pathjax.textures.bitmap import texels_of

# Columns that are computed from the texels.
TABLED = "importance", "rows", "columns", "from_pole", "per_solid_angle", "brightness"
# Least share of luminance by which directions are drawn: they must reach all light, also where bsdf samples seldom do.
# Shares from 1/50 to 1/10 were alike, within 6 %, on three scenes.
_KEPT = 1 / 20
# Share of the mean of a patch's corners that is added to each of them.
_LEAST = 1 / 16
# Alignment, in bytes, with which JAX uses arrays of NumPy without a copy.
_ALIGNED = 64
# Rows of patches whose probabilities are computed at once, so that little temporary memory is used.
_ROWS = 64


class Envmap(Background):
    """An `Instance` holds `texels` (H, W, 3), `scale` and `to_world`."""

    # Large tables are flat, since `lanes` would copy others each time.
    texels = Shared(colors=True)  # (H W 3,) linear radiance
    importance = Shared()  # (H W,) weight of each texel, by which directions are drawn
    rows = Shared()  # (H,) cumulative probability of the patches above each row of texels
    columns = Shared()  # ((H - 1) (W + 1),) the same of those left of each texel, within a row of patches
    from_pole = Shared()  # (H,) 1 - |cos| of the polar angles of rows of texels
    per_solid_angle = Shared()  # (H - 1,) probability of a row of patches over the solid angle of one of them, 1/sr
    brightness = PerRow()  # () luminance of the mean over the sphere
    scale = Number(1.0, bounds=(0, math.inf))
    to_world = Rotation()
    single = True
    unused: ClassVar[Mapping[str, Unused]] = {
        "mis_compensation": Unused("boolean", "how often a direction is sampled changes noise alone")
    }

    @classmethod
    def read(cls, loader, fields, name):
        data, key = fields.array("data", None), "filename" if fields.has("filename") else "data"
        texels = read_rgb(loader.find(fields, "filename")) if data is None else texels_of(fields, data, raw=False)
        if not np.isfinite(texels).all():
            y, x = np.argwhere(~np.isfinite(texels).all(-1))[0]
            raise fields.error(key, f"has {texels[y, x].tolist()} in its texel ({x}, {y}); radiance must be finite")
        if texels.min() < 0:
            count = int((texels < 0).any(-1).sum())
            least = f"{count} texels of negative radiance, down to {texels.min():g}"
            loader.note(fields.where(key), f"has {least}, which is taken as 0")
            texels = np.maximum(texels, 0)
        others = "scale", "to_world", "sampling_weight"
        given = {key: cls.declared[key].read(loader, fields, key, name) for key in others}
        return cls.instance(name, texels=_placed(texels), **given)

    @classmethod
    def build(cls, instances, dtype, path, parameters, code):
        (instance,) = instances
        texels = np.asarray(instance.values["texels"], dtype)
        if len(texels) == 1:  # zenith, nadir and all between
            texels = np.concatenate([texels, texels])
        where = (*path, "columns", cls.place("texels"), "values")
        radiance = Parameter(where, (0,), texels.shape, (0, math.inf), "texels", rows=texels.size)
        parameters.known[f"{instance.name}.radiance"] = radiance
        table = super().build(instances, dtype, path, parameters, code)
        made = {"texels": texels.reshape(-1), **_probabilities(texels)}
        for key in list(made):
            table = table.with_column(key, _placed(np.asarray(made.pop(key), dtype)))
        return table

    @classmethod
    def derived(cls, table, changed=()):
        """Recompute the probabilities from the texels, detached."""
        if "texels" not in changed:
            return table
        texels = lax.stop_gradient(table.column("texels").values)
        size = _size(Row(table, 0))

        def on_host(texels):
            made = _probabilities(np.reshape(texels, (*size, 3)))
            return {key: np.asarray(values, texels.dtype) for key, values in made.items()}

        if is_traced(texels):
            old = {key: table.column(key).values for key in TABLED}
            shapes = {key: jax.ShapeDtypeStruct(values.shape, texels.dtype) for key, values in old.items()}
            made = jax.pure_callback(on_host, shapes, texels, vmap_method="sequential")
        else:
            made = jax.device_put(on_host(np.asarray(texels)))
        for key in TABLED:
            table = table.with_column(key, made[key])
        return table

    @staticmethod
    def power(p) -> Float[Array, " R"]:
        return p.brightness * p.scale

    @staticmethod
    def sample(p: Row, u: Float[Array, "2"], u_part: Float[Array, ""]) -> Float[Array, "3"]:
        height, width = _size(p)
        y, above = search(p.rows, 0, height - 1, u[0])
        x, beside = search(p.columns, y * (width + 1), width, u[1])
        (a, b), (c, e) = _corners(p, jnp.stack([y, x]))
        above = _drawn(a + b, c + e, above)
        beside = _drawn(a + (c - a) * above, b + (e - b) * above, beside)
        upper, lower = _ends(p, y)
        from_pole = upper + (lower - upper) * above
        r, cos = safe_sqrt(from_pole * (2 - from_pole)), 1 - from_pole
        cos = jnp.where(2 * y > height - 2, -cos, cos)
        turn = (x.astype(u.dtype) + beside + jnp.asarray(0.5, u.dtype)) / width
        cos_phi, sin_phi = cos_sin_turns(turn - jnp.floor(turn))
        return p.to_world @ compute_once(jnp.stack([r * sin_phi, cos, -r * cos_phi]))

    @staticmethod
    def emitted(p: Row, d: Float[Array, "3"]) -> Float[Array, "3"]:
        patch, inside, _ = _patch(p, d)
        return _radiance(p, patch, inside)

    @staticmethod
    def entries(p: Row, d: Float[Array, "3"]) -> list[tuple[str, Int[Array, ""], Float[Array, ""]]]:
        (y, x), (below, beside), _ = _patch(p, d)
        width = _size(p)[1]
        following = jnp.where(x + 1 < width, x + 1, 0)
        rows, columns = ((y, 1 - below), (y + 1, below)), ((x, 1 - beside), (following, beside))
        return [("texels", y * width + x, a * b) for y, a in rows for x, b in columns]

    @staticmethod
    def density(p: Row, d: Float[Array, "3"]) -> Float[Array, ""]:
        patch, (_, beside), down = _patch(p, d)
        return _density(p, patch, down, beside)

    @classmethod
    def met(cls, p: Row, d: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        patch, inside, down = _patch(p, d)
        return _radiance(p, patch, inside), _density(p, patch, down, inside[1])


def _around(p: Row, patch: Int[Array, "2"]) -> list[list[Int[Array, ""]]]:
    """Return the indices of the texels around a patch: two above, two below."""
    y, x = patch
    width = _size(p)[1]
    first, following = y * width + x, y * width + jnp.where(x + 1 < width, x + 1, 0)
    return [[first, following], [first + width, following + width]]


def _radiance(p: Row, patch: Int[Array, "2"], inside: Float[Array, "2"]) -> Float[Array, "3"]:
    def texel(number):
        return lax.dynamic_slice(p.texels, (3 * number,), (3,), allow_negative_indices=False)

    radiance = _bilinear([[texel(number) for number in row] for row in _around(p, patch)], *inside)
    if (nudge := p.nudge("texels")) is not None:
        radiance = radiance + nudge
    return radiance * p.scale


def _corners(p: Row, patch: Int[Array, "2"]) -> list[list[Float[Array, ""]]]:
    """Return the weights at the corners of a patch, by which directions in it are drawn; none is 0 unless all are.

    Otherwise hardly any samples would find the derivative in a black texel.
    """
    corners = [[at(p.importance, number) for number in row] for row in _around(p, patch)]
    least = sum(map(sum, corners)) * (_LEAST / 4)
    return [[corner + least for corner in row] for row in corners]


def _density(p: Row, patch: Int[Array, "2"], down: Float[Array, ""], beside: Float[Array, ""]) -> Float[Array, ""]:
    y, x = patch
    place = y * (_size(p)[1] + 1) + x
    of_patch = at(p.per_solid_angle, y) * (at(p.columns, place + 1) - at(p.columns, place))
    corners = _corners(p, patch)
    total = sum(map(sum, corners))
    return of_patch * jnp.where(total > 0, safe_divide(4 * _bilinear(corners, down, beside), total), 1)


def _bilinear(corners, below, beside):
    (a, b), (c, d) = corners
    upper, lower = a * (1 - beside) + b * beside, c * (1 - beside) + d * beside
    return upper * (1 - below) + lower * below


def _drawn(first: Float[Array, ""], last: Float[Array, ""], u: Float[Array, ""]) -> Float[Array, ""]:
    """Sample x in [0, 1) by a density linear from `first` at 0 to `last` at 1; uniform where both are 0."""
    total = first + last
    a = jnp.where(total > 0, safe_divide(first, total), 0.5)
    b = 1 - a
    # The root of a x + (b - a) x^2 / 2 = u / 2, without cancellation.
    return compute_once(jnp.minimum(safe_divide(u, a + safe_sqrt(a * a * (1 - u) + b * b * u)), 1 - STEP))


def _ends(p: Row, y: Int[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return `from_pole` above and below a row of patches, from the nearer pole, where cosines lose their digits."""
    upper, lower = at(p.from_pole, y), at(p.from_pole, y + 1)
    # A row across the equator begins above it.
    return upper, jnp.where(2 * y == _size(p)[0] - 2, 2 - lower, lower)


def _placed(values: np.ndarray) -> np.ndarray:
    """Return the array in memory that the scene will use, so that there is only one copy of it."""
    placed = np.asarray(jax.device_put(values).block_until_ready())
    gc.collect(0)  # only then does JAX free the array that it copied
    return placed


def _size(p: Row) -> tuple[int, int]:
    """Return height and width of the image."""
    height = len(p.rows)
    return height, len(p.columns) // (height - 1) - 1


def _patch(p: Row, d: Float[Array, "3"]) -> tuple[Int[Array, "2"], Float[Array, "2"], Float[Array, ""]]:
    """Return the patch of a direction (row, column), where the direction lies in it (below and beside its first texel),
    and how far down it lies in terms of solid angle."""
    height, width = _size(p)
    v = compute_once(d @ p.to_world)
    squared = v[0] * v[0] + v[2] * v[2]
    # Nearer to a pole the azimuth is only rounding error, and its derivative would overflow.
    x, z = jnp.where(squared > jnp.finfo(d.dtype).eps ** 2, jnp.stack([v[0], v[2]]), 0)
    polar = safe_atan2(safe_sqrt(x * x + z * z), v[1]) * ((height - 1) / math.pi)
    beside = turns(x, -z) * width - jnp.asarray(0.5, d.dtype)
    beside = jnp.where(beside < 0, beside + width, beside)
    place = compute_once(jnp.stack([polar, beside]))
    first = jnp.clip(place.astype(jnp.int32), 0, jnp.array([height - 2, width - 1], jnp.int32))
    upper, lower = _ends(p, first[0])
    from_pole = squared / (1 + jnp.abs(v[1]))
    from_pole = jnp.where((v[1] >= 0) == (2 * first[0] <= height - 2), from_pole, 2 - from_pole)
    down = jnp.clip((from_pole - upper) / (lower - upper), 0, 1)
    return compute_once((first, place - first, lax.stop_gradient(down)))


def _probabilities(texels: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the columns TABLED from the texels."""
    height, width, _ = texels.shape
    theta = np.linspace(0, np.pi, height)
    # For each row of patches: solid angle over 2 pi, and the integrals of sin weighted by 1 - t and by t.
    solid = 2 * np.sin((theta[:-1] + theta[1:]) / 2) * np.sin(np.diff(theta) / 2)
    lower = np.diff(np.sin(theta)) / np.diff(theta) - np.cos(theta[1:])
    upper = solid - lower
    importance = _luminances(texels)
    of_rows = importance.mean(1, dtype=np.float64)
    brightness = float(of_rows[:-1] @ upper + of_rows[1:] @ lower) / 2
    columns, mass = _unfilled((height - 1, width + 1), texels.dtype), np.empty(height - 1)
    for first in range(0, height, _ROWS):
        part = importance[first : first + _ROWS]
        np.maximum(part - brightness, _KEPT * part, out=part)
    for first in range(0, height - 1, _ROWS):
        rows = slice(first, min(first + _ROWS, height - 1))
        both = importance[first : rows.stop + 1].astype(np.float64)
        both += np.roll(both, -1, axis=1)
        patches = both[:-1] * upper[rows, None] + both[1:] * lower[rows, None]
        columns[rows], mass[rows] = cumulated(patches), patches.sum(1)
    rows = cumulated(np.where(mass.any(), mass, solid))
    per_solid_angle = np.diff(rows) / (solid * (2 * np.pi / width))
    return {
        "importance": importance.ravel(),
        "rows": rows,
        "columns": columns.ravel(),
        "from_pole": 2 * np.sin(np.minimum(theta, np.pi - theta) / 2) ** 2,
        "per_solid_angle": per_solid_angle,
        "brightness": np.asarray([brightness]),
    }


def _luminances(texels: np.ndarray) -> np.ndarray:
    """Return the luminances (H, W) of texels, with little temporary memory."""
    found = _unfilled(texels.shape[:2], texels.dtype)
    for first in range(0, len(texels), _ROWS):
        found[first : first + _ROWS] = luminance(texels[first : first + _ROWS])
    return found


def _unfilled(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an uninitialised array that JAX need not copy once it is filled."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + _ALIGNED, np.uint8)
    start = -memory.ctypes.data % _ALIGNED
    return memory[start : start + size].view(dtype).reshape(shape)
