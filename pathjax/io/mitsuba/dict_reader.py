"""Convert scenes that are Python dictionaries, in Mitsuba's form, to the elements of a scene file.

So kinds, bounds and messages are the same for both. The place of an element is the keys that lead to it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path

import numpy as np

from pathjax import bsdfs, emitters, media, sensors, shapes, textures
from pathjax.compile import is_traced
from pathjax.description.elements import Document, Element, find_file, nearest
from pathjax.description.fields import ONE_COLOR
from pathjax.errors import InputError
from pathjax.io.mitsuba import integrators, mesh_objects, samplers
from pathjax.io.mitsuba.plugins import PLUGINS
from pathjax.io.mitsuba.xml_reader import MAX_DEPTH, by_id
from pathjax.sensors import film, filters

VERSION = "3.0.0"
SPECTRA = ("blackbody", "regular", "irregular")
_MATRICES = ((3, 3), (4, 4))
VALUE_TYPES = ("rgb", "spectrum", "ref", "resources")


def read(scene: Mapping, name: str = "scene") -> Document:
    """Convert a scene.

    Args:
        name: name of the scene, with which all places begin.
    Raises:
        InputError: a value of an unsupported Python type, a dictionary inside itself, an unknown "type", or a duplicate
            id; the message has the keys that lead there.
    """
    return _Reader(name).document(scene)


def element(name: str, value: Mapping, parent: Element) -> Element:
    """Convert a dictionary to another object of a document, whose place is that of `parent`."""
    made = _Reader(parent.place).object(name, value, parent.place, top=False)
    del made.attributes["name"]
    return made


def rooms() -> dict[str, Mapping[str, object]]:
    """Return tag of an element -> kinds by name."""
    return {
        "integrator": integrators.KINDS,
        "sensor": sensors.KINDS,
        "sampler": samplers.KINDS,
        "film": film.KINDS,
        "rfilter": filters.KINDS,
        "shape": shapes.KINDS,
        "bsdf": bsdfs.KINDS,
        "texture": textures.KINDS,
        "emitter": emitters.KINDS,
        "medium": media.KINDS,
        "phase": media.PHASES,
        "volume": media.VOLUMES,
    }


class _Reader:
    """The state that all levels share: the dictionaries around the current one, and the objects by their keys."""

    def __init__(self, name: str):
        self.name = name
        self.kinds = rooms()
        self.around: list[object] = []
        self.paths: dict[str, Element] = {}
        self.referred: set[str] = set()
        self.folders = [Path()]

    def document(self, scene: Mapping) -> Document:
        if not isinstance(scene, Mapping) or scene.get("type") != "scene":
            must = 'must be a dictionary with "type": "scene", which holds all others by name'
            raise InputError(f"{self.name}: {must}")
        root = Element("scene", {"version": VERSION}, self.name, 0, self.children(scene, self.name, top=True))
        # A <ref> may give keys instead of an id: `shape.bsdf`.
        for path in self.referred & self.paths.keys():
            self.paths[path].attributes.setdefault("id", path)
        return Document(root, self.paths | by_id(root), tuple(self.folders))

    def children(self, items: Mapping, place: str, top: bool = False) -> list[Element]:
        """Convert the values of a dictionary, except its type and id."""
        if len(self.around) >= MAX_DEPTH:
            raise InputError(f"{place}: dictionaries are nested more than {MAX_DEPTH} deep")
        self.around.append(items)
        found = []
        for key, value in items.items():
            if not isinstance(key, str) or not key.isprintable() or not re.fullmatch(r"[^.\s]+", key):
                raise InputError(f"{place}: a key must be a string without dots and spaces, is {_shown(key)}")
            if key not in ("type", "id") and (made := self.value(key, value, f"{place}.{key}", top)) is not None:
                found.append(made)
        self.around.pop()
        return found

    def value(self, key: str, value: object, place: str, top: bool) -> Element | None:
        if isinstance(value, Mapping):
            if any(each is value for each in self.around):
                raise InputError(f"{place}: this dictionary stands inside itself; refer to objects by their id")
            kind = value.get("type")
            if key.startswith("to_"):
                raise InputError(f"{place}: a transform is a pj.Transform or a (4, 4) matrix, and no dictionary")
            if not isinstance(kind, str):
                raise InputError(f'{place}: a dictionary needs a "type", the name of a kind; it has {_shown(kind)}')
            if kind in VALUE_TYPES:
                return getattr(self, f"_{kind}")(key, value, place)
            return self.object(key, value, place, top)
        if mesh_objects.is_mesh(value):
            return self.object(key, {"type": "mesh", "mesh": value}, place, top)
        if np.shape(getattr(value, "matrix", ()))[:2] in _MATRICES:  # Dr.Jit's points have an attribute matrix too
            return _transform(key, value.matrix, place)
        if type(value).__name__.endswith("Color3f"):  # of Mitsuba
            return _element("rgb", key, place, _text(_array(value, place)))
        if isinstance(value, bool | np.bool_):
            return _element("boolean", key, place, str(bool(value)).lower())
        if isinstance(value, Real):
            return _number(key, value, place)
        if isinstance(value, str | os.PathLike):
            return _element("string", key, place, _string(value, place))
        return self.array(key, _array(value, place), place)

    def array(self, key: str, array: np.ndarray, place: str) -> Element:
        """Convert an array: a scalar, a point, a matrix, or data."""
        if not array.ndim:
            return _number(key, array.item(), place)
        if key.startswith("to_"):
            return _transform(key, array, place)
        if array.shape == (3,):
            return _element("point", key, place, _text(array))
        if array.ndim == 1:
            raise InputError(f"{place}: must be one number or three, has {len(array)}")
        name = "data" if key in ("bitmap", "grid") else key  # Mitsuba's keys for its own Bitmap and VolumeGrid
        if key == "bitmap" and array.ndim == 3 and array.shape[2] == 4:
            array = array[..., :3]  # Mitsuba drops alpha too
        return Element("array", {"name": name}, place, 0, data=array)

    def object(self, key: str, value: Mapping, place: str, top: bool) -> Element:
        """Convert an object of the kind that `type` names. At the top level its key is its id."""
        tag = self.tag(value["type"], place)
        attributes = {"type": value["type"]} | ({} if top else {"name": key})
        name = value.get("id", key if top else None)
        if name is not None:
            attributes["id"] = _string(name, place)
        if tag == "shape" and "mesh" in value:
            value = self.mesh(value["mesh"], {key: each for key, each in value.items() if key != "mesh"}, place)
        element = Element(tag, attributes, place, 0)
        element.children = self.children(value, place)
        if tag not in ("shape", "texture"):  # there arrays are the object's own data; elsewhere they are images
            element.children = [_as_texture(child) for child in element.children]
        self.paths[place.removeprefix(f"{self.name}.")] = element
        return element

    def mesh(self, mesh: object, beside: dict, place: str) -> dict:
        """Return the arrays of a mesh object, its bsdf and emitter, and the values beside it, which override these."""
        kinds = [each.get("type") for each in beside.values() if isinstance(each, Mapping)]
        given = ["bsdf" if kind == "ref" else self.tag(kind, place) for kind in kinds if isinstance(kind, str)]
        arrays = mesh_objects.arrays_of(mesh, place, lambda numbers: _array(numbers, place))
        return mesh_objects.appearance_of(mesh, place, given) | arrays | beside

    def tag(self, kind: str, place: str) -> str:
        found = [tag for tag, kinds in self.kinds.items() if kind in kinds]
        if len(found) > 1:
            raise InputError(f'{place}: "{kind}" is the name of kinds of {" and ".join(found)}; register other names')
        found += ["spectrum"] if kind in SPECTRA else ["texture"] if kind in ONE_COLOR else []
        found += [tag for tag, names in PLUGINS.items() if kind in names]
        if not found:
            known = [name for kinds in self.kinds.values() for name in kinds] + list(VALUE_TYPES)
            raise InputError(f'{place}: no kind is named "{_string(kind, place)[:60]}"{nearest(kind, known)}')
        return found[0]

    # ---- dictionaries that are values, not objects

    def _rgb(self, key: str, value: Mapping, place: str) -> Element:
        given = _only(value, ("value",), place)
        return _element("rgb", key, place, _text(_array(given["value"], place).reshape(-1)))

    def _spectrum(self, key: str, value: Mapping, place: str) -> Element:
        """Convert a spectrum: a number, pairs of wavelength and number, or a file."""
        if "filename" in value:
            filename = _only(value, ("filename",), place)["filename"]
            return Element("spectrum", {"name": key, "filename": _string(filename, place)}, place, 0)
        array = _array(_only(value, ("value",), place)["value"], place)
        if array.ndim == 2 and array.shape[1] == 2:
            return _element("spectrum", key, place, ", ".join(f"{float(w)!r}:{float(x)!r}" for w, x in array))
        if array.ndim:
            raise InputError(f"{place}: a spectrum is a number or pairs of wavelength and number, not {array.shape}")
        return _element("spectrum", key, place, repr(float(array)))

    def _ref(self, key: str, value: Mapping, place: str) -> Element:
        name = _string(_only(value, ("id",), place)["id"], place)
        self.referred.add(name)
        return Element("ref", {"name": key, "id": name}, place, 0)

    def _resources(self, key: str, value: Mapping, place: str) -> None:
        """Add a folder in which files are searched."""
        name, element = _only(value, ("path",), place)["path"], Element("path", {"name": key}, place, 0)
        self.folders.append(find_file(_string(name, place), self.folders, element, folder=True))


def _string(value: object, place: str) -> str:
    if not isinstance(value, str | os.PathLike) or not str(value).isprintable():
        raise InputError(f"{place}: must be a string of one line, is {_shown(value)}")
    return str(value)


def _shown(value: object) -> str:
    """Return a short repr on one line, for a message."""
    return " ".join(repr(value).split())[:60]


def _only(value: Mapping, keys: tuple[str, ...], place: str) -> Mapping:
    """Return the dictionary after checking that it has exactly these keys besides its type."""
    for key in keys:
        if key not in value:
            raise InputError(f'{place}: {{"type": "{value["type"]}", ...}} lacks "{key}"')
    for key in value:
        if key not in ("type", *keys):
            raise InputError(f'{place}: "{value["type"]}" takes {", ".join(keys)}, and no {_shown(key)}')
    return value


def _element(tag: str, key: str, place: str, text: str) -> Element:
    return Element(tag, {"name": key, "value": text}, place, 0)


def _number(key: str, value: object, place: str) -> Element:
    if isinstance(value, Integral):
        return _element("integer", key, place, str(int(value)))
    return _element("float", key, place, repr(float(value)))


def _text(array: np.ndarray) -> str:
    """Format numbers such that they are parsed back exactly."""
    return ", ".join(repr(float(x)) for x in array.ravel())


def _transform(key: str, matrix: object, place: str) -> Element:
    matrix = _array(matrix, place)
    if matrix.shape not in _MATRICES:
        raise InputError(f"{place}: a transform is a pj.Transform or a (4, 4) matrix, has the shape {matrix.shape}")
    if key == "to_uv" and matrix.shape == (3, 3):  # acts on (u, v, 1), as Mitsuba's `ScalarTransform3f`
        of_plane, matrix = matrix, np.eye(4)
        matrix[np.ix_([0, 1, 3], [0, 1, 3])] = of_plane
    step = Element("matrix", {"value": _text(matrix)}, place, 0)
    return Element("transform", {"name": key}, place, 0, [step])


def _array(value: object, place: str) -> np.ndarray:
    """Convert a list, or an array of NumPy, JAX or Dr.Jit, to a NumPy array of numbers."""
    if is_traced(value):
        raise InputError(f"{place}: is traced; load the scene with numbers, and set parameters by pj.with_parameters")
    try:
        array = np.asarray(value)
    except Exception:  # whatever a foreign object, or a list of lists of different lengths, raises
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        if isinstance(value, str):
            raise InputError(f"{place}: must be a number, or a list or an array of numbers, is {_shown(value)}")
        if type(value).__module__.partition(".")[0] == "mitsuba":
            kind = f"{type(value).__name__} of Mitsuba"
            raise InputError(f"{place}: a {kind} cannot be read back; give the dictionary that it is made of")
        kinds = "a number, a string, a list of numbers, an array, a transform or a dictionary"
        raise InputError(f"{place}: a value of type {type(value).__name__} has no place in a scene; use {kinds}")
    # Dr.Jit's arrays have an extra last axis, for lanes.
    if not isinstance(value, list | tuple | np.ndarray) and array.shape[-1:] == (1,):
        array = array[..., 0]
    return array


def _as_texture(child: Element) -> Element:
    """Return the element, or a bitmap in place of an array, except for `data`, which is the object's own."""
    if child.tag != "array" or child.attributes["name"] == "data":
        return child
    data = Element("array", {"name": "data"}, child.file, 0, data=child.data)
    return Element("texture", {"name": child.attributes["name"], "type": "bitmap"}, child.file, 0, [data])
