"""The twelve scenes of `pathjax bench` without a scene argument: five shipped ones, and seven generated here.

Generated scenes depend only on this file and trimesh's icosphere, so the same scenes are measured everywhere.
The shipped nine_spheres.xml is not among them: Mitsuba's float32 makes it up to 10 % too dark, which would count as
error.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pathjax.errors import InputError
from pathjax.images import write_exr, write_png
from pathjax.io.mesh import load, ply_writer
from pathjax.shapes import Mesh
from pathjax.system.files import write_text

SHIPPED = "cornell_box", "glass_and_mirror", "glass_ball", "mesh", "triangle_box"
# Sampling of all twelve, unless users choose other values.
RES, SPPS, REFERENCE_SPP = 128, [64], 2048

_HEAD = """\
<scene version="3.0.0">
    <default name="res" value="256"/>
    <default name="spp" value="64"/>
    <default name="max_depth" value="{depth}"/>
    <integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="{fov}"/>
        <float name="near_clip" value="0.001"/>
        <transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$res"/>
            <integer name="height" value="$res"/>
            <rfilter type="box"/>
        </film>
    </sensor>
"""


def twelve(folder: Path, bunny: Path | None = None) -> list[Path]:
    """Return the files of the twelve scenes, after writing seven of them into `folder`.

    Args:
        bunny: a mesh, upright along y, for the box, in place of the generated one of about as many triangles.
    Raises:
        InputError: the shipped scenes are neither in the working directory nor beside the package, or the mesh is
            unusable.
    """
    shipped = _shipped()
    makers: dict[str, Callable[[Path], str]] = {
        "blob": blob,
        "million": million,
        "sky": sky,
        "lights": lights,
        "rough": rough,
        "caustics": caustics,
        "window": window,
    }
    if bunny is not None:
        makers = {"bunny": lambda folder: scan(folder, bunny)} | makers
        del makers["blob"]
    made = []
    for name, make in makers.items():
        made.append(folder / f"{name}.xml")
        write_text(made[-1], make(folder))
    return [shipped / f"{name}.xml" for name in SHIPPED] + made


def _shipped() -> Path:
    """Return the folder of the shipped scenes."""
    places = [Path("scenes"), Path(__file__).resolve().parents[2] / "scenes"]
    for place in places:
        if all((place / f"{name}.xml").is_file() for name in SHIPPED):
            return place
    raise InputError(
        f"the scenes {', '.join(SHIPPED)} are neither in {places[0].resolve()} nor in {places[1]}; "
        "run this in a clone of pathjax, or name scenes"
    )


# ---- the scenes ----------------------------------------------------------------------------------------------------


def blob(folder: Path, level: int = 6) -> str:
    """A solid of 20 * 4^level triangles in the Cornell box."""
    return _in_box(folder / "blob.ply", *bumpy(level, waves=12))


def million(folder: Path, level: int = 8) -> str:
    """The solid of `blob` with finer ridges, in 1.3 million triangles."""
    return _in_box(folder / "million.ply", *bumpy(level, waves=40))


def scan(folder: Path, file: Path) -> str:
    """A user's mesh in the Cornell box."""
    kind = file.suffix[1:].lower()
    if kind not in ("obj", "ply", "stl"):
        raise InputError(f"{file}: a mesh for the box is an .obj, .ply or .stl file")
    mesh, _ = load(file, kind, np.eye(4))
    return _in_box(folder / "bunny.ply", mesh.vertices, mesh.faces)


def sky(folder: Path) -> str:
    """Textured shapes under a sky environment map."""
    _write_sky(folder / "sky.exr")
    _write_clouds(folder / "ground.png", [0.2, 0.3, 0.1], [0.6, 0.5, 0.35], seed=1)
    _write_clouds(folder / "stone.png", [0.15, 0.1, 0.1], [0.8, 0.7, 0.6], seed=2)
    _write_clouds(folder / "paint.png", [0.1, 0.2, 0.5], [0.7, 0.75, 0.8], seed=3)
    paint = _picture("diffuse_reflectance", "paint.png", 2)
    return _scene(
        _head("4, 2.2, 7", "0, 0.7, 0", fov=38),
        _environment("sky.exr", 1),
        _bsdf("ground", "diffuse", _picture("reflectance", "ground.png", 4)),
        _bsdf("stone", "diffuse", _picture("reflectance", "stone.png", 1)),
        _bsdf("paint", "roughplastic", '<string name="distribution" value="ggx"/>' + _number("alpha", 0.2) + paint),
        _rectangle("floor", "ground", (12, 12), (0, 0, 0), (0, 1, 0)),
        _rectangle("wall", "stone", (3, 1.6), (-1, 1.6, -2.5), (0, 0, 1)),
        _sphere("ball", "paint", (-1.2, 0.8, 0.5), 0.8),
        _sphere("small", "stone", (1.5, 0.45, 1.8), 0.45),
        _cube("block", "paint", (0.5, 0.9, 0.5), (1.1, 0.9, -0.3), 30),
    )


def lights(folder: Path) -> str:
    """A hall with many small lamps, some of them close to walls."""
    rng = np.random.default_rng(0)
    body = [
        _bsdf("paper", "diffuse", _rgb("reflectance", (0.7, 0.68, 0.62))),
        _bsdf("clay", "diffuse", _rgb("reflectance", (0.55, 0.25, 0.18))),
        _bsdf("black", "diffuse", _rgb("reflectance", (0, 0, 0))),
        *_room("paper", "paper", (8, 3, 8)),
    ]
    for k in range(12):
        x, z, height = *rng.uniform(-7, 7, 2), rng.uniform(0.4, 2)
        body.append(_cube(f"block-{k}", "clay", (0.4, height, 0.4), (x, height, z - 1), rng.uniform(0, 90)))
    for k in range(200):
        at, facing = rng.uniform((-7.8, 0.2, -7.8), (7.8, 5.8, 5)), rng.normal(size=3)
        shine = _area(rng.uniform(0.2, 1, 3) * 60)
        body.append(_rectangle(f"lamp-{k}", "black", (0.08, 0.08), at, facing / np.linalg.norm(facing), shine))
    return _scene(_head("0, 3, 7.9", "0, 2.2, 0", fov=70), *body)


def rough(folder: Path) -> str:
    """Rough metals and plastics under a bright lamp and a large one."""
    metals = {"gold": ("Au", 0.1), "copper": ("Cu", 0.3), "aluminium": ("Al", 0.03)}
    plastics = {"red": ((0.5, 0.05, 0.04), 0.1), "blue": ((0.05, 0.12, 0.45), 0.3)}
    ggx = '<string name="distribution" value="ggx"/>'
    body = [_bsdf("paper", "diffuse", _rgb("reflectance", (0.5, 0.5, 0.5)))]
    for name, (material, alpha) in metals.items():
        inside = f'<string name="material" value="{material}"/>' + ggx + _number("alpha", alpha)
        body.append(_bsdf(name, "roughconductor", inside))
    for name, (color, alpha) in plastics.items():
        body.append(_bsdf(name, "roughplastic", ggx + _rgb("diffuse_reflectance", color) + _number("alpha", alpha)))
    body.append(_bsdf("green", "plastic", _rgb("diffuse_reflectance", (0.1, 0.4, 0.12))))
    for k, name in enumerate([*metals, *plastics, "green"]):
        body.append(_sphere(f"ball-{k}", name, (2.2 * (k % 3) - 2.2, 0.9, 1.2 - 2.4 * (k // 3)), 0.9))
    return _scene(
        _head("0, 4.6, 9", "0, 0.7, -0.2", fov=46),
        *body,
        _rectangle("floor", "paper", (10, 10), (0, 0, 0), (0, 1, 0)),
        _rectangle("wall", "paper", (10, 5), (0, 5, -5), (0, 0, 1)),
        _rectangle("large", "paper", (2.5, 1.5), (-5, 5, 3), (0.7, -0.6, -0.4), _area((4, 4, 4.5))),
        _sphere("bright", "paper", (3.5, 4, 2), 0.25, _area((120, 90, 60))),
        '<emitter type="constant">' + _rgb("radiance", (0.1, 0.12, 0.15)) + "</emitter>",
    )


def caustics(folder: Path) -> str:
    """Clear glass in a box under a wide lamp."""
    return _scene(
        _head("0, 1.1, 4.2", "0, 0.85, 0", fov=36, depth=12),
        *_BOX_BSDFS,
        _bsdf("glass", "dielectric", _number("int_ior", 1.5) + _number("ext_ior", 1)),
        *_room("white", "white", (1, 1, 1), "red", "green", open_front=True),
        _rectangle("lamp", "white", (0.4, 0.4), (0, 1.98, 0), (0, -1, 0), _area((7, 6.6, 6))),
        _sphere("ball", "glass", (-0.4, 0.42, 0.2), 0.4),
        _sphere("marble", "glass", (0.15, 0.22, 0.6), 0.2),
        _cube("block", "glass", (0.22, 0.5, 0.22), (0.45, 0.52, -0.2), 25),
    )


def window(folder: Path) -> str:
    """A room lit only by the sky, through the window through which the camera looks."""
    _write_sky(folder / "window_sky.exr")
    _write_clouds(folder / "wood.png", [0.25, 0.12, 0.05], [0.6, 0.4, 0.22], seed=4)
    # Solid walls: Mitsuba ends shadow rays to the sky at its bounding box of all shapes but rectangles.
    walls = {
        "ground": ((3.1, 0.05, 3.1), (0, -0.05, 0)),
        "ceiling": ((3.1, 0.05, 3.1), (0, 3.05, 0)),
        "back": ((3.1, 1.5, 0.05), (0, 1.5, -3.05)),
        "left": ((0.05, 1.5, 3), (-3.05, 1.5, 0)),
        "right": ((0.05, 1.5, 3), (3.05, 1.5, 0)),
        "below-window": ((3.1, 0.5, 0.05), (0, 0.5, 3.05)),
        "above-window": ((3.1, 0.3, 0.05), (0, 2.7, 3.05)),
        "left-of-window": ((0.95, 0.7, 0.05), (-2.15, 1.7, 3.05)),
        "right-of-window": ((0.95, 0.7, 0.05), (2.15, 1.7, 3.05)),
    }
    return _scene(
        _head("0.3, 1.8, 3.2", "-0.3, 1.2, 0", fov=75),
        _environment("window_sky.exr", 1),
        _bsdf("paper", "diffuse", _rgb("reflectance", (0.75, 0.74, 0.7))),
        _bsdf("wood", "diffuse", _picture("reflectance", "wood.png", 3)),
        _bsdf("cloth", "diffuse", _rgb("reflectance", (0.2, 0.3, 0.5))),
        *(_cube(name, "paper", half, at, 0) for name, (half, at) in walls.items()),
        _rectangle("floor", "wood", (3, 3), (0, 0.002, 0), (0, 1, 0)),
        _cube("table", "wood", (0.9, 0.05, 0.5), (-0.8, 0.8, -0.8), 10),
        _cube("chest", "cloth", (0.5, 0.5, 0.4), (1.8, 0.5, -1.8), -20),
        _sphere("bowl", "cloth", (-0.7, 1.05, -0.8), 0.2),
    )


# ---- parts of the scenes -------------------------------------------------------------------------------------------


def _scene(*parts: str) -> str:
    return "\n    ".join(parts) + "\n</scene>\n"


def _head(origin: str, target: str, fov: float, depth: int = 8) -> str:
    return _HEAD.format(origin=origin, target=target, fov=fov, depth=depth).rstrip()


def bumpy(level: int, waves: float) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Return a closed solid of 20 * 4^level triangles: a sphere with lobes that hide each other, and `waves` ridges."""
    try:
        import trimesh
    except ImportError:
        raise InputError("the twelve scenes need trimesh: pip install 'pathjax[bench]'") from None
    ball = trimesh.creation.icosphere(subdivisions=level)
    x, y, z = ball.vertices.T
    lobes = 0.3 * np.sin(3 * x + 1) * np.sin(4 * y) * np.sin(3 * z + 0.5)
    ridges = np.sin(waves * x) * np.sin(waves * y + 1) * np.sin(waves * z + 2)
    return ball.vertices * (1 + lobes + ridges / waves)[:, None], np.asarray(ball.faces)


def _in_box(file: Path, vertices: np.ndarray, faces: np.ndarray) -> str:
    """Return a scene in which the mesh fills most of the Cornell box, upright along y."""
    lowest, highest = vertices.min(0), vertices.max(0)
    middle = (lowest + highest) / 2
    scale = 1.3 / (highest - lowest).max()
    placed = (vertices - [middle[0], lowest[1], middle[2]]) * scale + [0, 0.001, 0]
    ply_writer.write(file, Mesh(placed.astype(np.float32), faces, None, None))
    return _scene(
        _head("0, 1, 3.9", "0, 1, 0", fov=39.3),
        *_BOX_BSDFS,
        *_room("white", "white", (1, 1, 1), "red", "green", open_front=True),
        _rectangle("lamp", "white", (0.23, 0.19), (0, 1.99, 0), (0, -1, 0), _area((18.4, 14, 6.75))),
        f'<shape type="ply" id="solid"><string name="filename" value="{file.name}"/><ref id="white"/></shape>',
    )


def _room(floor: str, walls: str, half, left: str | None = None, right: str | None = None, open_front=False):
    """Return the inner walls of a box that stands on y = 0, centred on the y axis."""
    x, y, z = half
    sides = [
        _rectangle("floor", floor, (x, z), (0, 0, 0), (0, 1, 0)),
        _rectangle("ceiling", walls, (x, z), (0, 2 * y, 0), (0, -1, 0)),
        _rectangle("back", walls, (x, y), (0, y, -z), (0, 0, 1)),
        _rectangle("left", left or walls, (z, y), (-x, y, 0), (1, 0, 0)),
        _rectangle("right", right or walls, (z, y), (x, y, 0), (-1, 0, 0)),
    ]
    return sides if open_front else [*sides, _rectangle("front", walls, (x, y), (0, y, z), (0, 0, -1))]


def _rectangle(name: str, bsdf: str, half, at, facing, inside: str = "") -> str:
    """Return a rectangle. half: half its width and height; facing: its normal, unit."""
    up = (0, 0, -1) if abs(facing[1]) > 0.99 else (0, 1, 0)
    look = f'<lookat origin="{_list(at)}" target="{_list(np.add(at, facing))}" up="{_list(up)}"/>'
    place = f'<scale x="{half[0]:g}" y="{half[1]:g}" z="1"/>{look}'
    return _shape(name, "rectangle", bsdf, f'<transform name="to_world">{place}</transform>{inside}')


def _cube(name: str, bsdf: str, half, at, turn: float) -> str:
    x, y, z = half
    place = f'<scale x="{x:g}" y="{y:g}" z="{z:g}"/><rotate y="1" angle="{turn:g}"/><translate value="{_list(at)}"/>'
    return _shape(name, "cube", bsdf, f'<transform name="to_world">{place}</transform>')


def _sphere(name: str, bsdf: str, center, radius: float, inside: str = "") -> str:
    place = f'<point name="center" value="{_list(center)}"/>{_number("radius", radius)}'
    return _shape(name, "sphere", bsdf, place + inside)


def _shape(name: str, kind: str, bsdf: str, inside: str) -> str:
    return f'<shape type="{kind}" id="{name}">{inside}<ref id="{bsdf}"/></shape>'


def _bsdf(name: str, kind: str, inside: str) -> str:
    return f'<bsdf type="{kind}" id="{name}">{inside}</bsdf>'


def _area(radiance) -> str:
    return f'<emitter type="area">{_rgb("radiance", radiance)}</emitter>'


def _environment(file: str, scale: float) -> str:
    return f'<emitter type="envmap"><string name="filename" value="{file}"/>{_number("scale", scale)}</emitter>'


def _picture(field: str, file: str, repeat: float) -> str:
    place = f'<transform name="to_uv"><scale x="{repeat:g}" y="{repeat:g}"/></transform>'
    return f'<texture type="bitmap" name="{field}"><string name="filename" value="{file}"/>{place}</texture>'


def _rgb(name: str, color) -> str:
    return f'<rgb name="{name}" value="{_list(color)}"/>'


def _number(name: str, value: float) -> str:
    return f'<float name="{name}" value="{value:g}"/>'


def _list(numbers) -> str:
    return ", ".join(f"{x:.6g}" for x in numbers)


_BOX_BSDFS = [
    _bsdf("white", "diffuse", _rgb("reflectance", (0.886, 0.699, 0.666))),
    _bsdf("red", "diffuse", _rgb("reflectance", (0.57, 0.043, 0.044))),
    _bsdf("green", "diffuse", _rgb("reflectance", (0.105, 0.378, 0.076))),
]


def _write_clouds(file: Path, dark, light, seed: int) -> None:
    """Write tileable smooth noise of several scales between two colours."""
    rng, v = np.random.default_rng(seed), np.zeros((256, 256))
    x = np.arange(256) / 256 * 2 * np.pi
    for octave in range(5):
        for _ in range(6):
            a, b = rng.integers(-(2**octave), 2**octave, 2, endpoint=True)
            v += np.sin(a * x[:, None] + b * x + rng.uniform(0, 2 * np.pi)) / 2**octave
    v = (v - v.min()) / np.ptp(v)
    write_png(file, np.asarray(dark) * (1 - v[..., None]) + np.asarray(light) * v[..., None])


def _write_sky(file: Path) -> None:
    """Write a sky: blue above, brown below, brighter towards the horizon and around a sun of 3 degrees."""
    height = 256
    polar = (np.arange(height) + 0.5)[:, None] / height * np.pi
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    y = np.cos(polar) + 0 * azimuth
    # The sun is behind the camera of `sky` and `window`, 35 degrees high.
    toward = np.sin(polar) * np.cos(azimuth - np.pi * 0.85) * np.cos(np.radians(35)) + y * np.sin(np.radians(35))
    above = np.array([0.25, 0.45, 0.9]) + np.array([0.7, 0.6, 0.35]) * np.exp(-4 * np.abs(y))[..., None]
    picture = np.where(y[..., None] > 0, above, [0.16, 0.13, 0.1])
    picture = picture + np.where(toward[..., None] > np.cos(np.radians(1.5)), [900, 800, 650], 0)
    picture += (0.8 * np.exp(-20 * (1 - toward)))[..., None] * [1, 0.9, 0.7]
    write_exr(file, dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)), {})
