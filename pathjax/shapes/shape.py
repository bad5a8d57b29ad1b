"""What a shape is: as a scene file has it, while a scene is built, and in kernels.

Each kind keeps its primitives twice: in `leaves`, K numbers of W primitives side by side for intersection in SIMD, and
as rows of its own arrays, for everything that is asked of the one primitive that was hit.
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

# How far the squares of axes may be from equal, and axes from upright, where a shape must stay round. Axes of rotations
# that files give by three digits leave it so.
ROUND = 5e-3

# ---- as a scene file has it -----------------------------------------------------------------------------------------


class Shape(ABC):
    """What a scene file says of one shape, in world space; NumPy, float64."""

    table: ClassVar[type[Table]]  # that its primitives go into
    # For derivatives at the edges of shapes that move, which are not taken here.
    unused: ClassVar[Mapping[str, Unused]] = {"silhouette_sampling_weight": Unused("float", at_least=0)}
    triangles: ClassVar[bool] = False  # it has `vertices`, `faces`, `normals` and `uv`
    closed: ClassVar[bool] = False  # it has an inside
    comes_last: ClassVar[bool] = False  # in its table, after what other kinds put there
    attributes: Mapping[str, np.ndarray] = MappingProxyType({})  # (N, 3) by name, of vertices or faces, for textures

    @classmethod
    @abstractmethod
    def read(cls, loader, fields: Fields) -> Shape:
        """Ask for what an element may hold; its bsdf, its light and `flip_normals` are the loader's."""

    @property
    def mirrored(self) -> bool:
        """Whether its transform turns it inside out, as Mitsuba's does spheres alone."""
        return False

    @property
    def smooth(self) -> bool:
        """Whether it is made of flat pieces that are shaded as if they were curved."""
        return False

    @property
    def empty(self) -> bool:
        """Whether there is nothing of it that a ray could meet."""
        return False

    @abstractmethod
    def placed(self, to_world: np.ndarray) -> Shape | None:
        """The shape carried by a further (4, 4), as Mitsuba's instances are, of which normals stay on their side.

        None: it would be no shape of its kind, or not finite.
        """

    @abstractmethod
    def primitives(self, flip: bool) -> Primitives:
        """flip: turn the normals around."""


class Primitives(ABC):
    """The primitives of one shape, P of them, while a scene is built."""

    areas: np.ndarray  # (P,)
    one_lamp: ClassVar[bool] = False  # they shine as one lamp, which is sampled uniformly in area; else each is one

    @property
    def count(self) -> int:
        return len(self.areas)

    @abstractmethod
    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners (P, 3) of boxes around them."""

    def facing(self) -> np.ndarray:
        """(P, 3) integrals of the normal over their areas; 0 of what faces all sides."""
        return np.zeros((self.count, 3))

    def faces(self, glass: bool, lamp: bool, dtype) -> Faces | None:
        """The flat faces, which may touch those of other shapes; None: they are curved."""
        return None

    def move(self, moves: np.ndarray) -> None:
        """Shift the faces; moves: (F, 3), or (3,) for all."""
        raise NotImplementedError


# ---- in kernels -----------------------------------------------------------------------------------------------------


@register_dataclass
@dataclass(frozen=True)
class Lamps:
    """Shapes that emit: a row for each rectangle, disk, sphere and face of a cube, and one for each whole mesh."""

    table: Int[Array, " R"]  # into `tables`
    first: Int[Array, " R"]  # first row in that table
    count: Int[Array, " R"]  # rows: 1 but for meshes
    area: Float[Array, " R"]
    tables: tuple[int, ...] = field(metadata={"static": True})  # which tables of the geometry hold lamps


class LampSample(NamedTuple):
    """A point of a lamp as seen from another point."""

    d: Float[Array, "3"]  # unit, towards it
    distance: Float[Array, ""]
    n: Float[Array, "3"]  # unit geometric normal there
    pdf: Float[Array, ""]  # 1/sr; 0 edge-on
    primitive: Int[Array, ""]  # of a table's own function: the row


# A point of a primitive, its unit normal, and the rounding error of the point along that.
SurfacePoint = tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, ""]]


class Searched(ABC):
    """Primitives that rays search: one by one, or by a tree."""

    kind: ClassVar[str]  # what reports call one of them
    leaves: Float[Array, "L K+1 W"]  # of `accel.leaves`: bits of K numbers, NaN in empty lanes; row of each lane
    tree: Tree | None  # None: every ray tests all leaves

    def prepare(self, o: Float[Array, "3"], d: Float[Array, "3"]):
        """Constants of a ray from o in the unit direction d, for `intersect`."""
        return o, d

    @abstractmethod
    def intersect(
        self, leaf: Int[Array, ""], prepared, start: Int[Array, ""]
    ) -> tuple[Float[Array, " W"], Int[Array, " W"]]:
        """Intersect the W primitives of a leaf.

        Args:
            prepared: of `prepare`.
            start: row of the primitive that the ray starts on, which it leaves for good, or of nothing here.
        Returns:
            distances, inf or NaN where missed, possibly negative where behind; rows.
        """


class Table(Searched):
    """All primitives of one kind in a scene, P rows: a pytree."""

    attributes: Mapping[str, Float[Array, "P 3 3"]] = MappingProxyType({})  # by name: those that `surface` tells

    # What of transport between patches is known of the kind.
    polygons: ClassVar[bool] = False  # flat, with three or four straight edges: `edges_and_normals` is its own
    triangular: ClassVar[bool] = False  # cut into triangles, of the same number along each edge
    even_chords: ClassVar[bool] = False  # inside one of it, a chord meets both its ends at one angle

    @classmethod
    @abstractmethod
    def build(
        cls, parts: list[Primitives], lit: list[bool], dtype, rule: str, margins
    ) -> tuple[Table, dict[str, BuiltTree | None]]:
        """The table, and hierarchies by `kind`, for reports; None: there is none.

        Args:
            parts, lit: primitives by shape, and whether the shape emits.
            rule: of `accel.build`; margins: (P,) of `coincident`, or None.
        """

    @classmethod
    def own_margins(cls, parts: list[Primitives], dtype) -> np.ndarray:
        """Margins (P,) of primitives that have no `faces`."""
        raise NotImplementedError

    @property
    @abstractmethod
    def count(self) -> int: ...

    def by_row(self) -> dict[str, Any]:
        """What has an entry for each primitive: fields, which are arrays (P, ...), mappings to such, or None."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("leaves", "tree")}
        return {name: value for name, value in values.items() if not isinstance(value, Searched)}

    def searched(self) -> list[Searched]:
        """What rays search to find its primitives."""
        return [self] if len(self.leaves) else []

    @abstractmethod
    def surface(self, row: Int[Array, ""], o: Float[Array, "3"], d: Float[Array, "3"], t: Float[Array, ""]) -> Surface:
        """What a ray sees on the primitive that it meets at the distance t; the point lies on it to the last bits.

        Differentiable in the ray o, d; t tells apart points, and is not differentiated.
        """

    def corners(self, row: Int[Array, ""], o: Float[Array, "3"], d: Float[Array, "3"]):
        """`Surface.corners`; of what has no `attributes`: any."""
        return jnp.zeros_like(row), jnp.zeros_like(o)

    @abstractmethod
    def along_u(self, row: Int[Array, ""], surface: Surface) -> Float[Array, "3"]:
        """The way, of any length, in which u of `surface`, a point of this primitive, grows and v does not."""

    # ---- light

    def sample(self, row: Int[Array, ""], u: Float[Array, "2"]) -> SurfacePoint:
        """Draw a point uniformly in area.

        Of kinds that keep the `sample_lamp` of this class.
        """
        raise NotImplementedError

    def sample_lamp(
        self, lamps: Lamps, lamp: Int[Array, ""], ref: Float[Array, "3"], u: Float[Array, "2"], u_part: Float[Array, ""]
    ) -> LampSample:
        """Draw a point of the lamp of this row of `lamps`, as seen from `ref`.

        u: uniform in [0, 1); u_part: chooses within a lamp of many primitives.
        """
        row, area = self.row_of_lamp(lamps, lamp, u_part), at(lamps.area, lamp)
        p, n, margin = compute_once(self.sample(row, u))
        # The far end of a shadow ray stays clear of what touches the lamp, as its near end does.
        p = p + n * jnp.copysign(margin, dot(n, ref - p))
        to_p = p - ref
        squared = dot(to_p, to_p)
        distance = safe_sqrt(squared)
        d = to_p * safe_divide(1, distance)
        d, distance = compute_once((d, distance))
        return LampSample(d, distance, n, safe_divide(squared, jnp.abs(dot(n, d)) * area), row)

    def row_of_lamp(self, lamps: Lamps, lamp: Int[Array, ""], u_part: Float[Array, ""]) -> Int[Array, ""]:
        """The row of the primitive that a sample lies on."""
        return at(lamps.first, lamp)

    def lamp_density(
        self, lamps: Lamps, lamp: Int[Array, ""], first: int, ray: Ray, hit: Hit, surface: Surface
    ) -> Float[Array, ""]:
        """Density [1/sr] with which `sample_lamp`, seen from ray.o, finds the point that a ray hit.

        first: number of the first primitive of this table.
        """
        cos = jnp.abs(dot(surface.n, ray.d))
        return safe_divide(hit.t * hit.t, cos * at(lamps.area, lamp))

    # ---- patches

    def even(self) -> np.ndarray:
        """(P,) bool: whether equal areas are equal in a square, as the methods below say; of others none is called."""
        return np.ones(self.count, bool)

    def areas(self) -> np.ndarray:
        """(P,) float64."""
        raise NotImplementedError

    def cell_lengths(self, size: float) -> np.ndarray:
        """(P, 2) lengths along the two coordinates of `to_square`, cells being about `size` long."""
        raise NotImplementedError

    def to_square(self, row: Int[Array, ""], p: Float[Array, "3"]) -> Float[Array, "2"]:
        """Coordinates in [0, 1], in which equal areas are equal, of a point; of triangles two barycentric ones."""
        raise NotImplementedError

    def from_square(self, row: Int[Array, ""], xy: Float[Array, "2"]) -> SurfacePoint:
        """The inverse."""
        raise NotImplementedError

    def edges_and_normals(self) -> tuple[np.ndarray, np.ndarray]:
        """For polygons: a corner and the two edges from there (P, 3, 3), and normals (P, 3) of any length; float64."""
        raise NotImplementedError
