"""The page that explains lanes: its code runs, its program is the real one, its tests exist."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax.compile.lanes

FOLDER = Path(pathjax.compile.lanes.__file__).parent
PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page():
    """Names that the page's code defines."""
    names = {}
    exec("".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)), names)
    return names


def test_the_function_gives_what_vmap_gives(page):
    items = jnp.array([5.0, 80.0, 20.0])
    np.testing.assert_array_equal(page["steps"], jax.vmap(page["walk"], (0, None))(items, page["table"]))
    assert len(set(page["steps"].tolist())) == 3  # lanes leave at different times


def test_the_program_is_as_shown(page):
    (shown,) = re.findall(r"```\n(\{ lambda.*?)```", PAGE, re.DOTALL)
    casts = ("convert_element_type",)  # casts between strong and weak types have no effect

    def of(jaxpr):
        for eqn in jaxpr.eqns:
            yield eqn.primitive.name
            for part in ("body_jaxpr", "cond_jaxpr"):
                if part in eqn.params:
                    yield from of(eqn.params[part].jaxpr)

    found = [name for name in of(page["program"].jaxpr) if name not in casts]
    assert found == [name for name in re.findall(r"= ([a-z]\w*)", shown) if name not in casts]


def test_files_and_tests_that_it_names_exist():
    files = re.findall(r"^\| `(\w+\.py)`", PAGE, re.MULTILINE)
    assert sorted(files) == sorted(path.name for path in FOLDER.glob("*.py") if path.name != "__init__.py")
    tests = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parents[1].rglob("test_*.py"))
    named = re.findall(r"`(test_\w+)`", PAGE)
    assert len(named) > 5
    assert [name for name in named if f"def {name}(" not in tests] == []
