"""Mitsuba 3 scene files: what each element means.

What a file asks for and pathjax does not model is an InputError that names file, line, element and what is supported.
Defaults are Mitsuba's. Parameters are named after ids; an object without one is named after what it is nested in.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from pathjax import bsdfs, textures
from pathjax import description as d
from pathjax.description.elements import Document, Element, nearest
from pathjax.description.fields import Fields
from pathjax.io import mesh
from pathjax.io.mitsuba.xml_reader import read
from pathjax.kinds import Instance

MAX_PIXELS = 10**9


def load(path: str | Path, /, **parameters: object) -> d.Description:
    """Read a scene file and the meshes and images that it names.

    Args:
        parameters: values for the file's `$name`s, in place of its `default`s.
    Raises:
        InputError: a file cannot be read, or asks for what pathjax does not model.
    """
    return _Loader(read(path, parameters)).description(str(path))


class _Loader:
    """What the handlers below share: names given so far, objects made so far, notes."""

    def __init__(self, document: Document):
        self.document = document
        self.notes: list[str] = []
        self.names = set(document.ids)
        self.counts: defaultdict[str, Iterator[int]] = defaultdict(count)
        self.making: set[Element] = set()
        self.made: dict[Element, object] = {}  # an element that is referenced twice is one object

    def description(self, file: str) -> d.Description:
        scene: dict[str, list[Element]] = {tag: [] for tag in TOP_LEVEL}
        for element in self.document.root.children:
            if element.tag not in scene:
                use = f"use one of {', '.join(scene)}{nearest(element.tag, scene)}"
                raise element.error(f"{element} is not supported directly in <scene>; {use}")
            scene[element.tag].append(element)
        for tag in ("integrator", "sensor", "emitter"):
            for element in scene[tag][1:]:
                first = f"{scene[tag][0].file}:{scene[tag][0].line}"
                raise element.error(f"{element}: one <{tag}> is supported here; the first is at {first}")
        if not scene["sensor"]:
            raise self.document.root.error('the scene has no <sensor>; add <sensor type="perspective">')

        camera, film, spp, sampler = self.make(scene["sensor"][0], SENSORS)
        if scene["integrator"]:
            integrator = self.make(scene["integrator"][0], INTEGRATORS)
        else:
            integrator = d.Integrator()
            self.notes.append('no <integrator> is given; <integrator type="path"> is used')
        background, background_name = None, ""
        for element in scene["emitter"]:
            background, background_name = self.make(element, BACKGROUNDS), element.id or self.unique("background")
        shapes = [
            self.make(element, dict.fromkeys(SHAPES, _shape), element.id or self.numbered("shape"))
            for element in scene["shape"]
        ]
        shapes = tuple(shape for shape in shapes if shape is not None)
        for element in scene["bsdf"] + scene["texture"]:
            if element not in self.made:
                self.notes.append(f"{element.file}:{element.line}: {element} is used by nothing")
                self.shared(element, element.id or element.tag)
        return d.Description(
            file, camera, film, integrator, spp, sampler, shapes, background, background_name, tuple(self.notes)
        )

    def make(self, element: Element, table: dict, *context: object):
        """What the handler for the element's type makes of it; its parameters must all have been asked for."""
        fields = Fields(self.document, element)
        if fields.type not in table:
            raise element.error(
                f"{element} is not supported; use one of {', '.join(table)}{nearest(fields.type, table)}"
            )
        made = table[fields.type](self, fields, *context)
        fields.finish()
        return made

    def shared(self, element: Element, name: str) -> Instance:
        """A bsdf or texture; the same object each time. `name` is for one without an id."""
        if element in self.making:
            raise element.error(f"{element} cannot stand inside itself")
        if element not in self.made:
            self.making.add(element)
            kinds = bsdfs.KINDS if element.tag == "bsdf" else textures.KINDS
            handlers = {type_name: partial(_instance, kind) for type_name, kind in kinds.items()}
            self.made[element] = self.make(element, handlers, element.id or name)
            self.making.remove(element)
        return self.made[element]

    bsdf = shared

    def texture(self, fields: Fields, parameter: str, owner: str) -> Instance | None:
        """The texture that sets a parameter; None where it is something else. `owner` names one without an id."""
        element = fields.texture(parameter)
        return None if element is None else self.shared(element, owner)

    def find(self, fields: Fields, parameter: str) -> Path:
        """The file that a parameter names."""
        return self.document.find(fields.string(parameter), fields.where(parameter))

    def numbered(self, name: str) -> str:
        """`name0`, `name1`, ...; the next that is free."""
        return self.unique(next(each for k in self.counts[name] if (each := f"{name}{k}") not in self.names))

    def unique(self, name: str) -> str:
        """`name` if it is free, else with a number."""
        if name in self.names:
            return self.numbered(name)
        self.names.add(name)
        return name


def _instance(kind: type, loader: _Loader, fields: Fields, name: str) -> Instance:
    return kind.read(loader, fields, name)


def _shape(loader: _Loader, fields: Fields, name: str) -> d.Shape | None:
    """None where nothing of a mesh is left, as all its triangles are degenerate: no ray meets it, nor does it emit."""
    geometry = SHAPES[fields.type](loader, fields)
    flip_normals = fields.boolean("flip_normals", False)
    if isinstance(geometry, d.Sphere) and np.linalg.det(geometry.to_world[:3, :3]) < 0:
        flip_normals = not flip_normals  # Mitsuba turns a mirrored sphere inside out, other shapes not
    radiance, emitter_name = None, ""
    for emitter in fields.objects("emitter"):
        if emitter not in fields.element.children:
            raise emitter.error(f"{emitter} must stand inside its shape; it cannot be referred to")
        radiance, emitter_name = loader.make(emitter, AREA_LIGHTS), emitter.id or name
    inherited = fields.element.id or None
    nested = fields.objects("bsdf")
    if nested:
        bsdf = loader.bsdf(nested[0], nested[0].id or inherited or loader.numbered("bsdf"))
    else:
        # Mitsuba: a light that is given no bsdf reflects nothing
        grey = 0.5 if radiance is None else 0.0
        bsdf = bsdfs.Diffuse.instance(inherited or loader.numbered("bsdf"), reflectance=grey)
    if isinstance(geometry, d.Mesh) and not len(geometry.faces):
        place, light = f"{fields.element.file}:{fields.element.line}", "" if radiance is None else ", and its light too"
        loader.notes.append(f"{place}: {fields.element} is left out, as no triangle has an area{light}")
        return None
    return d.Shape(name, geometry, bsdf, radiance, emitter_name, flip_normals)


# Shapes: (loader, fields) -> geometry.


def _sphere(loader: _Loader, fields: Fields) -> d.Sphere:
    local = np.eye(4)
    local[:3, 3] = fields.point("center", np.zeros(3))
    local[:3, :3] *= fields.float("radius", 1.0, above=0)
    to_world = fields.transform("to_world") @ local
    radius = float(np.linalg.norm(to_world[:3, 0]))
    with np.errstate(all="ignore"):
        unit = to_world[:3, :3] / radius
        round_enough = np.allclose(unit.T @ unit, np.eye(3), atol=1e-3)
    if not round_enough or not 0 < np.float32(radius) < np.inf:
        raise fields.error("to_world", "scales unevenly or shears; a sphere must stay a sphere")
    return d.Sphere(to_world[:3, 3], radius, to_world)


def _rectangle(loader: _Loader, fields: Fields) -> d.Rectangle:
    return d.Rectangle(fields.transform("to_world"))


def _disk(loader: _Loader, fields: Fields) -> d.Disk:
    return d.Disk(fields.transform("to_world"))


def _cube(loader: _Loader, fields: Fields) -> d.Cube:
    return d.Cube(fields.transform("to_world"))


def _mesh(loader: _Loader, fields: Fields) -> d.Mesh:
    made, notes = mesh.load(
        loader.find(fields, "filename"),
        fields.type,
        fields.transform("to_world"),
        face_normals=fields.boolean("face_normals", False),
        flip_tex_coords=fields.boolean("flip_tex_coords", None),
    )
    loader.notes += notes
    return made


# Emitters: (loader, fields) -> (3,) radiance.


def _emitter(loader: _Loader, fields: Fields) -> np.ndarray:
    return fields.color("radiance", np.ones(3), radiance=True)


# Integrators: (loader, fields) -> Integrator.


def _path(loader: _Loader, fields: Fields) -> d.Integrator:
    max_depth = fields.integer("max_depth", -1, at_least=-1)
    if max_depth == 0:
        raise fields.error("max_depth", "is 0, which renders black; use -1 (no limit), or 1 and more")
    return d.Integrator(max_depth, fields.integer("rr_depth", 5, at_least=1), fields.boolean("hide_emitters", False))


def _direct(loader: _Loader, fields: Fields) -> d.Integrator:
    for samples in ("shading_samples", "emitter_samples", "bsdf_samples"):
        fields.integer(samples, 1, at_least=1, at_most=1)
    return d.Integrator(max_depth=2, hide_emitters=fields.boolean("hide_emitters", False))


# Sensors: (loader, fields) -> camera, film, samples per pixel, sampler.


def _perspective(loader: _Loader, fields: Fields) -> tuple[d.Camera, d.Film, int, str]:
    near, far = fields.float("near_clip", 1e-2, above=0), fields.float("far_clip", 1e4, above=0)
    if near >= far:
        raise fields.error("near_clip", f"must be smaller than far_clip, {far:g}; is {near:g}")
    to_world = fields.transform("to_world")
    if not np.allclose(to_world[:3, :3].T @ to_world[:3, :3], np.eye(3), atol=2e-3):
        raise fields.error("to_world", "scales or shears; a camera can be turned and moved only")
    aperture_radius = focus_distance = None
    if fields.type == "thinlens":
        aperture_radius = fields.float("aperture_radius", above=0)
        focus_distance = fields.float("focus_distance", far, above=0)
    offset = tuple(fields.float(f"principal_point_offset_{axis}", 0.0) for axis in "xy")
    camera = d.Camera(to_world, *_field_of_view(fields), near, far, offset, aperture_radius, focus_distance)

    films, samplers = fields.objects("film"), fields.objects("sampler")
    film = loader.make(films[0], FILMS) if films else d.Film(768, 576, (0, 0, 768, 576))
    spp = loader.make(samplers[0], SAMPLERS) if samplers else 4
    return camera, film, spp, samplers[0].attributes["type"] if samplers else "independent"


def _field_of_view(fields: Fields) -> tuple[float, str]:
    """Degrees, and the axis along which they are measured; a focal length is one of 35 mm film, 36 x 24 mm."""
    if fields.has("focal_length") and (fields.has("fov") or fields.has("fov_axis")):
        raise fields.error("focal_length", "excludes fov and fov_axis; give one or the other")
    if fields.has("fov"):
        axis = fields.string("fov_axis", "x", choices=("x", "y", "diagonal", "smaller", "larger"))
        return fields.float("fov", above=0, below=180), axis
    text = fields.string("focal_length", "50mm").strip()
    length = re.fullmatch(r"(\d{1,9}(\.\d{1,9})?)\s*(mm)?", text)
    if not length or float(length[1]) == 0:
        raise fields.error("focal_length", f'must be like "50mm", is "{text[:40]}"')
    return 2 * math.degrees(math.atan(math.hypot(36, 24) / (2 * float(length[1])))), "diagonal"


def _hdrfilm(loader: _Loader, fields: Fields) -> d.Film:
    width, height = fields.integer("width", 768, at_least=1), fields.integer("height", 576, at_least=1)
    if width * height >= MAX_PIXELS:
        raise fields.error("width", f"times height is {width * height} pixels; it must be below {MAX_PIXELS}")
    x, y = (fields.integer(f"crop_offset_{axis}", 0, at_least=0) for axis in "xy")
    crop_width = fields.integer("crop_width", width, at_least=1)
    crop_height = fields.integer("crop_height", height, at_least=1)
    if x + crop_width > width or y + crop_height > height:
        raise fields.element.error(
            f"the crop window ({x}, {y}) + ({crop_width}, {crop_height}) reaches beyond the film, ({width}, {height})"
        )
    fields.string("pixel_format", "rgb", choices=("rgb",))
    for name, choices in WITHOUT_EFFECT.items():
        given = fields.string(name, None, choices=choices) if choices else fields.boolean(name, None)
        if given is not None:
            loader.notes.append(f"{fields.where(name).file}:{fields.where(name).line}: {name} has no effect")
    filters = fields.objects("rfilter")
    shape = loader.make(filters[0], FILTERS) if filters else ("gaussian", 2.0, 0.5)
    return d.Film(width, height, (x, y, crop_width, crop_height), *shape)


def _box(loader: _Loader, fields: Fields) -> tuple[str, float]:
    return "box", 0.5


def _tent(loader: _Loader, fields: Fields) -> tuple[str, float]:
    return "tent", fields.float("radius", 1.0, above=0, below=100)


def _gaussian(loader: _Loader, fields: Fields) -> tuple[str, float, float]:
    stddev = fields.float("stddev", 0.5, above=0, below=25)
    return "gaussian", 4 * stddev, stddev


def _sampler(loader: _Loader, fields: Fields) -> int:
    spp = fields.integer("sample_count", 4, at_least=1)
    fields.integer("seed", 0, at_least=0, at_most=2**32 - 1)
    if fields.type in ("stratified", "multijitter", "orthogonal"):
        fields.boolean("jitter", True)
    if fields.type == "orthogonal":
        fields.integer("strength", 2, at_least=0)
    loader.notes.append(f"{fields.element}: pathjax draws its samples from its own sequence; sample_count is kept")
    return spp


TOP_LEVEL = ("integrator", "sensor", "emitter", "bsdf", "texture", "shape")
SHAPES = {"sphere": _sphere, "rectangle": _rectangle, "disk": _disk, "cube": _cube} | dict.fromkeys(mesh.READERS, _mesh)
AREA_LIGHTS = {"area": _emitter}
BACKGROUNDS = {"constant": _emitter}
INTEGRATORS = {"path": _path, "direct": _direct}
SENSORS = {"perspective": _perspective, "thinlens": _perspective}
FILMS = {"hdrfilm": _hdrfilm}
FILTERS = {"box": _box, "tent": _tent, "gaussian": _gaussian}

SAMPLERS = dict.fromkeys(("independent", "stratified", "multijitter", "orthogonal", "ldsampler"), _sampler)

# settings of the film that concern Mitsuba's own files and blocks, with their choices; none: a boolean
WITHOUT_EFFECT = {
    "file_format": ("openexr", "exr", "rgbe", "pfm"),
    "component_format": ("float16", "float32", "uint32"),
    "sample_border": (),
    "compensate": (),
}
