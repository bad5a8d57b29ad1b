"""What a scene file says: plain NumPy records between a loader (`io/`) and the compiled `Scene` (`scene.py`).

A loader fills these in world space and checks the file; `scene.build` groups them by kind. Colours are linear RGB.
Matrices are float64, (4, 4), acting on column vectors. `name` is the id that parameters are looked up by.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Bitmap:
    """An image over uv in [0, 1)^2; v points downwards, as Mitsuba's loader has it."""

    name: str
    texels: np.ndarray  # (H, W, 3) float32, linear
    to_uv: np.ndarray  # (3, 3) float64, applied to (u, v, 1) before the look-up
    interpolation: str = "bilinear"  # or "nearest"
    wrap: str = "repeat"  # or "mirror", "clamp"


@dataclass(frozen=True)
class Checkerboard:
    name: str
    color0: np.ndarray  # (3,)
    color1: np.ndarray  # (3,)
    to_uv: np.ndarray  # (3, 3) float64


@dataclass(frozen=True)
class Diffuse:
    """One-sided Lambertian reflector."""

    name: str
    reflectance: np.ndarray | Bitmap | Checkerboard  # (3,) where it is no texture


@dataclass(frozen=True)
class Dielectric:
    """Smooth interface; `int_ior` lies on the side that the normal points away from."""

    name: str
    int_ior: float
    ext_ior: float


@dataclass(frozen=True)
class Conductor:
    """Smooth one-sided mirror. `eta` and `k` None: an ideal mirror (Mitsuba's material "none")."""

    name: str
    eta: np.ndarray | None  # (3,)
    k: np.ndarray | None  # (3,)
    specular_reflectance: np.ndarray  # (3,)


@dataclass(frozen=True)
class Twosided:
    """A reflector for each side; the same object twice where the file names one."""

    name: str
    front: Diffuse | Conductor
    back: Diffuse | Conductor


BSDF = Diffuse | Dielectric | Conductor | Twosided


@dataclass(frozen=True)
class Sphere:
    center: np.ndarray  # (3,) float64, world
    radius: float
    to_world: np.ndarray  # carries the unit sphere at the origin; only its rotation matters further (uv)


@dataclass(frozen=True)
class Rectangle:
    """[-1, 1]^2 in the xy plane, normal +z, carried by `to_world`."""

    to_world: np.ndarray


@dataclass(frozen=True)
class Disk:
    """Unit disk in the xy plane, normal +z, carried by `to_world`."""

    to_world: np.ndarray


@dataclass(frozen=True)
class Cube:
    """[-1, 1]^3, normals outwards, carried by `to_world`."""

    to_world: np.ndarray


@dataclass(frozen=True)
class Mesh:
    """World-space triangles without degenerate ones; normals follow the transform and are unit."""

    vertices: np.ndarray  # (V, 3) float64
    faces: np.ndarray  # (F, 3) int64
    normals: np.ndarray | None  # (V, 3): smooth shading; None: face normals
    uv: np.ndarray | None  # (V, 2)
    dropped: int = 0  # degenerate triangles left out


@dataclass(frozen=True)
class Shape:
    name: str
    geometry: Sphere | Rectangle | Disk | Cube | Mesh
    bsdf: BSDF
    radiance: np.ndarray | None  # (3,) of its area emitter; None: it has none
    emitter_name: str  # "" where it has no emitter
    flip_normals: bool


@dataclass(frozen=True)
class Camera:
    """Perspective; a thin lens where `aperture_radius` is not None. Looks along +z, x to the left, y up (Mitsuba's)."""

    to_world: np.ndarray  # (4, 4)
    fov: float  # degrees, along fov_axis
    fov_axis: str = "x"  # "x", "y", "diagonal", "smaller", "larger"
    near_clip: float = 1e-2
    far_clip: float = 1e4
    principal_point_offset: tuple[float, float] = (0.0, 0.0)
    aperture_radius: float | None = None
    focus_distance: float | None = None


@dataclass(frozen=True)
class Film:
    width: int
    height: int
    crop: tuple[int, int, int, int]  # offset x, offset y, width, height
    filter: str = "gaussian"  # "box", "tent", "gaussian"
    filter_radius: float = 2.0  # pixels; box 0.5, tent 1 by default, gaussian 4 stddev
    filter_stddev: float = 0.5  # gaussian only


@dataclass(frozen=True)
class Integrator:
    max_depth: int = -1  # -1: unbounded; 1: emission only
    rr_depth: int = 5
    hide_emitters: bool = False


@dataclass(frozen=True)
class Description:
    file: str
    camera: Camera
    film: Film
    integrator: Integrator
    spp: int
    sampler: str  # the type that the file names; pathjax uses its own
    shapes: tuple[Shape, ...]
    background: np.ndarray | None  # (3,) radiance of the constant emitter
    background_name: str = ""
    notes: tuple[str, ...] = field(default=())  # what `info` should tell: dropped triangles, replaced samplers
