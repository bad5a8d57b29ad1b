"""The house: rooms import in one direction, and nobody outside a room asks which kind of thing something is."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pathjax"
# From what knows nothing of the others to what knows all; a room may import from those before it.
ROOMS = (
    "version",
    "errors",
    "system",
    "core",
    "compile",
    "images",
    "kinds",
    "description",
    "textures",
    "shapes",
    "bsdfs",
    "emitters",
    "sensors",
    "scene",
    "integrators",
    "derivatives",
    "transport",
    "rendering",
    "inverse",
    "io",
    "bench",
    "testing",
    "cli",
)


def module(path: Path) -> str:
    name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    return name.removesuffix(".__init__")


MODULES = {module(path): ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}


def room(name: str) -> str:
    """Empty for the package itself, which all may not import."""
    return name.split(".")[1] if "." in name else ""


def imports(tree: ast.AST, late: bool):
    """Modules of the package that a module names, those in functions too where `late`."""

    def visit(node):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in MODULES else node.module
        elif late or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            for child in ast.iter_child_nodes(node):
                yield from visit(child)

    return {name for name in visit(tree) if name.split(".")[0] == "pathjax"}


def test_rooms_import_from_those_before_them_alone():
    wrong = []
    for name, tree in MODULES.items():
        here = room(name)
        if here in ("", "__main__"):
            continue
        for imported in imports(tree, late=True):
            there = room(imported)
            if imported == "pathjax" and here in ("bench", "cli"):
                continue  # they call the public names, as a user does
            if not there or ROOMS.index(there) > ROOMS.index(here):
                wrong.append(f"{name} imports {imported}")
    assert not wrong


def test_no_module_imports_itself_by_way_of_others():
    graph = {name: imports(tree, late=True) - {name} for name, tree in MODULES.items() if room(name) != ""}
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name in done or name not in graph:
            return
        path.append(name)
        for imported in sorted(graph[name]):
            visit(imported)
        path.pop()
        done.add(name)

    for name in graph:
        visit(name)


if __name__ == "__main__":
    pytest.main([__file__])
