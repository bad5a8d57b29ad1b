"""Mitsuba 3 scene files: what each element means.

What a file asks for and pathjax does not model is an InputError that names file, line, element and what is supported.
Defaults are Mitsuba's. Parameters are named after ids; an object without one is named after what it is nested in.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from itertools import count
from pathlib import Path

import numpy as np

from pathjax import description as d
from pathjax import emitters, media, sensors, textures
from pathjax.description.elements import Document, Element, nearest
from pathjax.description.fields import VALUES, Fields, is_one_color
from pathjax.errors import InputError
from pathjax.io import bare, mesh
from pathjax.io.mitsuba import dict_reader, instances, integrators, objects
from pathjax.io.mitsuba.plugins import PLUGINS, REASONS
from pathjax.io.mitsuba.xml_reader import read
from pathjax.kinds import Instance, Unused
from pathjax.media.gridvolume import GridVolume, boxed
from pathjax.media.homogeneous import BoxedVolume
from pathjax.sensors import Sensor
from pathjax.shapes import KINDS as SHAPES
from pathjax.shapes import Mesh


def load(path: str | Path, sensor: int | str = 0, /, **parameters: object) -> d.Description:
    """Read a scene file and the meshes and images that it names; or glTF or a bare mesh, which get what they lack.

    Args:
        sensor: which of several to use: its number, or its id.
        parameters: values for the file's `$name`s, in place of its `default`s.
    Raises:
        InputError: a file cannot be read, or asks for what pathjax does not model.
    """
    if Path(path).suffix.lower() not in bare.SUFFIXES:
        return _Loader(read(path, parameters)).description(str(path), sensor)
    scene, notes, files = bare.scene(Path(path), parameters)
    loader = _Loader(dict_reader.read(scene, str(path)))
    loader.notes += notes
    loader.document.found.update({Element("file", {}, str(path), 0): file for file in files})
    return loader.description(str(path), sensor)


def load_dict(scene: Mapping, sensor: int | str = 0) -> d.Description:
    """`load` of a scene that a dictionary holds.

    Raises:
        InputError: what is wrong, with the keys that lead there.
    """
    return _Loader(dict_reader.read(scene)).description("scene", sensor)


def read_again(document: Document, element: Element, name: str) -> Instance:
    """What one element says by itself. name: by which its parameters are known.

    Raises:
        InputError: what is wrong with it.
    """
    return _Loader(document).make(element, dict_reader.rooms()[element.tag], name)


class _NotModelled(InputError):
    """A kind of Mitsuba that pathjax has not."""


class _Loader:
    """What `objects` and the readers of kinds share: names given so far, objects made so far, notes."""

    def __init__(self, document: Document):
        self.document = document
        self.notes = list(document.notes)
        self.integrator = d.Integrator()
        self.names = set(document.ids)
        self.counts: defaultdict[str, Iterator[int]] = defaultdict(count)
        self.named: set[tuple[str, str]] = set()  # types and names of bsdfs and textures
        self.making: set[Element] = set()
        self.made: dict[Element, object] = {}
        self.of_numbers: dict[Instance, Instance] = {}  # textures, as they are where they stand for numbers
        self.copied = 0  # triangles of instances
        self.placed: tuple[d.Shape, ...] = ()  # all of the scene, once they are known
        self.on_shapes: dict[Element, Element] = {}  # a light by reference, and the shape that it shines from
        # Sensors inside of shapes, and the element and the shape that each is on; None: nothing of that is left.
        self.on_surfaces: dict[Element, tuple[Element, d.Shape | None]] = {}

    def description(self, file: str, sensor: int | str = 0) -> d.Description:
        scene: dict[str, list[Element]] = {tag: [] for tag in TOP_LEVEL}
        settings = []
        for element in self.document.root.children:
            if element.tag in VALUES and element.attributes.get("name") in _Settings.unused:
                settings.append(element)
                continue
            if element.tag not in scene:
                use = f"use one of {', '.join(TOP_LEVEL)}{nearest(element.tag, TOP_LEVEL)}"
                raise element.error(f"{element} is not supported directly in <scene>; {use}")
            scene[element.tag].append(element)
        if settings:
            root = self.document.root
            self.make(Element("scene", {"type": "scene"}, root.file, root.line, settings), {"scene": _Settings})
        for element in scene["integrator"][1:]:
            first = scene["integrator"][0].place
            raise element.error(f"{element}: one <integrator> is supported here; the first is at {first}")
        if scene["integrator"]:
            self.integrator = self.make(scene["integrator"][0], integrators.KINDS)
        else:
            self.notes.append('no <integrator> is given; <integrator type="path"> is used')
        single = [element for element in scene["emitter"] if _kind_of_light(element).single]
        for element in single[1:]:
            raise element.error(f"{element}: a scene takes one of this type; the first is at {single[0].place}")
        lights = tuple(
            self.emitter(element, element.id or self.unnamed(element))
            for element in scene["emitter"]
            if not _kind_of_light(element).on_surfaces
        )
        shapes = tuple(shape for element in scene["shape"] for shape in self.shapes(element))
        self.placed = shapes
        # In Mitsuba, too, those that stand on shapes come last.
        sensors = [*scene["sensor"], *self.on_surfaces] or [self.camera(shapes)]
        names = [element.id or str(number) for number, element in enumerate(sensors)]
        name = d.chosen(names, sensor, sensors[0].file)
        seen = sensors[names.index(name)]
        views = {each: self.view(element, seen) for each, element in zip(names, sensors, strict=True)}
        if self.copied:
            size = self.copied * instances.BYTES / 1e6
            self.notes.append(f"triangles of instances are copies: {self.copied} of them, about {size:.0f} MB")
        for element in scene["emitter"]:
            if _kind_of_light(element).on_surfaces and element not in self.on_shapes:
                self.note(element, "is used by nothing; put it, or a <ref> to it, inside the <shape> that shines")
                self.emitter(element, element.id, inside=True)
        unread = (each for tag in SHARED for each in scene[tag] if each not in self.made)
        for element in (each for each in unread if not is_one_color(each)):
            self.note(element, "is used by nothing")
            try:
                if element.tag in ("film", "sampler", "rfilter"):
                    self.make(element, dict_reader.rooms()[element.tag])
                else:
                    self.shared(element, element.id or element.tag)
            except _NotModelled:
                self.making.clear()
        self.check_media(scene["integrator"], shapes, lights, views[name].medium)
        return d.Description(
            file,
            views[name],
            self.integrator,
            shapes,
            lights,
            tuple(self.notes),
            self.document,
            self.made,
            views,
            name,
        )

    def measured(self, sensor: Element) -> d.Shape | None:
        """The shape that a sensor stands on; None: it is on none."""
        return self.on_surfaces.get(sensor, (None, None))[1]

    def surface(self, element: Element) -> d.Shape:
        """The one shape that an element stands for, which need not be in the scene."""
        if element.attributes.get("type") in instances.KINDS:
            raise element.error(f"{element} is not one shape")
        if element not in self.made:
            self.shapes(element)
        if self.made[element] is None:
            raise element.error(f"{element} has no area")
        return self.made[element]

    def inner_sensor(self, element: Element) -> Sensor:
        """A sensor that is part of another, whose film and sampler it shares."""
        kinds = {key: kind for key, kind in sensors.KINDS.items() if kind.inner}
        return self.make(element, kinds, read=objects.inner_sensor)

    def camera(self, shapes: tuple[d.Shape, ...]) -> Element:
        """A sensor that frames the shapes, for a scene without one; it becomes part of the document."""
        root = self.document.root
        what = bare.framing([shape.geometry for shape in shapes], root.file) if shapes else {"type": "perspective"}
        element = dict_reader.element("sensor", what, root)
        root.children.append(element)
        where = "one that frames its shapes" if shapes else "one at the origin"
        self.note(root, f"has no <sensor>; {where} is used")
        return element

    def around(self, element: Element) -> tuple[np.ndarray, float]:
        """Center and radius of the sphere around the box of all shapes, which an element needs."""
        if not self.placed:
            return np.zeros(3), 0.0
        return bare.around([shape.geometry for shape in self.placed], element.place)

    def view(self, element: Element, seen: Element) -> d.View | InputError:
        """What a sensor sees. One that is not used may be of a kind that is not supported, and gets one note alone."""
        if element is seen:
            return self.make(element, sensors.KINDS, read=objects.sensor)
        notes = list(self.notes)
        try:
            view = self.make(element, sensors.KINDS, read=objects.sensor)
        except InputError as error:
            view = error
            self.making.clear()
        self.notes = notes
        self.note(element, f"is left out, as the sensor at {seen.place} is used; `sensor` chooses another")
        return view

    def check_media(
        self,
        elements: list[Element],
        shapes: tuple[d.Shape, ...],
        lights: tuple[Instance, ...],
        medium: Instance | None,
    ) -> None:
        """Tell whether media are rendered; elements: the integrator, if there is one."""
        root = elements[0] if elements else self.document.root
        present = medium is not None or any(shape.interior or shape.exterior for shape in shapes)
        media = self.integrator.media
        if media and not present:
            same = "without media is the same as path, which is used"
            self.note(root, f"{same}; what goes straight on through a surface takes no depth")
        elif present and not media:
            self.note(root, 'takes no notice of media, as in Mitsuba; <integrator type="volpath"> renders them')
        elif present and not shapes:
            raise root.error(f"{root}: a medium without a shape around it never ends; add a <shape>")
        elif medium is not None and not any(shape.interior is medium for shape in shapes):
            for light in (each for each in lights if each.kind.distant):
                never = "the medium around the sensor never ends and lets none of its light through"
                self.notes.append(f"{light.name} is infinitely far: {never}; put the medium inside a <shape>")

    def note(self, element: Element, text: str) -> None:
        """What `info` should tell of an element."""
        self.notes.append(f"{element.place}: {element} {text}")

    def make(self, element: Element, kinds: Mapping[str, type], *context: object, read: Callable | None = None):
        """What the kind of the element's type reads; the file may hold nothing else but what has no effect.

        Args:
            read: loader, fields, context -> what is made, in place of the kind's own.
        """
        fields = Fields(self.document, element)
        if fields.type not in kinds:
            use = f"use one of {', '.join(kinds)}"
            if fields.type in PLUGINS.get(element.tag, ()):
                reason = f": {REASONS[fields.type]}" if fields.type in REASONS else " yet"
                raise _NotModelled(f"{element.place}: {element} is not supported{reason}; {use}")
            raise element.error(f"{element} is not supported; {use}{nearest(fields.type, kinds)}")
        if element in self.making:
            raise element.error(f"{element} cannot stand inside itself")
        self.making.add(element)
        kind = kinds[fields.type]
        made = (read or kind.read)(self, fields, *context)
        self.making.remove(element)
        self.notes += fields.notes + fields.without_effect(kind.unused)
        fields.finish()
        self.made[element] = made
        return made

    def shared(self, element: Element, name: str) -> Instance:
        """A bsdf, texture, medium or phase function; the same object each time, also by reference.

        name: for one without an id, with a number if it is that of another one of its type, as in masks inside masks.
        """
        if element not in self.made:
            kinds = dict_reader.rooms()[element.tag]
            kind, name = element.attributes.get("type"), element.id or name
            if (kind, name) in self.named:
                name = self.numbered(name)
            self.named.add((kind, name))
            self.make(element, kinds, name)
        return self.made[element]

    bsdf = shared

    def emitter(self, element: Element, name: str, inside: bool = False) -> Instance:
        """The light of an element that stands inside a shape, or outside of shapes."""
        kind = emitters.KINDS.get(element.attributes.get("type", ""))
        if kind is not None and inside and not kind.on_surfaces:
            raise element.error(f"{element} shines from no surface; it stands directly in <scene>")
        kinds = {key: kind for key, kind in emitters.KINDS.items() if kind.on_surfaces == inside}
        return self.make(element, kinds, name, read=objects.emitter)

    def shapes(self, element: Element) -> list[d.Shape]:
        """What an element of a scene or a group stands for: nothing, one, or those that an instance shows."""
        kinds = SHAPES | instances.KINDS
        match kinds.get(element.attributes.get("type", "")):
            case instances.ShapeGroup:
                self.group(element)
                return []
            case instances.Merge:
                return self.make(element, kinds)
            case instances.Instance:
                return self.make(element, kinds, element.id or self.numbered("shape"))
        made = self.make(element, kinds, element.id or self.numbered("shape"), read=objects.shape)
        return [] if made is None else [made]

    def group(self, element: Element) -> list[d.Shape]:
        """The shapes of a group, read once."""
        if element not in self.made:
            self.make(element, instances.KINDS)
        return self.made[element]

    def copy(self, element: Element, triangles: int) -> None:
        """Count what instances copy."""
        self.copied += triangles
        if self.copied > instances.MOST_TRIANGLES:
            size = self.copied * instances.BYTES / 1e9
            raise element.error(f"{element} makes the copies of instances {self.copied} triangles, about {size:.0f} GB")

    def unnamed(self, element: Element) -> str:
        """Name of an emitter outside of shapes that has no id."""
        return self.unique(emitters.usual_name(element.attributes.get("type", "")))

    def texture(self, fields: Fields, parameter: str, owner: str, of_number: bool = False) -> Instance | None:
        """The texture that sets a parameter; None where it is something else. `owner` names one without an id."""
        element = fields.texture(parameter)
        if element is None:
            return None
        made = self.shared(element, owner)
        return textures.of_number(made, self.of_numbers) if of_number else made

    def volume(self, fields: Fields, parameter: str, default: float) -> GridVolume:
        """The volume that sets a parameter, of whatever values; a colour as one that is the same everywhere."""
        element = fields.texture(parameter, "volume")
        if element is None:
            return boxed(fields.color(parameter, np.full(3, default)), np.eye(4))
        return self.make(element, media.VOLUMES | {"constvolume": BoxedVolume}, np.inf)

    def find(self, fields: Fields, parameter: str) -> Path:
        """The file that a parameter names."""
        return self.document.find(fields.string(parameter), fields.where(parameter))

    def read_mesh(self, *how: object, **choices: object) -> Mesh:
        """The mesh of `io.mesh.load`, whose notes are kept."""
        made, notes = mesh.load(*how, **choices)
        self.notes += notes
        return made

    def mesh_of_arrays(self, fields: Fields, **arrays: object) -> Mesh:
        """The mesh of `io.mesh.of_arrays`, whose notes are kept."""
        made, notes = mesh.of_arrays(fields.element.place, **arrays)
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


def _kind_of_light(element: Element) -> type[emitters.Emitter]:
    """The class of an emitter's type; that of any, where the type is unknown, which `emitter` refuses."""
    return emitters.KINDS.get(element.attributes.get("type", ""), emitters.Emitter)


class _Settings:
    """What stands directly in <scene>: how Mitsuba searches for hits."""

    unused = (
        dict.fromkeys(("embree_use_robust_intersections", "allow_thread_reordering"), Unused("boolean"))
        | dict.fromkeys(("kd_clip", "kd_retract_bad_splits"), Unused("boolean"))
        | dict.fromkeys(("kd_traversal_cost", "kd_intersection_cost", "kd_empty_space_bonus"), Unused("float"))
        | dict.fromkeys(
            ("kd_max_depth", "kd_min_max_bins", "kd_stop_prims", "kd_exact_primitive_threshold"), Unused("integer")
        )
    )

    @classmethod
    def read(cls, loader: _Loader, fields: Fields) -> None:
        pass


# What is of use by reference alone.
SHARED = ("bsdf", "texture", "medium", "phase", "film", "sampler", "rfilter")
TOP_LEVEL = ("integrator", "sensor", "emitter", "shape", "volume", *SHARED)
