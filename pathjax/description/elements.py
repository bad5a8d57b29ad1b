"""Elements of a scene file or dictionary, which know their place in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from pathjax.errors import InputError


@dataclass(eq=False)
class Element:
    """One element; compared by identity, as two references to one element are one object."""

    tag: str
    attributes: dict[str, str]
    file: str  # or the keys that lead to it in a dictionary
    line: int  # 0: in a dictionary
    children: list[Element] = field(default_factory=list)
    data: np.ndarray | None = None  # of an <array>, which exists only in dictionaries

    @property
    def id(self) -> str:
        return self.attributes.get("id", "")

    @property
    def place(self) -> str:
        """Its place in the file or dictionary, for messages."""
        return f"{self.file}:{self.line}" if self.line else self.file

    def error(self, message: str) -> InputError:
        return InputError(f"{self.place}: {message}")

    def __str__(self) -> str:
        for key in ("type", "name", "id"):
            if key in self.attributes:
                return f'<{self.tag} {key}="{self.attributes[key][:60]}">'
        return f"<{self.tag}>"


@dataclass(frozen=True)
class Document:
    root: Element  # <scene>; its children have includes expanded and `default`, `path` taken out
    ids: Mapping[str, Element]
    folders: tuple[Path, ...]  # searched in this order for files that the scene file names
    found: dict[Element, Path] = field(default_factory=dict)  # the files that elements name
    notes: tuple[str, ...] = ()  # for `info`, about the reading

    def resolve(self, element: Element) -> Element:
        """Return the element itself, or its target if it is a <ref>."""
        if element.tag != "ref":
            return element
        require_attributes(element, required=("id",), optional=("name",))
        if element.children:
            raise element.error(f"{element} takes nothing inside")
        if element.id not in self.ids:
            raise element.error(f'{element}: there is no id "{element.id[:60]}"{nearest(element.id, self.ids)}')
        return self.ids[element.id]

    def find(self, filename: str, element: Element) -> Path:
        """Return the path of a file that `element` names, or raise InputError."""
        self.found[element] = find_file(filename, self.folders, element)
        return self.found[element]


def nearest(name: str, known: Mapping[str, object] | list[str]) -> str:
    """Return `; did you mean "x"?` with the closest known names, or an empty string."""
    matches = get_close_matches(name, list(known), n=3, cutoff=0.6)
    return "; did you mean " + " or ".join(f'"{match}"' for match in matches) + "?" if matches else ""


def require_attributes(element: Element, required: tuple[str, ...] = (), optional: tuple[str, ...] = ()) -> None:
    for name in required:
        if name not in element.attributes:
            raise element.error(f'{element} lacks the attribute "{name}"')
    for name in element.attributes:
        if name not in required + optional:
            known = ", ".join(required + optional) or "none"
            raise element.error(f'{element} has no attribute "{name}"; it has: {known}')


def find_file(filename: str, folders: list[Path] | tuple[Path, ...], element: Element, folder: bool = False) -> Path:
    for place in folders:
        try:
            if (place / filename).is_dir() if folder else (place / filename).is_file():
                return place / filename
        except (OSError, ValueError):  # a name too long, or with a null character
            break
    kind = "folder" if folder else "file"
    raise element.error(f'{element}: no {kind} "{filename[:200]}" in {", ".join(str(place) for place in folders)}')
