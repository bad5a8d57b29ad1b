"""Parse scene XML to a tree of elements with line numbers; resolve includes, `default`, `$name`, ids and aliases.

`loader.py` and the kinds interpret the elements.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.parsers import expat

import numpy as np

from pathjax.description.elements import Document, Element, find_file, nearest, require_attributes
from pathjax.errors import InputError
from pathjax.io.mitsuba.plugins import PLUGINS
from pathjax.io.mitsuba.upgrade import upgrade

# Far above any real scene (meshes are in separate files), and low enough that a hostile file fails at once.
MAX_BYTES = 64 << 20
MAX_DEPTH = 32
MAX_ELEMENTS = 1_000_000
MAX_FILES = 1_000
MAX_VALUE = 10_000

REFERENCE = re.compile(r"\$(\w+)")
_DECLARATION = re.compile(rb"\s*(<\?xml\b[^>]*\?>)")
_AMPERSAND = re.compile(rb"&(?!#?\w{1,8};)")
# With its declarations in brackets; quoted strings may contain any of these characters.
_DOCTYPE = re.compile(rb"""<!DOCTYPE(?:[^]["'>]|"[^"]*"|'[^']*'|\[(?:[^]"']|"[^"]*"|'[^']*')*\])*>""")


def read(path: str | Path, parameters: Mapping[str, object]) -> Document:
    """Read a scene file and the files that it includes.

    Args:
        parameters: values that override the file's `default`s; each must be used by the file.
    Raises:
        InputError: unreadable or malformed XML, an include cycle, an unknown `$name`, a duplicate id.
    """
    reader = _Reader(Path(path), {name: _as_text(value) for name, value in parameters.items()})
    root = reader.expand(_parse(Path(path), str(path), reader.notes), chain=(Path(path).resolve(),))
    reader.check_parameters(str(path))
    ids = by_id(root)
    for alias in reader.aliases:
        name = alias.attributes["as"]
        if alias.id not in ids:
            raise alias.error(f'{alias}: there is no id "{alias.id[:60]}"{nearest(alias.id, ids)}')
        if name in ids:
            raise alias.error(f'the id "{name}" is taken already, at {ids[name].file}:{ids[name].line}')
        ids[name] = ids[alias.id]
    return Document(root, ids, tuple(reader.folders), reader.found, tuple(reader.notes))


def by_id(root: Element) -> dict[str, Element]:
    """Return the elements that have an id, by id. A duplicate id is an InputError."""
    ids: dict[str, Element] = {}
    for element in _walk(root):
        if element.tag != "ref" and element.id:
            if element.id in ids:
                raise element.error(f'the id "{element.id}" is taken already, at {ids[element.id].place}')
            ids[element.id] = element
    return ids


class _Reader:
    """The state that includes share: the values of `$name`, the folders to search, and how much has been read."""

    def __init__(self, path: Path, parameters: dict[str, str]):
        self.given = parameters
        self.values = dict(parameters)
        self.used: set[str] = set()
        self.folders = [path.parent]
        self.elements = 0
        self.files = 1
        self.aliases: list[Element] = []
        self.found: dict[Element, Path] = {}
        self.notes: list[str] = []

    def expand(self, root: Element, chain: tuple[Path, ...]) -> Element:
        if root.tag != "scene":
            raise root.error(f'the outermost element is {root}; a scene file starts with <scene version="3.0.0">')
        require_attributes(root, required=("version",), optional=("id", "name"))
        version = root.attributes["version"]
        if not re.fullmatch(r"\d{1,9}\.\d{1,9}\.\d{1,9}", version):
            raise root.error(f'scene version "{version}" is not of the form "3.0.0"; use that, Mitsuba 3\'s')
        if int(version.partition(".")[0]) < 2:
            upgrade(root)
        self._expand(root, chain)
        return root

    def _expand(self, parent: Element, chain: tuple[Path, ...]) -> None:
        """Substitute `$name`s, apply and remove directives, and insert included elements, in the order of the file."""
        children: list[Element] = []
        for element in parent.children:
            self._substitute(element)
            match element.tag:
                case "default":
                    _check(element, required=("name", "value"))
                    self.used.add(element.attributes["name"])
                    self.values.setdefault(element.attributes["name"], element.attributes["value"])
                case "path" if parent.tag == "scene":
                    _check(element, required=("value",))
                    self.folders.append(find_file(element.attributes["value"], self.folders, element, folder=True))
                case "alias":
                    _check(element, required=("id", "as"))
                    self.aliases.append(element)
                case "include":
                    children += self._include(element, parent, chain)
                case _:
                    self._expand(element, chain)
                    children.append(element)
        parent.children = children

    def _include(self, element: Element, parent: Element, chain: tuple[Path, ...]) -> list[Element]:
        """Return the objects of another file; directly in <scene>, all its elements."""
        _check(element, required=("filename",), optional=("name",))
        path = find_file(element.attributes["filename"], [*self.folders, chain[-1].parent], element)
        self.found[element] = path
        if path.resolve() in chain:
            raise element.error(f'the file "{path}" includes itself')
        self.files += 1
        if self.files > MAX_FILES or len(chain) > MAX_DEPTH:
            raise element.error(f"more than {MAX_FILES} included files, or {MAX_DEPTH} within one another")
        found = self.expand(_parse(path, str(path), self.notes), (*chain, path.resolve())).children
        objects = [each for each in found if parent.tag == "scene" or each.tag in (*PLUGINS, "ref")]
        for each in (each for each in found if each not in objects):
            self.notes.append(f"{each.place}: {each} is in no object of its file, and has no effect in {parent}")
        return objects

    def _substitute(self, element: Element) -> None:
        self.elements += 1
        if self.elements > MAX_ELEMENTS:
            raise element.error(f"the scene has more than {MAX_ELEMENTS} elements")
        for key, text in element.attributes.items():
            if "$" in text:
                element.attributes[key] = REFERENCE.sub(lambda match: self._value(match[1], element), text)
                if len(element.attributes[key]) > MAX_VALUE:
                    raise element.error(f'the attribute "{key}" grows beyond {MAX_VALUE} characters')

    def _value(self, name: str, element: Element) -> str:
        self.used.add(name)
        if name not in self.values:
            raise element.error(
                f'${name} is not defined; put <default name="{name}" value="..."/> before it, or pass {name}=...'
                f"{nearest(name, self.values)}"
            )
        return self.values[name]

    def check_parameters(self, file: str) -> None:
        for name in self.given:
            if name not in self.used:
                known = ", ".join(sorted(self.used)) or "none"
                raise InputError(
                    f'{file}: the scene has no parameter "{name}"; it has: {known}{nearest(name, sorted(self.used))}'
                )


def _check(element: Element, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> None:
    require_attributes(element, required, optional)
    if element.children:
        raise element.error(f"{element} takes nothing inside")


def _parse(path: Path, shown: str, notes: list[str]) -> Element:
    data = _well_formed(_read_bytes(path, shown))
    parser = expat.ParserCreate()
    stack: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, shown, parser.CurrentLineNumber)
        if len(stack) >= MAX_DEPTH:
            raise element.error(f"elements are nested more than {MAX_DEPTH} deep")
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    def text(data: str) -> None:
        if data.strip():
            line = parser.CurrentLineNumber
            notes.append(f"{shown}:{line}: text between elements has no effect: {data.strip()[:40]!r}")

    def doctype(*_: object) -> None:
        raise InputError(f"{shown}:{parser.CurrentLineNumber}: a document type (<!DOCTYPE>) is not allowed; remove it")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = doctype
    parser.EntityDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except InputError:
        raise
    except expat.ExpatError as error:
        raise InputError(f"{shown}:{error.lineno}: not well-formed XML: {expat.errors.messages[error.code]}") from None
    except (ValueError, LookupError) as error:  # an encoding unknown to Python
        raise InputError(f"{shown}:1: cannot be decoded: {error}") from None
    return roots[0]


def _well_formed(data: bytes) -> bytes:
    """Turn text that Mitsuba's lenient parser accepts into strict XML: it allows `--` and any bytes in comments, white
    space before the declaration, and a bare &. A document type is removed, so that there are no entities; Mitsuba skips
    it too. Line numbers stay the same. UTF-16 is returned unchanged.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data
    parts, end = [], 0
    while (start := data.find(b"<!--", end)) >= 0 and (close := data.find(b"-->", start + 4)) >= 0:
        parts += [data[end:start], b"\n" * data.count(b"\n", start, close)]
        end = close + 3
    data = b"".join([*parts, data[end:]])
    if found := _DOCTYPE.match(data, max(data.find(b"<!DOCTYPE"), 0)):
        data = data[: found.start()] + b"\n" * data.count(b"\n", *found.span()) + data[found.end() :]
    if data[:1].isspace() and (declared := _DECLARATION.match(data)):
        lines = b"\n" * data.count(b"\n", 0, declared.start(1))
        data = declared[1] + lines + data[declared.end() :]
    return _AMPERSAND.sub(b"&amp;", data)


def _read_bytes(path: Path, shown: str) -> bytes:
    try:
        if path.is_file() and path.stat().st_size <= MAX_BYTES:
            return path.read_bytes()
        reason = "no such file"
        if path.exists():
            reason = f"larger than {MAX_BYTES >> 20} MiB, too large for a scene" if path.is_file() else "not a file"
    except (OSError, ValueError) as error:
        reason = f"cannot be read: {error}"
    raise InputError(f"{shown}: {reason}")


def _walk(element: Element) -> Iterator[Element]:
    yield element
    for child in element.children:
        yield from _walk(child)


def _as_text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ", ".join(map(str, value)) if np.ndim(value) == 1 else str(value)
