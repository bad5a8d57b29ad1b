"""Build descriptions from the elements of Mitsuba 3 scene files.

A feature that pathjax does not model raises an InputError that names file, line, element and supported alternatives.
Defaults are Mitsuba's. Parameters are named after ids; an object without an id is named after its parent.
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
    """Read a scene file and the meshes and images that it names; or glTF or a bare mesh, which `bare` completes.

    Args:
        sensor: which of several sensors to use: its index, or its id.
        parameters: values for the file's `$name`s, in place of its `default`s.
    Raises:
        InputError: a file cannot be read, or needs a feature that pathjax does not model.
    """
    if Path(path).suffix.lower() not in bare.SUFFIXES:
        return _Loader(read(path, parameters)).description(str(path), sensor)
    scene, notes, files = bare.scene(Path(path), parameters)
    loader = _Loader(dict_reader.read(scene, str(path)))
    loader.notes += notes
    loader.quiet.add("sampler")
    loader.document.found.update({Element("file", {}, str(path), 0): file for file in files})
    return loader.description(str(path), sensor)


def load_dict(scene: Mapping, sensor: int | str = 0) -> d.Description:
    """Read a scene from a dictionary, and the files that it names.

    Raises:
        InputError: the scene is invalid; the message has the keys that lead there.
    """
    return _Loader(dict_reader.read(scene)).description("scene", sensor)


def read_again(document: Document, element: Element, name: str) -> Instance:
    """Read one element by itself. name: the prefix of its parameters' names.

    Raises:
        InputError: the element is invalid.
    """
    return _Loader(document).make(element, dict_reader.rooms()[element.tag], name)


class _NotModelled(InputError):
    """A Mitsuba plugin that pathjax does not model."""


class _Loader:
    """The state that `objects` and the `read` of kinds share: names in use, objects built so far, notes."""

    def __init__(self, document: Document):
        self.document = document
        self.notes = list(document.notes)
        self.quiet: set[str] = set()  # tags of elements that the user did not write, which get no notes
        self.integrator = d.Integrator()
        self.names = set(document.ids)
        self.counts: defaultdict[str, Iterator[int]] = defaultdict(count)
        self.named: set[tuple[str, str]] = set()  # types and names of bsdfs and textures
        self.making: set[Element] = set()
        self.made: dict[Element, object] = {}
        self.of_numbers: dict[Instance, Instance] = {}  # texture -> its form for scalar parameters
        self.copied = 0  # triangles of instances
        self.placed: tuple[d.Shape, ...] = ()  # all shapes of the scene, after they are read
        self.on_shapes: dict[Element, Element] = {}  # light -> the shape that it shines from
        # Sensor inside a shape -> the shape's element, and the shape; None: all its triangles are degenerate.
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
        # As in Mitsuba, sensors on shapes come last.
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
        """Return the shape that a sensor is on; None: it is on none, or the shape has no area."""
        return self.on_surfaces.get(sensor, (None, None))[1]

    def surface(self, element: Element) -> d.Shape:
        """Return the shape of an element, which must be a single one, but need not be in the scene."""
        if element.attributes.get("type") in instances.KINDS:
            raise element.error(f"{element} is not one shape")
        if element not in self.made:
            self.shapes(element)
        if self.made[element] is None:
            raise element.error(f"{element} has no area")
        return self.made[element]

    def inner_sensor(self, element: Element) -> Sensor:
        """Read a sensor that is part of another one, whose film and sampler it shares."""
        kinds = {key: kind for key, kind in sensors.KINDS.items() if kind.inner}
        return self.make(element, kinds, read=objects.inner_sensor)

    def camera(self, shapes: tuple[d.Shape, ...]) -> Element:
        """Add a sensor that frames the shapes to the document of a scene without a sensor."""
        root = self.document.root
        what = bare.framing([shape.geometry for shape in shapes], root.file) if shapes else {"type": "perspective"}
        element = dict_reader.element("sensor", what, root)
        root.children.append(element)
        where = "one that frames its shapes" if shapes else "one at the origin"
        self.note(root, f"has no <sensor>; {where} is used")
        return element

    def around(self, element: Element) -> tuple[np.ndarray, float]:
        """Return center and radius of the sphere around the bounding box of all shapes. element: for messages."""
        if not self.placed:
            return np.zeros(3), 0.0
        return bare.around([shape.geometry for shape in self.placed], element.place)

    def view(self, element: Element, seen: Element) -> d.View | InputError:
        """Read a sensor. If another one, `seen`, is used, errors are returned and notes replaced by a single one."""
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
        """Check that the integrator suits the media, with notes or an error; elements: the integrator, if present."""
        root = elements[0] if elements else self.document.root
        while inside := [each for each in root.children if elements and each.tag == "integrator"]:
            root = inside[0]
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
        """Add a note about an element, for `info`."""
        if element.tag not in self.quiet:
            self.notes.append(f"{element.place}: {element} {text}")

    def make(self, element: Element, kinds: Mapping[str, type], *context: object, read: Callable | None = None):
        """Build an object by the `read` of its kind. Contents that are neither read nor in its `unused` are refused.

        Args:
            read: function (loader, fields, *context) to use in place of the kind's own.
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
        """Return a bsdf, texture, medium or phase function; each element is read once, also if it is referenced often.

        name: used without an id; a number is appended if another object of that type has it, as in masks inside masks.
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
        """Read a light that stands inside a shape, or outside of shapes."""
        kind = emitters.KINDS.get(element.attributes.get("type", ""))
        if kind is not None and inside and not kind.on_surfaces:
            raise element.error(f"{element} shines from no surface; it stands directly in <scene>")
        kinds = {key: kind for key, kind in emitters.KINDS.items() if kind.on_surfaces == inside}
        return self.make(element, kinds, name, read=objects.emitter)

    def shapes(self, element: Element) -> list[d.Shape]:
        """Read the shapes of an element of a scene or a group: none, one, or those of an instance or a <merge>."""
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
        """Return the shapes of a group, which is read once."""
        if element not in self.made:
            self.make(element, instances.KINDS)
        return self.made[element]

    def copy(self, element: Element, triangles: int) -> None:
        """Count triangles that instances copy, and refuse too many."""
        self.copied += triangles
        if self.copied > instances.MOST_TRIANGLES:
            size = self.copied * instances.BYTES / 1e9
            raise element.error(f"{element} makes the copies of instances {self.copied} triangles, about {size:.0f} GB")

    def unnamed(self, element: Element) -> str:
        """Return a name for an emitter outside of shapes without an id."""
        return self.unique(emitters.default_name(element.attributes.get("type", "")))

    def texture(self, fields: Fields, parameter: str, owner: str, of_number: bool = False) -> Instance | None:
        """Return the texture that sets a parameter, or None. `owner` names one without an id."""
        element = fields.texture(parameter)
        if element is None:
            return None
        made = self.shared(element, owner)
        return textures.of_number(made, self.of_numbers) if of_number else made

    def volume(self, fields: Fields, parameter: str, default: float) -> GridVolume:
        """Return the volume that sets a parameter, without bounds on its values; a colour gives a constant volume."""
        element = fields.texture(parameter, "volume")
        if element is None:
            return boxed(fields.color(parameter, np.full(3, default)), np.eye(4))
        return self.make(element, media.VOLUMES | {"constvolume": BoxedVolume}, np.inf)

    def find(self, fields: Fields, parameter: str) -> Path:
        """Return the path of the file that a parameter names."""
        return self.document.find(fields.string(parameter), fields.where(parameter))

    def read_mesh(self, *how: object, **choices: object) -> Mesh:
        """Return the mesh of `io.mesh.load`, and keep the notes."""
        made, notes = mesh.load(*how, **choices)
        self.notes += notes
        return made

    def mesh_of_arrays(self, fields: Fields, **arrays: object) -> Mesh:
        """Return the mesh of `io.mesh.of_arrays`, and keep the notes."""
        made, notes = mesh.of_arrays(fields.element.place, **arrays)
        self.notes += notes
        return made

    def numbered(self, name: str) -> str:
        """Reserve the next free name of `name0`, `name1`, ..."""
        return self.unique(next(each for k in self.counts[name] if (each := f"{name}{k}") not in self.names))

    def unique(self, name: str) -> str:
        """Reserve `name` if it is free, else `name` with a number."""
        if name in self.names:
            return self.numbered(name)
        self.names.add(name)
        return name


def _kind_of_light(element: Element) -> type[emitters.Emitter]:
    """Return the class of an emitter's type; the base class if the type is unknown, which `emitter` refuses."""
    return emitters.KINDS.get(element.attributes.get("type", ""), emitters.Emitter)


class _Settings:
    """Parameters directly in <scene>: how Mitsuba searches for hits."""

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


# Objects that have an effect only if they are referenced.
SHARED = ("bsdf", "texture", "medium", "phase", "film", "sampler", "rfilter")
TOP_LEVEL = ("integrator", "sensor", "emitter", "shape", "volume", *SHARED)
