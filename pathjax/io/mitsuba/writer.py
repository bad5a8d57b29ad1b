"""Write a loaded scene as a Mitsuba scene file that loads as the same scene.

It has the elements that were read, of whatever kind, with includes and `$name`s expanded, file names relative to the
new folder, and the current values of parameters that have changed. Arrays become files beside it.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from pathjax import description as d
from pathjax.core.math import luminance
from pathjax.description.elements import Document, Element
from pathjax.errors import InputError
from pathjax.images import write_exr
from pathjax.images.png import write_stored
from pathjax.images.read import decoded
from pathjax.io.mesh import ply_writer
from pathjax.io.mitsuba import dict_reader
from pathjax.io.mitsuba.loader import read_again
from pathjax.io.mitsuba.plugins import PLUGINS
from pathjax.kinds import Instance, Stored
from pathjax.system.files import check_writable, write_text


def save(description: d.Description, values: Mapping[str, np.ndarray], path: Path) -> list[Path]:
    """Write the scene file, after the new files that it names.

    Args:
        values: values of all parameters, by name.
    Returns:
        All files that were written, the scene file last.
    Raises:
        InputError: a file cannot be written, or would overwrite one that the scene was read from; or a change cannot be
            expressed in a scene file.
    """
    if path.suffix.lower() != ".xml":
        raise InputError(f"{path}: scenes are written as .xml")
    sources = {description.file, *description.document.found.values()}
    check_writable(path, sources)
    writer = _Writer(description, values, path, sources)
    text = writer.text(description.document.root)
    for write in writer.files.values():
        write()
    write_text(path, text)
    return [*writer.files, path]


class _Writer:
    def __init__(self, description: d.Description, values: Mapping[str, np.ndarray], path: Path, sources: set):
        self.document, self.made, self.values = description.document, description.made, values
        self.path, self.sources, self.seen = path, sources, description.views[description.seen]
        self.files: dict[Path, Callable[[], None]] = {}  # file -> function that writes it
        self.images = _changed_images(description.made.values(), values)
        self.stored = _changed_arrays(description.made.values(), values)

    def text(self, element: Element, depth: int = 0) -> str:
        """Return the element and its children as lines of XML."""
        if element.tag == "shape" and self.made.get(element) is None and _has_arrays(element):
            return ""  # a mesh of degenerate triangles only
        element = self.changed(element)
        attributes = self.attributes(element)
        if element.tag == "ref" and (target := self.document.ids.get(element.id)) is not None:
            attributes["id"] = target.id  # the ref may use an <alias>
        if element.tag == "scene":
            attributes["version"] = dict_reader.VERSION  # elements of older files were upgraded
        start = f"{'    ' * depth}<{element.tag}" + "".join(f" {key}={quoteattr(x)}" for key, x in attributes.items())
        if not element.children:
            return f"{start}/>\n"
        # The sensor that is used comes first.
        children = sorted(
            element.children, key=lambda child: child.tag == "sensor" and self.made.get(child) is not self.seen
        )
        inside = "".join(self.text(child, depth + 1) for child in children)
        return f"{start}>\n{inside}{'    ' * depth}</{element.tag}>\n"

    def attributes(self, element: Element) -> dict[str, str]:
        attributes = dict(element.attributes)
        if found := self.document.found.get(element):
            attributes["filename" if "filename" in attributes else "value"] = self.relative_path(found)
        for value in attributes.values():
            if "$" in value or not value.replace("\n", " ").replace("\t", " ").isprintable():
                raise element.error(f"{element}: {value[:60]!r} cannot be written, as XML has no word for it here")
        return attributes

    def relative_path(self, found: Path) -> str:
        there = Path(os.path.realpath(self.path)).parent
        try:
            return Path(os.path.relpath(os.path.realpath(found), there)).as_posix()
        except ValueError:  # on another Windows drive
            return str(found.absolute())

    # ---- parameters

    def changed(self, element: Element) -> Element:
        """Return the element with changed values, and with files in place of arrays."""
        made = self.made.get(element)
        geometry = getattr(made, "geometry", None)
        if geometry is not None and geometry.triangles:
            carried = self.carried(made)
            if carried is not geometry.attributes or element.attributes["type"] not in PLUGINS["shape"]:
                return self.mesh(element, replace(made, geometry=replace(geometry, attributes=carried)))
        if isinstance(made, Instance):
            values = {key: self.values[f"{made.name}.{key}"] for key in self.different(made)}
            element = self.with_values(element, made, values) if values else element
        if isinstance(made, Instance) and made in self.images:
            return self.with_image(element, *self.images[made])
        if isinstance(made, Stored) and made in self.stored:
            return self.with_array(element, made, *self.stored[made])
        if _has_arrays(element):
            names = [made.name if isinstance(made, Instance) else element.tag, element.attributes.get("name")]
            name = "_".join(filter(None, names))
            children = [self.image(child, element, name) for child in element.children]
            return Element(element.tag, element.attributes, element.file, element.line, children)
        return element

    def carried(self, shape: d.Shape) -> Mapping[str, np.ndarray]:
        """Return the attributes of a mesh; the same object that was read if none has changed."""
        read = shape.geometry.attributes
        new = {name: self.values.get(f"{shape.name}.{name}", values) for name, values in read.items()}
        changed = any(not np.array_equal(values, read[name].astype(values.dtype)) for name, values in new.items())
        return new if changed else read

    def different(self, made: Instance) -> list[str]:
        """Return the parameters whose values differ from those that were read."""
        found = []
        for key in made.values:
            value = self.values.get(f"{made.name}.{key}")
            if value is not None and not isinstance(made.values[key], Instance | Stored | None):
                read = np.broadcast_to(np.asarray(made.values[key], value.dtype), value.shape)
                found += [key] if not np.array_equal(read, value) else []
        return found

    def with_values(self, element: Element, made: Instance, values: Mapping[str, np.ndarray]) -> Element:
        """Return the element with these values of its parameters, checked by reading it back.

        If that fails, as the file sets them by other names, such as a metal's material, it sets all parameters instead.
        """
        constant = {key: x for key, x in made.values.items() if not isinstance(x, Instance | Stored)}
        listed = {key: x for key, x in constant.items() if f"{made.name}.{key}" in self.values}
        every = listed | values
        known = made.kind.declared.keys() | made.kind.unused.keys() | {"to_world"}
        own = [child for child in element.children if child.attributes.get("name") in known or _is_object(child)]
        for children, stated in ((element.children, values), (own, every)):
            new = Element(element.tag, element.attributes, element.file, element.line)
            new.children = [child for child in children if child.attributes.get("name") not in stated]
            new.children += [_value(key, x, element) for key, x in stated.items()]
            if self.reads(new, made, every):
                return new
        names = ", ".join(f"{made.name}.{key}" for key in values)
        raise element.error(f"{element}: no scene file can say {names} = {list(map(str, values.values()))}")

    def reads(self, element: Element, made: Instance, values: Mapping[str, object]) -> bool:
        """Return whether reading the element gives an object with these values."""
        document = Document(self.document.root, self.document.ids, self.document.folders)
        try:
            again = read_again(document, element, made.name)
        except InputError:
            return False
        for key, value in values.items():
            x, declared = np.asarray(value), made.kind.declared[key]
            read = declared.absent if again.values.get(key) is None else again.values[key]
            if not np.array_equal(np.broadcast_to(np.asarray(read, x.dtype), x.shape), x):
                return False
        return True

    # ---- files

    def image(self, child: Element, parent: Element, name: str) -> Element:
        """Return the element, or, in place of an array, the <string> with the name of the file for it."""
        if child.tag != "array":
            return child
        if child.attributes["name"] != "data":
            raise child.error(f"{child} of {parent}: no scene file holds such an array")
        if parent.tag == "volume":
            file = self.file(name, ".vol")
            volume = self.made[parent]
            self.files[file] = lambda: volume.write(file, volume.data)
            return Element("string", {"name": "filename", "value": file.name}, child.file, child.line)
        data = np.atleast_3d(child.data)
        data = np.broadcast_to(data, (*data.shape[:2], 3))
        if data.dtype == np.uint16:
            says = {each.attributes.get("name"): each.attributes.get("value") for each in parent.children}
            data = decoded(data, raw=says.get("raw") == "true")
        file = self.file(name, ".png" if data.dtype == np.uint8 else ".exr")
        write = write_stored if data.dtype == np.uint8 else _write_linear
        self.files[file] = lambda: write(file, data)
        return Element("string", {"name": "filename", "value": file.name}, child.file, child.line)

    def with_image(self, element: Element, name: str, texels: np.ndarray) -> Element:
        """Return the bitmap with other texels, in a new file."""
        file = self.file(name, ".exr")
        self.files[file] = lambda: _write_linear(file, texels)
        return self.with_file(element, file)

    def with_array(self, element: Element, stored: Stored, name: str, values: np.ndarray) -> Element:
        """Return the volume with other values, in a new file."""
        file = self.file(name, ".vol")
        self.files[file] = lambda: stored.write(file, values)
        return self.with_file(element, file)

    @staticmethod
    def with_file(element: Element, file: Path) -> Element:
        """Return the element with this file in place of its previous one or of its array."""
        children = [x for x in element.children if x.attributes.get("name") not in ("filename", "data")]
        children.append(Element("string", {"name": "filename", "value": file.name}, element.file, element.line))
        return Element(element.tag, element.attributes, element.file, element.line, children)

    def mesh(self, element: Element, shape: d.Shape) -> Element:
        """Return the element of a new PLY file, in world space, for a mesh that changed or that Mitsuba cannot read."""
        file, geometry = self.file(shape.name, ".ply"), shape.geometry
        self.files[file] = lambda: ply_writer.write(file, geometry)
        gone = ("filename", "to_world", "face_normals", "flip_tex_coords")
        children = [Element("string", {"name": "filename", "value": file.name}, element.file, element.line)]
        if geometry.normals is None:
            children.append(Element("boolean", {"name": "face_normals", "value": "true"}, element.file, element.line))
        children += [x for x in element.children if x.tag != "array" and x.attributes.get("name") not in gone]
        return Element("shape", element.attributes | {"type": "ply"}, element.file, element.line, children)

    def file(self, name: str, suffix: str) -> Path:
        """Return an unused path beside the scene file."""
        stem = "_".join([self.path.stem, re.sub(r"[^\w-]", "_", name)])
        for number in itertools.count(1):
            made = self.path.with_name(f"{stem}{f'_{number}' if number > 1 else ''}{suffix}")
            if made not in self.files:
                check_writable(made, self.sources)
                return made


def _changed_images(made: Iterable[object], values: Mapping[str, np.ndarray]) -> dict[Instance, tuple[str, np.ndarray]]:
    """Return the images that are parameters and have changed: instance -> name of the parameter, and its texels."""
    owners = [owner for owner in made if isinstance(owner, Instance)]
    images = [(x, f"{owner.name}.{key}") for owner in owners for key, x in owner.values.items()]
    images += [(owner, f"{owner.name}.radiance") for owner in owners]  # environment maps
    found = {}
    for image, name in images:
        if isinstance(image, Instance) and "texels" in image.values and name in values:
            value, read = values[name], image.values["texels"].astype(values[name].dtype)
            if value.ndim == 2:  # of a scalar parameter
                value, read = np.stack([value] * 3, -1), np.stack([luminance(read)] * 3, -1)
            if not np.array_equal(np.broadcast_to(read, value.shape), value):
                found[image] = name, value
    return found


def _changed_arrays(
    made: Iterable[object], values: Mapping[str, np.ndarray]
) -> dict[Stored, tuple[str, np.ndarray]]:
    """Return the volumes, of media and of textures, that are parameters and have changed, as `_changed_images` does."""
    owners = [owner for owner in made if isinstance(owner, Instance)]
    volumes = [(x, f"{owner.name}.{key}") for owner in owners for key, x in owner.values.items()]
    volumes += [(v, name) for x, name in volumes if isinstance(x, Instance) for v in x.values.values()]
    found = {}
    for volume, name in volumes:
        if isinstance(volume, Stored) and name in values:
            value = values[name][..., None] if values[name].ndim == 3 else values[name]
            read = volume.data.astype(value.dtype)
            read = luminance(read)[..., None] if value.shape[3] < read.shape[3] else read
            if not np.array_equal(np.broadcast_to(read, value.shape), value):
                found[volume] = name, value
    return found


def _has_arrays(element: Element) -> bool:
    return any(child.tag == "array" for child in element.children)


def _is_object(child: Element) -> bool:
    return child.tag == "ref" or "type" in child.attributes


def _value(key: str, value: object, element: Element) -> Element:
    """Return the element that sets a parameter to exactly this value."""
    value = np.asarray(value)
    if value.shape == (3,) and value.min() == value.max() > 1:
        value = value[0]  # Mitsuba accepts an <rgb> above 1 only for light, but any <float>
    tag = {(): "float", (3,): "rgb"}.get(value.shape)
    if tag is None:
        raise element.error(f'{element}: "{key}" has the shape {value.shape}, which no scene file can say')
    text = ", ".join(str(x) for x in value.ravel())
    return Element(tag, {"name": key, "value": text}, element.file, element.line)


def _write_linear(path: Path, data: np.ndarray) -> None:
    write_exr(path, {name: data[..., i] for i, name in enumerate("RGB")}, {})
