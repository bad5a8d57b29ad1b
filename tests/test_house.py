"""The house: rooms import in one direction, and no module outside a room asks for the kind of an object."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pathjax"
# From the room that depends on no other to those that depend on all; a room may import from those before it.
ROOMS = (
    "version",
    "errors",
    "system",
    "compile",
    "distributed",
    "core",
    "images",
    "kinds",
    "description",
    "textures",
    "shapes",
    "bsdfs",
    "media",
    "emitters",
    "sensors",
    "scene",
    "integrators",
    "derivatives",
    "transport",
    "rendering",
    "inverse",
    "io",
    "batch",
    "bench",
    "testing",
    "cli",
)


def module(path: Path) -> str:
    name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    return name.removesuffix(".__init__")


MODULES = {module(path): ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}


def room(name: str) -> str:
    """Return a module's room; empty for the package itself, which rooms may not import."""
    return name.split(".")[1] if "." in name else ""


def imports(tree: ast.AST, late: bool):
    """Return the pathjax modules that a module imports, those imported in functions too if `late`."""

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
                continue  # like a user, they call the public names
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


# ---- kinds --------------------------------------------------------------------------------------------------------

ROOMS_OF_KINDS = ("textures", "shapes", "bsdfs", "media", "emitters", "sensors")


def classes_of(*rooms: str) -> set[str]:
    trees = (tree for name, tree in MODULES.items() if room(name) in rooms)
    return {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


# Records of scene files belong to kinds, as their tables do. The names subtracted here belong to no kind.
KINDS = classes_of(*ROOMS_OF_KINDS, "description") - {
    *("Element", "Document", "Fields", "Parameter", "Description", "Transform")
}

# Fields of bsdfs and emitters. To compare a parameter's name with one of them is to ask for its kind.
FIELDS = {
    node.target.id
    for name, tree in MODULES.items()
    if room(name) in ("bsdfs", "emitters")
    for node in ast.walk(tree)
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
} - {"texture"}  # also an element of scene files


def names_in(node: ast.AST) -> set[str]:
    """Return the names in `Kind`, `room.Kind`, `A | B` and `(A, B)`."""
    names = (n for n in ast.walk(node) if isinstance(n, ast.Name | ast.Attribute))
    return {n.id if isinstance(n, ast.Name) else n.attr for n in names}


def is_call(node: ast.AST, *functions: str) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in functions


def questions(tree: ast.AST, kinds: set[str], fields: set[str]):
    """Yield the code that tests an object for one of the kinds, or a string for one of the fields."""
    for node in ast.walk(tree):
        asked, texts = set(), []
        if is_call(node, "isinstance", "issubclass"):
            asked = names_in(node.args[1])
        elif isinstance(node, ast.MatchClass):
            asked = names_in(node.cls)
        elif is_call(node, "hasattr"):
            texts = node.args[1:]
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            if any(is_call(n, "type") for side in sides for n in ast.walk(side)):
                asked = set().union(*map(names_in, sides))
            texts = [n for side in sides for n in getattr(side, "elts", [side])]
        elif isinstance(node, ast.MatchValue):
            texts = [node.value]
        named = {n.value for n in texts if isinstance(n, ast.Constant) and isinstance(n.value, str)}
        if asked & kinds or named & fields:
            yield ast.unparse(node)


def test_nobody_outside_a_room_asks_which_kind_something_is():
    outside = {name: tree for name, tree in MODULES.items() if room(name) not in ROOMS_OF_KINDS}
    asking = {name: list(questions(tree, KINDS, FIELDS)) for name, tree in outside.items()}
    assert not {name: found for name, found in asking.items() if found}


@pytest.mark.parametrize(
    "code",
    [
        "isinstance(x, Sphere)",
        "isinstance(x, rooms.Mesh | int)",
        "isinstance(x, (int, Sphere))",
        "type(x) is Sphere",
        "type(x) in (Sphere, Mesh)",
        "match x:\n  case rooms.Sphere(): pass",
        "name == 'int_ior'",
        "name in ('int_ior', 'x')",
        "hasattr(x, 'int_ior')",
        "match name:\n  case 'int_ior': pass",
    ],
)
def test_questions_are_noticed(code):
    assert list(questions(ast.parse(code), {"Sphere", "Mesh"}, {"int_ior"}))


@pytest.mark.parametrize("code", ["isinstance(x, int)", "x.smooth", "x['int_ior']", "Sphere(1)", "type(x) is int"])
def test_what_asks_of_no_kind_is_none(code):
    assert not list(questions(ast.parse(code), {"Sphere", "Mesh"}, {"int_ior"}))


# ---- JAX --------------------------------------------------------------------------------------------------------

PRIVATE = ("core", "extend", "_src", "interpreters", "custom_derivatives.SymbolicZero", "experimental")


def names_of_jax(tree: ast.AST):
    """Yield the dotted names that a module imports from JAX or reads from it: "core.Tracer"."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.removeprefix("jax.") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = f"{node.module}.".removeprefix("jax.")
            yield from (f"{module}{alias.name}" for alias in node.names if node.module.split(".")[0] == "jax")
        elif isinstance(node, ast.Attribute):
            yield ast.unparse(node).removeprefix("jax.") if ast.unparse(node).startswith("jax.") else ""


def test_one_module_uses_what_is_not_public_in_jax():
    found = {
        name
        for name, tree in MODULES.items()
        for used in names_of_jax(tree)
        if any(f"{used}.".startswith(f"{private}.") for private in PRIVATE)
    }
    assert found == {"pathjax.compile.jax_compat"}


def test_dataclasses_become_pytrees_in_one_way():
    """With JAX's own registration, structures of different classes are equal, so one class may get another's kernel."""
    assert not [name for name, tree in MODULES.items() if "tree_util.register_dataclass" in names_of_jax(tree)]


if __name__ == "__main__":
    pytest.main([__file__])
