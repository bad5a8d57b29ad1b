"""The transport operator of a diffuse scene divided into patches, and solvers of L = Le + T L.

Radiance is constant on each patch (Galerkin's method with constants; Goral et al. 1984). With the form factors

    F_ij = 1 / A_i  integral over i and j of  cos cos visible / (pi r^2),        A_i F_ij = A_j F_ji,

the light that leaves patch i is L_i = Le_i + rho_i sum_j F_ij L_j, so (T L)_i = rho_i (F L)_i.

There are two separate errors: that of the form factors, which `Operator.error` estimates, and that of the patches,
which falls with their size h: as h at a point, as h^2 in means over many patches where the light is smooth. The latter
is not estimated here; refine and compare to measure it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax

from pathjax import bsdfs, emitters
from pathjax.compile import is_traced, register_dataclass, standard_promotion
from pathjax.core.math import safe_divide
from pathjax.errors import InputError
from pathjax.integrators.options import check_counts
from pathjax.scene.parameters import attached
from pathjax.scene.scene import Scene
from pathjax.transport import factors as dense_factors
from pathjax.transport import rays as ray_casting
from pathjax.transport.control import Control
from pathjax.transport.patches import Patches, cut_scene
from pathjax.transport.view import Radiosity, radiosity

# Methods for form factors, and their default number of rays: per pair of patches, per patch.
METHODS = {"dense": 32, "rays": 256}
# A dense matrix of more patches than this takes long to fill.
_DENSE_PATCHES = 2048
# Rays per patch that test whether a scene is closed.
_PROBES = 64
_SCALINGS = 100
_RESTART = 20
_MAX_RESTARTS = 100
_MOST_POWERS = 10_000
_MOST_TERMS = 100_000


@register_dataclass
@dataclass(frozen=True)
class Dense:
    """Form factors, and their errors, as matrices."""

    matrix: jax.Array  # (U, U) F_ij
    errors: jax.Array  # (U, U)

    def mv(self, x):
        return jnp.matmul(self.matrix, x, precision=lax.Precision.HIGHEST)

    def squared_errors_mv(self, x):
        return jnp.matmul(self.errors**2, x, precision=lax.Precision.HIGHEST)


@register_dataclass
@dataclass(frozen=True)
class Sparse:
    """Form factors of the pairs that some ray joins, by row: memory grows with the number of rays, not of pairs.

    Errors are those of the ray counts; pairs that no ray joins have no error estimate.
    """

    row: jax.Array  # (K,) int32, ascending
    column: jax.Array  # (K,) int32
    value: jax.Array  # (K,) F_ij
    errors: jax.Array  # (K,)

    def mv(self, x):
        return self._sum(self.value, x)

    def squared_errors_mv(self, x):
        return self._sum(self.errors**2, x)

    def _sum(self, weights, x):
        terms = weights.reshape(-1, *[1] * (x.ndim - 1)) * x[self.column]
        return jax.ops.segment_sum(terms, self.row, x.shape[0], indices_are_sorted=True)


class Solution(NamedTuple):
    L: jax.Array  # (U, 3) radiance that leaves the patches, W m^-2 sr^-1
    residual: jax.Array  # () |Le + T L - L| / |Le|


@register_dataclass
@dataclass(frozen=True)
class Operator:
    """T of a scene with U patches and 3 channels; a pytree, which may be passed to jitted functions."""

    patches: Patches
    factors: Dense | Sparse
    albedo: jax.Array  # (U, 3)
    Le: jax.Array  # (U, 3) radiance that the patches emit

    @property
    def area(self) -> jax.Array:
        """(U,) of each patch."""
        return self.patches.area

    @property
    def F(self) -> lx.AbstractLinearOperator:
        """Form factors, an operator on (U,); for few patches, `as_matrix()` shows them."""
        if isinstance(self.factors, Dense):
            return lx.MatrixLinearOperator(self.factors.matrix)
        structure = jax.ShapeDtypeStruct(self.area.shape, self.area.dtype)
        return lx.FunctionLinearOperator(self.factors.mv, structure)

    @property
    def T(self) -> lx.FunctionLinearOperator:
        """One bounce, an operator on (U, 3): maps light that leaves the patches to light that they then reflect."""
        return self._function(lambda L: self.albedo * self.factors.mv(L))

    @property
    def adjoint(self) -> lx.FunctionLinearOperator:
        """T*, with <T f, g> = <f, T* g> for <f, g> = sum over patches of A f g: it transports importance backwards."""
        return self._function(lambda g: self.factors.mv(self.albedo * g))

    def _function(self, f):
        return lx.FunctionLinearOperator(f, jax.ShapeDtypeStruct(self.Le.shape, self.Le.dtype))

    @standard_promotion
    def with_scene(self, scene: Scene) -> Operator:
        """Return the operator with the reflectances and radiances, perhaps traced, of a scene of the same shapes."""
        return replace(self, **dict(zip(("albedo", "Le"), _albedos_and_lights(scene, self.patches), strict=True)))

    def radiosity(self, L) -> Radiosity:
        """Return light L (U, 3) on the patches for `transport.image` and `transport.radiance`."""
        return radiosity(self.patches, L)

    @standard_promotion
    def control(self, L, effort: float = 2.0) -> Control:
        """Return light L (U, 3), ideally the solution, as a control variate for `pathjax.render`; see `control`.

        effort: survival where all of a path's light is still to be found; a higher one gives longer, less noisy paths.
        """
        return Control(self.radiosity(self.T.mv(L)), jnp.asarray(effort, self.Le.dtype))

    @standard_promotion
    def error(self, L) -> jax.Array:
        """Return the standard error (U, 3) of T L due to the errors of the form factors, for light L (U, 3)."""
        return self.albedo * jnp.sqrt(self.factors.squared_errors_mv(L**2))

    @standard_promotion
    def terms(self, depth: int) -> jax.Array:
        """Return Le, T Le, T^2 Le, ... as (depth, U, 3): light reflected 0, 1, ... times. depth: at least 1."""
        _check_depth(depth)
        return lax.scan(lambda term, _: (self.T.mv(term), term), self.Le, length=depth)[1]

    @standard_promotion
    def spectral_radius(self) -> jax.Array:
        """Return the largest eigenvalue of T per channel (3,), by the power method; below 1 if the light dies out."""
        return _spectral_radius(self)

    @standard_promotion
    def solve(self, method: str = "gmres", depth: int | None = None, tolerance: float | None = None) -> Solution:
        """Solve for L = (I - T)^-1 Le.

        Args:
            method: "gmres" (all bounces, by lineax) or "neumann" (the first `depth` terms of Le + T Le + ...).
            depth: number of terms, counted as in `max_depth`; None: as many as leave less than `tolerance`.
            tolerance: of the residual, relative to the largest radiance emitted; None: 16 rounding errors.
        Returns:
            Solution. If rounding limits the accuracy, `residual` shows what the solver reached.
        Raises:
            InputError: unknown method, a depth below 1, or light that does not die out: a spectral radius of 1 (not
                checked if albedos are traced).
        Differentiable in albedo and Le in both modes, for "gmres" by differentiating the equation, not the solver.
        """
        tolerance = 16 * float(jnp.finfo(self.Le.dtype).eps) if tolerance is None else tolerance
        if method == "neumann" and depth is not None:
            L = self.terms(depth).sum(0)
        elif method == "neumann":
            L = _add_terms(self, self._terms_for(tolerance))
        elif method != "gmres":
            raise InputError(f'method {method!r} is unknown; use "gmres" or "neumann"')
        elif depth is not None:
            raise InputError('a depth goes with method="neumann"; GMRES finds the sum of all terms')
        else:
            self._check_radius()
            L = _gmres(self, tolerance)
        return Solution(L, _residual(self, L))

    def _terms_for(self, tolerance):
        radius = self._check_radius()
        if radius is None:
            raise InputError('method="neumann" of a traced operator needs a depth')
        terms = 1 if radius == 0 else 1 + int(np.ceil(np.log(tolerance * (1 - radius)) / np.log(radius)))
        return min(max(terms, 1), _MOST_TERMS)

    def _check_radius(self) -> float | None:
        """Return the largest spectral radius, None if traced; refuse one of 1, with an InputError."""
        if any(is_traced(x) for x in jax.tree.leaves((self.factors, self.albedo))):
            return None
        radius = float(self.spectral_radius().max())
        # Closer to 1, the solution is mostly rounding error.
        if radius > 1 - 100 * float(jnp.finfo(self.Le.dtype).eps):
            raise InputError(
                f"the spectral radius of the operator is {radius:.6f}: light in this scene does not die out, and "
                "(I - T)^-1 does not exist. Give some surface an albedo below 1, or open the scene"
            )
        return radius

    @standard_promotion
    def residual_history(self, steps: int, method: str = "gmres") -> np.ndarray:
        """Return |Le + T L - L| / |Le| for L composed of Le, T Le, ..., T^(k-1) Le, k = 0, ..., steps: (steps + 1,).

        method: "gmres": the best L by least squares, without restarts; or "neumann": their sum.
        """
        _check_depth(steps)
        if method == "neumann":
            norms = np.asarray(jax.vmap(_norm)(self.terms(steps + 1)))
            return norms / norms[0]
        if method != "gmres":
            raise InputError(f'method {method!r} is unknown; use "gmres" or "neumann"')
        return _krylov_residuals(self, steps)


@standard_promotion
def operator(
    scene: Scene,
    patches: int = 1000,
    method: str | None = None,
    rays: int | None = None,
    seed: int = 0,
    faceted: bool = False,
) -> Operator:
    """Build the transport operator of a diffuse scene.

    Args:
        patches: approximate number of cells of about equal area that the scene is divided into; each primitive is at
            least one.
        method: "dense" (polygons, or the inside of one sphere: exact form factors, up to some thousand patches), "rays"
            (any shapes; form factors by ray casting, kept for the pairs that rays join), or None: chosen by the scene.
        rays: for "dense", rays per pair of patches that something may hide from each other, 32 if None; for "rays",
            mean number of rays per patch, 256 if None.
        seed: other seeds give independent rays.
        faceted: treat meshes with smooth normals as flat triangles, instead of refusing them.
    Raises:
        InputError: a shape, which is named, is not diffuse or has area 0; an argument is out of range.
    One-sided surfaces are black from behind, as in the renderer. Do not call it in jitted functions, since shapes
    cannot be traced; use `Operator.with_scene` there to change colours.
    """
    cells = cut_scene(scene, patches, faceted)
    if method is None:
        few = cells.count <= _DENSE_PATCHES and cells.first.shape[0] <= dense_factors.MOST_BLOCKERS
        method = "dense" if few and dense_factors.are_exact(scene) else "rays"
    if method not in METHODS:
        raise InputError(f"method {method!r} is unknown; use one of {', '.join(METHODS)}")
    rays = METHODS[method] if rays is None else rays
    check_counts(rays, seed, "rays")
    area = np.asarray(cells.area, float)
    if method == "dense":
        exchange, errors, closed = dense_factors.form_factors(scene, cells, rays, seed)
        if closed is None:
            closed = not ray_casting.cast(scene, cells, _PROBES, seed)[2].any()
    else:
        counts, sent, lost = ray_casting.cast(scene, cells, rays, seed)
        exchange, errors = ray_casting.exchange(counts, sent / area)
        closed = not lost.any()
    scale = _closing(exchange, area) if closed else np.ones_like(area)
    dtype = cells.area.dtype
    if method == "dense":
        factors = Dense(*(jnp.asarray(x * scale[:, None] * scale / area[:, None], dtype) for x in (exchange, errors)))
    else:
        i, j = exchange.row, exchange.col
        values = (jnp.asarray(x * scale[i] * scale[j] / area[i], dtype) for x in (exchange.data, errors))
        factors = Sparse(jnp.asarray(i, jnp.int32), jnp.asarray(j, jnp.int32), *values)
    return Operator(cells, factors, *_albedos_and_lights(scene, cells))


def _closing(exchange, area):
    """Return factors (U,) of rows and columns that make the rows of a symmetric matrix sum to the areas.

    For a closed scene, where errors of the form factors would create or lose light (van Leersum 1989, for two such
    sums).
    """
    scale = np.ones_like(area)
    for _ in range(_SCALINGS):
        wrong = scale * (exchange @ scale) / area
        if np.abs(wrong - 1).max() < np.finfo(float).eps * len(area):
            break
        scale /= np.sqrt(np.where(wrong > 0, wrong, 1))
    return scale


def _albedos_and_lights(scene: Scene, patches: Patches):
    """Return albedo (U, 3) and emitted radiance (U, 3) of the patches."""
    scene = attached(scene)
    _, column = bsdfs.reflectances(scene.materials) or (None, None)
    lights = emitters.even_lights(scene.emitters)
    black = jnp.asarray(np.zeros((patches.count, 3), patches.area.dtype))
    albedo = black if column is None else _rows(column.values, patches.row)
    return albedo, black if lights is None else _rows(lights.table.column("radiance").values, patches.emitter)


@jax.jit
def _rows(table, rows):
    # Row -1, none, is the black row at the end.
    return jnp.concatenate([table, jnp.zeros_like(table[:1])])[rows]


def _check_depth(depth):
    if isinstance(depth, bool) or not isinstance(depth, int) or depth < 1:
        raise InputError(f"depth = {depth!r}; a series has at least 1 term, which is the emission")


def _norm(x):
    return jnp.sqrt(jnp.sum(x * x))


@jax.jit
def _residual(op: Operator, L):
    return safe_divide(_norm(op.Le + op.T.mv(L) - L), _norm(op.Le))


@jax.jit
def _spectral_radius(op: Operator):
    # T is symmetric in the inner product with weights A / albedo. There the norms of T^k L grow by increasing factors,
    # towards the radius, even if -radius is an eigenvalue (two plates that see only each other).
    tiny = jnp.finfo(op.Le.dtype).tiny

    def norm(x):  # of albedo * x
        return jnp.sqrt(jnp.sum(op.area[:, None] / jnp.sum(op.area) * op.albedo * x * x, 0))

    def step(state):
        k, x, last, _ = state
        y = op.factors.mv(op.albedo * x)
        size = norm(y)
        return k + 1, y / jnp.maximum(size, tiny), size, last

    def going(state):
        k, _, now, last = state
        return (k < 3) | (k < _MOST_POWERS) & jnp.any(now - last > jnp.finfo(now.dtype).eps * now)

    x = jnp.ones_like(op.Le)
    x = x / jnp.maximum(norm(x), tiny)
    zero = jnp.zeros((3,), op.Le.dtype)
    return lax.while_loop(going, step, (0, x, zero, zero))[2]


@partial(jax.jit, static_argnames="count")
def _add_terms(op: Operator, count):
    def step(state, _):
        term, total = state
        term = op.T.mv(term)
        return (term, total + term), None

    return lax.scan(step, (op.Le, op.Le), length=count - 1)[0][1]


@jax.jit
def _gmres(op: Operator, tolerance):
    # Scale radiances to order 1 per channel: the tolerance is then relative, and valid for patches that emit nothing.
    scale = lax.stop_gradient(jnp.max(op.Le, 0))
    scale = jnp.where(scale > 0, scale, 1)
    equation = op._function(lambda L: L - op.T.mv(L))
    solver = lx.GMRES(rtol=tolerance, atol=tolerance, restart=_RESTART, max_steps=_MAX_RESTARTS)
    return lx.linear_solve(equation, op.Le / scale, solver, throw=False).value * scale


def _krylov_residuals(op: Operator, steps):
    """Run Arnoldi's process (Saad and Schultz 1986), with its small matrix in float64."""
    apply = jax.jit(lambda op, L: L - op.T.mv(L))
    size = float(_norm(op.Le))
    basis = [op.Le / size]
    H = np.zeros((steps + 1, steps))
    residuals = [1.0]
    for k in range(steps):
        v = apply(op, basis[k])
        for _ in range(2):  # twice, against rounding errors
            for i, q in enumerate(basis):
                along = jnp.vdot(q, v)
                H[i, k] += along
                v = v - along * q
        H[k + 1, k] = _norm(v)
        basis.append(v / jnp.maximum(_norm(v), jnp.finfo(v.dtype).tiny))
        target = np.eye(k + 2, 1)[:, 0]
        small = H[: k + 2, : k + 1]
        best, *_ = np.linalg.lstsq(small, target, rcond=None)
        residuals.append(np.linalg.norm(target - small @ best))
    return np.array(residuals)
