"""Typed reading of one plugin element: each parameter is read once, and `finish` refuses parameters not read."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pathjax.description import spectra
from pathjax.description.elements import Document, Element, nearest, require_attributes
from pathjax.description.numbers import number, numbers, transform, triple
from pathjax.errors import InputError
from pathjax.kinds import Unused

VALUES = ("float", "integer", "boolean", "string", "rgb", "spectrum", "point", "vector", "transform")
# Objects that are values of parameters; and all objects.
NAMED = ("texture", "volume")
OBJECTS = ("integrator", "sensor", "sampler", "film", "rfilter", "shape", "bsdf", "emitter", "medium", "phase", *NAMED)

# Spectra that are plugins, which are also textures of one colour. (`uniform` is a kind of texture here.)
TYPED = ("uniform", "d65", "srgb", "rawconstant")
ONE_COLOR = TYPED[1:]
BAND = dict.fromkeys(("wavelength_min", "wavelength_max"), Unused("float", "colours are linear RGB"))  # of a uniform
REQUIRED = object()
# Tag of an element -> the form of its value in dictionaries, for messages.
IN_DICTIONARIES = {
    "float": "a float",
    "integer": "an integer",
    "boolean": "a bool",
    "string": "a string",
    "rgb": '{"type": "rgb", "value": [r, g, b]}',
    "spectrum": '{"type": "spectrum", "value": ...}',
    "point": "three numbers",
    "vector": "three numbers",
    "transform": "a pj.Transform or a (4, 4) matrix",
    "array": "an array",
}


class Fields:
    """The contents of one plugin element: parameters by name, and nested or referenced objects."""

    def __init__(self, document: Document, element: Element):
        require_attributes(element, required=("type",), optional=("id", "name"))
        self.document = document
        self.element = element
        self.type = element.attributes["type"]
        self.known: list[str] = []
        self._values: dict[str, Element] = {}
        self._objects: list[Element] = []
        self._taken: set[str] = set()
        self.notes: list[str] = []  # for `info`
        for child in element.children:
            target = document.resolve(child)
            if child.tag not in (*VALUES, *OBJECTS, "ref") and child.data is None:
                raise child.error(f"{child} is not supported inside {element}; use one of: {', '.join(VALUES)}, ref")
            if target is not child and target.tag not in OBJECTS:
                raise child.error(f"{child} refers to {target}, which is not an object")
            if target.tag in OBJECTS and target.tag not in NAMED:
                self._objects.append(child)
                continue
            name = child.attributes.get("name")
            if not name and target.tag == "texture":
                name = f"_arg_{len(self._values)}"  # Mitsuba's name for it; only `only_texture` takes it
            if not name:
                raise self._nameless(child)
            if name in self._values:
                raise child.error(f'"{name}" is given twice; the first is at {self._values[name].place}')
            self._values[name] = child

    def where(self, name: str) -> Element:
        """Return the element that sets `name`, or the plugin's own if the file does not set it."""
        return self._values.get(name, self.element)

    def error(self, name: str, message: str) -> InputError:
        return self.where(name).error(f'"{name}" of <{self.element.tag} type="{self.type}"> {message}')

    def has(self, name: str) -> bool:
        return name in self._values

    def float(
        self, name: str, default=REQUIRED, *, above=-math.inf, at_least=-math.inf, below=math.inf, at_most=math.inf
    ):
        """Return a finite number, above < number < below and at_least <= number <= at_most; `default` if not given."""
        element = self._take(name, default, ("float", "integer"))
        if element is None:
            return default
        value = number(element, _value(element))
        if not (above < value < below and at_least <= value <= at_most):
            low = f"above {above:g}" if above > -math.inf else f"at least {at_least:g}"
            high = f" and below {below:g}" if below < math.inf else ""
            high = f" and at most {at_most:g}" if at_most < math.inf else high
            raise self.error(name, f"must be {low}{high}, is {value:g}")
        return value

    def integer(self, name: str, default=REQUIRED, *, at_least: int, at_most: int = 2**31 - 1):
        element = self._take(name, default, ("integer",))
        if element is None:
            return default
        text = _value(element).strip()
        if not re.fullmatch(r"[+-]?\d{1,19}", text):
            raise element.error(f"{element}: {text[:40]!r} is not an integer")
        if not at_least <= int(text) <= at_most:
            span = f"{at_least}" if at_least == at_most else f"from {at_least} to {at_most}"
            raise self.error(name, f"must be {span}, is {int(text)}")
        return int(text)

    def boolean(self, name: str, default=REQUIRED):
        element = self._take(name, default, ("boolean",))
        if element is None:
            return default
        text = _value(element).strip().lower()
        if text not in ("true", "false"):
            raise element.error(f'{element}: {text[:40]!r} is neither "true" nor "false"')
        return text == "true"

    def string(self, name: str, default=REQUIRED, *, choices: tuple[str, ...] = ()):
        element = self._take(name, default, ("string",))
        if element is None:
            return default
        text = _value(element)
        if not choices:
            return text
        if text.lower() not in choices:
            raise self.error(name, f'cannot be "{text[:40]}"; use {" or ".join(choices)}{nearest(text, choices)}')
        return text.lower()

    def float_or_name(self, name: str, default: str | float, *, at_least: float):
        """Return a number, or the text of a <string>."""
        if self.has(name) and self._values[name].tag == "string":
            return self.string(name)
        return self.float(name, default, at_least=at_least)

    def point(self, name: str, default=REQUIRED):
        """Return (3,) float64, written as x, y, z attributes or as value="x, y, z"."""
        element = self._take(name, default, ("point", "vector"))
        return default if element is None else triple(element, default=None, extra=("name",))

    def color(self, name: str, default=REQUIRED, *, at_most: float = math.inf, radiance: bool = False):
        """Return (3,) float64 linear RGB, each channel in [0, at_most], from <rgb>, <spectrum> or a number.

        radiance: it is emitted light; otherwise a reflectance or an index of refraction, as seen under white light.
        """
        if self._one_color(name):
            return self._typed_spectrum(self.document.resolve(self._take(name, default, ("texture", "ref"))), at_most)
        element = self._take(name, default, ("rgb", "spectrum", "float", "integer"))
        if element is None:
            return default
        if element.tag == "spectrum" and "type" in element.attributes:
            return self._typed_spectrum(element, at_most)
        by_wavelength = "filename" in element.attributes or ":" in element.attributes.get("value", "")
        if element.tag == "spectrum" and by_wavelength:
            return self._listed_spectrum(element, at_most, radiance)
        text = _value(element)
        if text.strip().startswith("#"):
            raise element.error(f'{element}: hexadecimal colours are not supported; give linear RGB, value="r, g, b"')
        values = np.array(numbers(element, text))
        if len(values) != 1 and (len(values) != 3 or element.tag != "rgb"):
            raise element.error(f"{element} has {len(values)} numbers; <rgb> takes 1 or 3, others 1")
        if values.min() < 0 or values.max() > at_most:
            limit = "not be negative" if at_most == math.inf else f"lie between 0 and {at_most:g}"
            raise self.error(name, f"must {limit}, is {text.strip()[:60]}")
        scale = spectra.UNIFORM_RADIANCE if radiance and element.tag == "spectrum" else np.ones(3)
        return values * scale

    def _typed_spectrum(self, element: Element, at_most: float) -> np.ndarray:
        """Return the colour of a spectrum with a type. Mitsuba takes all of these as linear RGB without conversion."""
        fields = Fields(self.document, element)
        match fields.type:
            case "uniform":
                color = np.full(3, fields.float("value", at_least=0, at_most=at_most))
                self.notes += fields.without_effect(BAND)
            case "srgb":
                color = fields.triple_or_color("color", at_most=at_most)
            case "rawconstant":
                color = fields.triple_or_color("value", at_most=at_most)
            case "d65":
                color = fields.triple_or_color("color", np.ones(3)) * fields.float("scale", 1.0, at_least=0)
                if color.max() > at_most:
                    raise element.error(f"{element} must lie between 0 and {at_most:g}, is {color.max():g}")
            case "blackbody" | "regular" | "irregular":
                remedy = 'give its colour as <rgb>, or wavelengths as <spectrum value="400:0.1, 500:0.2, ...">'
                raise element.error(f"{element} has no colour in Mitsuba's RGB mode, which scenes are in; {remedy}")
            case _:
                raise element.error(f"{element} is not supported; use one of {', '.join(TYPED)}")
        fields.finish()
        return color

    def triple_or_color(self, name: str, default=REQUIRED, *, at_most: float = math.inf):
        """Return `color`, which may also be given as a vector."""
        if self.where(name).tag not in ("vector", "point"):
            return self.color(name, default, at_most=at_most)
        given = self.point(name)
        if given.min() < 0 or given.max() > at_most:
            raise self.error(name, f"must lie between 0 and {at_most:g}, is {', '.join(f'{c:g}' for c in given)}")
        return given

    def gives_color(self, name: str) -> bool:
        """Return whether the element that sets a parameter is a colour, rather than a number or a texture."""
        return self.where(name).tag in ("rgb", "spectrum") or self._one_color(name)

    def _one_color(self, name: str) -> bool:
        return self.has(name) and is_one_color(self.document.resolve(self._values[name]))

    def _listed_spectrum(self, element: Element, at_most: float, radiance: bool) -> np.ndarray:
        """Return the colour of values by wavelength, given in the scene file or in a file that it names."""
        if "filename" in element.attributes:
            require_attributes(element, required=("name", "filename"))
            pairs = _pairs_of_file(self.document.find(element.attributes["filename"], element), element)
        else:
            pairs = [numbers(element, each.replace(":", " ")) for each in re.split(r"[\s,]+", _value(element).strip())]
            if any(len(pair) != 2 for pair in pairs):
                raise element.error(f'{element} must be pairs of a wavelength in nm and a value, "400:0.1, 500:0.2"')
        wavelengths, values = np.array(pairs).T if len(pairs) > 1 else (np.zeros(1),) * 2
        if not (np.diff(wavelengths) > 0).all() or len(pairs) < 2:
            raise element.error(f"{element} must have two wavelengths or more, in ascending order")
        color = spectra.rgb(wavelengths, values, lit=not radiance)
        if not (np.abs(color) < 3e38).all():
            raise element.error(f"{element} overflows")
        shown = np.clip(color, 0, at_most)
        if (shown != color).any():
            was = ", ".join(f"{c:.4g}" for c in color)
            self.notes.append(f"{element.place}: {element} has the colour {was}, which is clipped")
        return shown

    def array(self, name: str, default=REQUIRED) -> np.ndarray | None:
        """Return an array of any shape, which only dictionaries can give."""
        element = self._take(name, default, ("array",))
        return default if element is None else element.data

    def texture(self, name: str, tag: str = "texture") -> Element | None:
        """Return the <texture>, or other object of NAMED, that sets `name`; None: read the parameter by `color`."""
        if not self.has(name) or self.document.resolve(self._values[name]).tag != tag or self._one_color(name):
            return None
        self._take(name, None, (tag, "ref"))
        return self.document.resolve(self._values[name])

    def only_texture(self) -> Element:
        """Return the only <texture> in the element, which may have any name."""
        names = [name for name, child in self._values.items() if self.document.resolve(child).tag == "texture"]
        if len(names) != 1:
            raise self.element.error(f"{self.element} needs one <texture> inside, and has {len(names)}")
        self._taken.add(names[0])
        return self.document.resolve(self._values[names[0]])

    def transform(self, name: str) -> np.ndarray:
        """Return (4, 4) float64, the element's steps in the order of the file; the identity if it is not given."""
        element = self._take(name, None, ("transform",))
        return np.eye(4) if element is None else transform(element)

    def objects(self, tag: str, limit: int = 1) -> list[Element]:
        """Take the nested or referenced objects of this tag, in the order of the file."""
        found = [child for child in self._objects if self.document.resolve(child).tag == tag]
        self._objects = [child for child in self._objects if child not in found]
        if len(found) > limit:
            raise found[limit].error(f"{self.element} takes at most {limit} <{tag}>")
        return [self.document.resolve(child) for child in found]

    def object(self, tag: str, name: str) -> Element | None:
        """Take the nested or referenced object of this tag and name; None: there is none."""
        for child in self._objects:
            if child.attributes.get("name") == name and self.document.resolve(child).tag == tag:
                self._objects = [each for each in self._objects if each is not child]
                return self.document.resolve(child)
        return None

    def without_effect(self, parameters: Mapping[str, Unused]) -> list[str]:
        """Check those of the parameters that the file gives, and return a note for each."""
        notes = []
        for name, unused in parameters.items():
            match unused.tag:
                case "float":
                    self.float(name, None, at_least=unused.at_least)
                case "color":
                    self.color(name, None)
                case "integer":
                    self.integer(name, None, at_least=max(unused.at_least, 0), at_most=2**32 - 1)
                case "boolean":
                    self.boolean(name, None)
                case "string":
                    self.string(name, None, choices=unused.choices)
                case "transform":
                    self.transform(name)
            if self.has(name):
                why = unused.why and f": {unused.why}"
                notes.append(f"{self.where(name).place}: {name} has no effect{why}")
        return notes

    def finish(self) -> None:
        """Refuse parameters and objects that no call has read."""
        for name, child in self._values.items():
            if name not in self._taken:
                if not child.attributes.get("name"):
                    raise self._nameless(child)
                known = ", ".join(self.known) or "none"
                raise child.error(
                    f"{child} is not a parameter of {self.element}; it has: {known}{nearest(name, self.known)}"
                )
        for child in self._objects:
            raise child.error(f"{child} has no place inside {self.element}")

    def lacks(self, tag: str, name: str, remedy: str = "") -> InputError:
        """Return the error that a required parameter is missing, with a parameter that may be a misspelling of it."""
        given = [self._values[other] for other in self._values if other not in self._taken]
        misspelt = [each for each in given if nearest(each.attributes.get("name", ""), [name])]
        remedy += f"; is it {misspelt[0]} at {misspelt[0].place}?" if misspelt else ""
        what = f'<{tag} name="{name}" ...>' if self.element.line else f'"{name}", {self._shown(tag)}'
        return self.element.error(f"{self.element} needs {what}{remedy}")

    def _shown(self, tag: str) -> str:
        """Return an element of that tag as it is written in this scene, a file or a dictionary."""
        return f"<{tag}>" if self.element.line else IN_DICTIONARIES.get(tag, f"a {tag}")

    def _nameless(self, child: Element) -> InputError:
        return child.error(f'{child} inside {self.element} lacks name="...", the parameter that it sets')

    def _take(self, name: str, default: object, tags: tuple[str, ...]) -> Element | None:
        self.known.append(name)
        self._taken.add(name)
        if name not in self._values:
            if default is REQUIRED:
                raise self.lacks(tags[0], name)
            return None
        element = self._values[name]
        if element.tag not in tags:
            kind, a = self.document.resolve(element).tag, "a " if self.element.line else ""
            wanted = " or ".join(dict.fromkeys(map(self._shown, tags)))
            raise self.error(name, f"cannot be {a}{self._shown(kind)}; give it as {wanted}")
        if element.children and element.tag not in ("transform", *NAMED) and "type" not in element.attributes:
            raise element.children[0].error(f"{element.children[0]} has no place inside {element}")
        return element


def is_one_color(element: Element) -> bool:
    """Return whether a <texture> is a spectrum, which has one colour everywhere."""
    return element.tag == "texture" and element.attributes.get("type") in ONE_COLOR


def _pairs_of_file(path: Path, element: Element) -> list[list[float]]:
    """Return the pairs of wavelength and value in a file, one pair per line; lines that begin with # are comments."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise element.error(f"{path} cannot be read: {error.strerror}") from None
    pairs = []
    for count, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        pairs.append(numbers(element, line))
        if len(pairs[-1]) != 2:
            raise element.error(f"{path}:{count}: {line.strip()[:40]!r} must be a wavelength in nm and a value")
    return pairs


def _value(element: Element) -> str:
    require_attributes(element, required=("name", "value"))
    return element.attributes["value"]
