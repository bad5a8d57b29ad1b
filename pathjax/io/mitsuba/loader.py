"""Mitsuba 3 scene files: what each element means.

What a file asks for and pathjax does not model is an InputError that names file, line, element and what is supported.
Defaults are Mitsuba's. Parameters are named after ids; an object without one is named after what it is nested in.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from pathjax import bsdfs, emitters, sensors, textures
from pathjax import description as d
from pathjax.description.elements import Document, Element, nearest
from pathjax.description.fields import Fields
from pathjax.io import mesh
from pathjax.io.mitsuba.xml_reader import read
from pathjax.kinds import Instance
from pathjax.sensors import film
from pathjax.shapes import KINDS as SHAPES
from pathjax.shapes import Mesh


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
        for tag in ("integrator", "sensor"):
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
        lights = tuple(self.emitter(element, element.id or self.unique("background")) for element in scene["emitter"])
        shapes = [
            self.make(element, dict.fromkeys(SHAPES, _shape), element.id or self.numbered("shape"))
            for element in scene["shape"]
        ]
        shapes = tuple(shape for shape in shapes if shape is not None)
        for element in scene["bsdf"] + scene["texture"]:
            if element not in self.made:
                self.notes.append(f"{element.file}:{element.line}: {element} is used by nothing")
                self.shared(element, element.id or element.tag)
        return d.Description(file, camera, film, integrator, spp, sampler, shapes, lights, tuple(self.notes))

    def make(self, element: Element, table: dict, *context: object):
        """What the handler for the element's type makes of it; its parameters must all have been asked for."""
        fields = Fields(self.document, element)
        if fields.type not in table:
            raise element.error(
                f"{element} is not supported; use one of {', '.join(table)}{nearest(fields.type, table)}"
            )
        read = getattr(table[fields.type], "read", table[fields.type])
        made = read(self, fields, *context)
        fields.finish()
        return made

    def shared(self, element: Element, name: str) -> Instance:
        """A bsdf or texture; the same object each time. `name` is for one without an id."""
        if element in self.making:
            raise element.error(f"{element} cannot stand inside itself")
        if element not in self.made:
            self.making.add(element)
            kinds = bsdfs.KINDS if element.tag == "bsdf" else textures.KINDS
            self.made[element] = self.make(element, kinds, element.id or name)
            self.making.remove(element)
        return self.made[element]

    bsdf = shared

    def emitter(self, element: Element, name: str, inside: bool = False) -> Instance:
        """Of those that stand inside shapes, or outside."""
        kinds = {key: kind for key, kind in emitters.KINDS.items() if kind.on_surfaces == inside}
        return self.make(element, kinds, name)

    def texture(self, fields: Fields, parameter: str, owner: str) -> Instance | None:
        """The texture that sets a parameter; None where it is something else. `owner` names one without an id."""
        element = fields.texture(parameter)
        return None if element is None else self.shared(element, owner)

    def find(self, fields: Fields, parameter: str) -> Path:
        """The file that a parameter names."""
        return self.document.find(fields.string(parameter), fields.where(parameter))

    def read_mesh(self, *how: object, **choices: object) -> Mesh:
        """Of `io.mesh.load`."""
        made, notes = mesh.load(*how, **choices)
        self.notes += notes
        return made

    def numbered(self, name: str) -> str:
        """`name0`, `name1`, ...; the next that is free."""
        return self.unique(next(each for k in self.counts[name] if (each := f"{name}{k}") not in self.names))

    def unique(self, name: str) -> str:
        """`name` if it is free, else with a number."""
        if name in self.names:
            return self.numbered(name)
        self.names.add(name)
        return name


def _shape(loader: _Loader, fields: Fields, name: str) -> d.Shape | None:
    """None where nothing of a mesh is left, as all its triangles are degenerate: no ray meets it, nor does it emit."""
    geometry = SHAPES[fields.type].read(loader, fields)
    flip_normals = fields.boolean("flip_normals", False) != geometry.mirrored
    emitter = None
    for element in fields.objects("emitter"):
        if element not in fields.element.children:
            raise element.error(f"{element} must stand inside its shape; it cannot be referred to")
        emitter = loader.emitter(element, element.id or name, inside=True)
    inherited = fields.element.id or None
    nested = fields.objects("bsdf")
    if nested:
        bsdf = loader.bsdf(nested[0], nested[0].id or inherited or loader.numbered("bsdf"))
    else:
        # Mitsuba: a light that is given no bsdf reflects nothing
        grey = 0.5 if emitter is None else 0.0
        bsdf = bsdfs.Diffuse.instance(inherited or loader.numbered("bsdf"), reflectance=grey)
    if geometry.empty:
        place, light = f"{fields.element.file}:{fields.element.line}", "" if emitter is None else ", and its light too"
        loader.notes.append(f"{place}: {fields.element} is left out, as no triangle has an area{light}")
        return None
    return d.Shape(name, geometry, bsdf, emitter, flip_normals)


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


def _sensor(loader: _Loader, fields: Fields) -> tuple[sensors.Sensor, film.HDRFilm, int, str]:
    camera = sensors.KINDS[fields.type].read(loader, fields)
    films, samplers = fields.objects("film"), fields.objects("sampler")
    made = loader.make(films[0], film.KINDS) if films else film.HDRFilm()
    spp = loader.make(samplers[0], SAMPLERS) if samplers else 4
    return camera, made, spp, samplers[0].attributes["type"] if samplers else "independent"


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
INTEGRATORS = {"path": _path, "direct": _direct}
SENSORS = dict.fromkeys(sensors.KINDS, _sensor)
SAMPLERS = dict.fromkeys(("independent", "stratified", "multijitter", "orthogonal", "ldsampler"), _sampler)
