"""Upgrade scene files of Mitsuba 0.6 and older to the format of Mitsuba 3, by Mitsuba's own rules."""

from __future__ import annotations

import re

from pathjax.description.elements import Element

# Capitals after a lower-case letter: `intIOR`, `toWorld`.
_CAPITALS = re.compile(r"(?<=[a-z])[A-Z]+")
_UV = {"uoffset": ("translate", "x"), "voffset": ("translate", "y"), "uscale": ("scale", "x"), "vscale": ("scale", "y")}


def upgrade(element: Element) -> None:
    """Rename the children of an element: `maxDepth` to `max_depth`, `uscale` and the like to `to_uv`, ..."""
    uv = [child for child in element.children if child.tag == "float" and child.attributes.get("name") in _UV]
    if uv:
        element.children = [child for child in element.children if child not in uv] + [_to_uv(uv)]
    for child in element.children:
        if child.tag == "lookAt":
            child.tag = "lookat"
        # A <default> keeps its name, to which `$name` refers.
        if "name" in child.attributes and child.tag != "default":
            name = _CAPITALS.sub(lambda match: f"_{match[0].lower()}", child.attributes["name"])
            is_diffuse = element.tag == "bsdf" and element.attributes.get("type") == "diffuse"
            child.attributes["name"] = "reflectance" if is_diffuse and name == "diffuse_reflectance" else name
        upgrade(child)


def _to_uv(given: list[Element]) -> Element:
    """Return the <transform> that shifts and then scales, as in Mitsuba."""
    first = given[0]
    steps = {tag: Element(tag, {}, first.file, first.line) for tag in ("translate", "scale")}
    for each in given:
        tag, axis = _UV[each.attributes["name"]]
        steps[tag].attributes[axis] = each.attributes.get("value", "")
    made = [step for step in steps.values() if step.attributes]
    return Element("transform", {"name": "to_uv"}, first.file, first.line, made)
