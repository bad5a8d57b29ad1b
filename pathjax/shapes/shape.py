"""The interface of shapes: as records of a scene file, while a scene is built, and in kernels.

Each kind stores its primitives twice: in `leaves`, K scalars of W primitives side by side for intersection in SIMD, and
as rows of its own arrays, for all queries about the one primitive that was hit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import at, dot, safe_divide, safe_sqrt
from pathjax.core.types import Hit, Ray, Surface
from pathjax.description.fields import Fields
from pathjax.kinds import Unused
from pathjax.shapes.accel.build import Tree as BuiltTree
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.coincident import Faces

# How far the squares of axes may be from equal, and axes from perpendicular, if a shape must stay round. Rotations with
# axes that files give to three digits stay within it.
ROUND = 5e-3

# ---- in scene files -------------------------------------------------------------------------------------------------


class Shape(ABC):
    """The record of one shape of a scene file, in world space; NumPy, float64."""

    table: ClassVar[type[Table]]  # holds its primitives
    # Mitsuba's weight for derivatives at silhouettes of moving shapes, which pathjax does not take.
    unused: ClassVar[Mapping[str, Unused]] = {"silhouette_sampling_weight": Unused("float", at_least=0)}
    triangles: ClassVar[bool] = False  # it has `vertices`, `faces`, `normals` and `uv`
    closed: ClassVar[bool] = False  # it has an inside
    comes_last: ClassVar[bool] = False  # in its table, after the primitives of other kinds
    attributes: Mapping[str, np.ndarray] = MappingProxyType({})  # (N, 3) by name, per vertex or face, for textures

    @classmethod
    @abstractmethod
    def read(cls, loader, fields: Fields) -> Shape:
        """Read the fields of an element; the loader reads its bsdf, its light and `flip_normals`."""

    @property
    def mirrored(self) -> bool:
        """Whether its transform turns it inside out, which in Mitsuba happens to spheres only."""
        return False

    @property
    def smooth(self) -> bool:
        """Whether it consists of flat pieces that are shaded as if they were curved."""
        return False

    @property
    def empty(self) -> bool:
        """Whether it has nothing that a ray could hit."""
        return False

    @abstractmethod
    def placed(self, to_world: np.ndarray) -> Shape | None:
        """Return the shape transformed by a further (4, 4), as in Mitsuba's instances: normals stay on their side.

        None: the result is degenerate or not finite.
        """

    @abstractmethod
    def primitives(self, flip: bool) -> Primitives:
        """Return the primitives of the shape. flip: reverse the normals."""


class Primitives(ABC):
    """The primitives of one shape, P of them, while a scene is built."""

    areas: np.ndarray  # (P,)
    one_lamp: ClassVar[bool] = False  # together they are one lamp, sampled uniformly in area; else each is a lamp

    @property
    def count(self) -> int:
        return len(self.areas)

    @abstractmethod
    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corners (P, 3) of their bounding boxes."""

    def facing(self) -> np.ndarray:
        """Return the integrals (P, 3) of the normal over their areas; 0 if they face all sides."""
        return np.zeros((self.count, 3))

    def faces(self, glass: bool, lamp: bool, dtype) -> Faces | None:
        """Return the flat faces, which may touch those of other shapes; None: the primitives are curved."""
        return None

    def move(self, moves: np.ndarray) -> None:
        """Shift the faces; moves: (F, 3), or (3,) for all."""
        raise NotImplementedError


# ---- in kernels -----------------------------------------------------------------------------------------------------


@register_dataclass
@dataclass(frozen=True)
class Lamps:
    """Shapes that emit: one row for each rectangle, disk, sphere, cylinder, face of a cube, and for each whole mesh."""

    table: Int[Array, " R"]  # into `tables`
    first: Int[Array, " R"]  # first row in that table
    count: Int[Array, " R"]  # number of rows: 1 except for meshes
    area: Float[Array, " R"]
    tables: tuple[int, ...] = field(metadata={"static": True})  # which tables of the geometry hold lamps


class LampSample(NamedTuple):
    """A point of a lamp as seen from another point."""

    d: Float[Array, "3"]  # unit, towards the point
    distance: Float[Array, ""]
    n: Float[Array, "3"]  # unit geometric normal there
    pdf: Float[Array, ""]  # 1/sr; 0 edge-on
    primitive: Int[Array, ""]  # index of the primitive; as returned by a table: the row


# A point of a primitive, its unit normal, and the rounding error of the point along that.
SurfacePoint = tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, ""]]


class Searched(ABC):
    """Primitives that rays search: one by one, or by a tree."""

    kind: ClassVar[str]  # name in reports
    leaves: Float[Array, "L K+1 W"]  # of `accel.leaves`: bits of K scalars, NaN in empty lanes; row of each lane
    tree: Tree | None  # None: every ray tests all leaves

    def prepare(self, o: Float[Array, "3"], d: Float[Array, "3"]):
        """Return constants of a ray from o in the unit direction d, for `intersect`."""
        return o, d

    @abstractmethod
    def intersect(
        self, leaf: Int[Array, ""], prepared, start: Int[Array, ""]
    ) -> tuple[Float[Array, " W"], Int[Array, " W"]]:
        """Intersect the W primitives of a leaf.

        Args:
            prepared: of `prepare`.
            start: row of the primitive that the ray starts on and must not hit again there; no valid row: none.
        Returns:
            distances, inf or NaN for a miss, possibly negative behind the origin; rows.
        """


class Table(Searched):
    """All primitives of one kind in a scene, P rows: a pytree."""

    attributes: Mapping[str, Float[Array, "P 3 3"]] = MappingProxyType({})  # by name, as `surface` returns them

    # Properties of the kind for transport between patches.
    polygons: ClassVar[bool] = False  # flat, with three or four straight edges: it implements `edges_and_normals`
    triangular: ClassVar[bool] = False  # divided into triangles, the same number along each edge
    even_chords: ClassVar[bool] = False  # a chord inside one primitive meets it at the same angle at both ends

    @classmethod
    @abstractmethod
    def build(
        cls, parts: list[Primitives], lit: list[bool], dtype, rule: str, margins
    ) -> tuple[Table, dict[str, BuiltTree | None]]:
        """Build the table, and return it with hierarchies by `kind`, for reports; None: there is none.

        Args:
            parts, lit: primitives by shape, and whether the shape emits.
            rule: of `accel.build`; margins: (P,) of `coincident`, or None.
        """

    @classmethod
    def own_margins(cls, parts: list[Primitives], dtype) -> np.ndarray:
        """Return the margins (P,) of primitives that have no `faces`."""
        raise NotImplementedError

    @property
    @abstractmethod
    def count(self) -> int: ...

    def by_row(self) -> dict[str, Any]:
        """Return the fields with one entry per primitive: arrays (P, ...), mappings to such arrays, or None."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("leaves", "tree")}
        return {name: value for name, value in values.items() if not isinstance(value, Searched)}

    def searched(self) -> list[Searched]:
        """Return the collections that rays search to find its primitives."""
        return [self] if len(self.leaves) else []

    @abstractmethod
    def surface(self, row: Int[Array, ""], o: Float[Array, "3"], d: Float[Array, "3"], t: Float[Array, ""]) -> Surface:
        """Return the surface of the primitive that a ray meets at distance t; the point lies on it to the last bits.

        Differentiable in the ray o, d; t only selects among intersections, and is not differentiated.
        """

    def corners(self, row: Int[Array, ""], o: Float[Array, "3"], d: Float[Array, "3"]):
        """Return `Surface.corners`; arbitrary for kinds without `attributes`."""
        return jnp.zeros_like(row), jnp.zeros_like(o)

    @abstractmethod
    def along_u(self, row: Int[Array, ""], surface: Surface) -> Float[Array, "3"]:
        """Return the direction, of any length, in which u grows and v is constant at `surface`, on this primitive."""

    # ---- light

    def sample(self, row: Int[Array, ""], u: Float[Array, "2"]) -> SurfacePoint:
        """Draw a point uniformly in area.

        Only kinds that inherit `sample_lamp` of this class must implement it.
        """
        raise NotImplementedError

    def sample_lamp(
        self, lamps: Lamps, lamp: Int[Array, ""], ref: Float[Array, "3"], u: Float[Array, "2"], u_part: Float[Array, ""]
    ) -> LampSample:
        """Draw a point of a lamp, row `lamp` of `lamps`, as seen from `ref`.

        u: uniform in [0, 1); u_part: chooses within a lamp of many primitives.
        """
        row, area = self.row_of_lamp(lamps, lamp, u_part), at(lamps.area, lamp)
        p, n, margin = compute_once(self.sample(row, u))
        # Offset the far end of a shadow ray from surfaces that touch the lamp, as its near end is.
        p = p + n * jnp.copysign(margin, dot(n, ref - p))
        to_p = p - ref
        squared = dot(to_p, to_p)
        distance = safe_sqrt(squared)
        d = to_p * safe_divide(1, distance)
        d, distance = compute_once((d, distance))
        return LampSample(d, distance, n, safe_divide(squared, jnp.abs(dot(n, d)) * area), row)

    def row_of_lamp(self, lamps: Lamps, lamp: Int[Array, ""], u_part: Float[Array, ""]) -> Int[Array, ""]:
        """Return the row of the primitive that a sample lies on."""
        return at(lamps.first, lamp)

    def lamp_density(
        self, lamps: Lamps, lamp: Int[Array, ""], first: int, ray: Ray, hit: Hit, surface: Surface
    ) -> Float[Array, ""]:
        """Return the density [1/sr] with which `sample_lamp`, from ray.o, draws the point that a ray hit.

        first: index of the first primitive of this table.
        """
        cos = jnp.abs(dot(surface.n, ray.d))
        return safe_divide(hit.t * hit.t, cos * at(lamps.area, lamp))

    # ---- patches

    def even(self) -> np.ndarray:
        """Return (P,) bool: whether `to_square` preserves area ratios. The methods below are called only if it does."""
        return np.ones(self.count, bool)

    def areas(self) -> np.ndarray:
        """Return the areas (P,), float64."""
        raise NotImplementedError

    def cell_lengths(self, size: float) -> np.ndarray:
        """Return lengths (P, 2) along the two coordinates of `to_square`, for cells about `size` long."""
        raise NotImplementedError

    def to_square(self, row: Int[Array, ""], p: Float[Array, "3"]) -> Float[Array, "2"]:
        """Return coordinates in [0, 1] of a point that preserve area ratios; for triangles two barycentrics."""
        raise NotImplementedError

    def from_square(self, row: Int[Array, ""], xy: Float[Array, "2"]) -> SurfacePoint:
        """Invert `to_square`."""
        raise NotImplementedError

    def edges_and_normals(self) -> tuple[np.ndarray, np.ndarray]:
        """For polygons, return a corner and the two edges at it (P, 3, 3), normals (P, 3) of any length; float64."""
        raise NotImplementedError
