"""What the tests of the pages share: the pages."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MANUAL = (ROOT / "pathjax" / "manual").glob("*.md")
# The page of `bench` comes last: `bench` forgets the kernels that pages share.
PAGES = [ROOT / "README.md", *sorted(MANUAL, key=lambda page: (page.stem == "bench", page))]


@pytest.fixture(params=PAGES, ids=lambda path: path.stem)
def page(request):
    """A page, each in turn."""
    return request.param


@pytest.fixture(scope="session")
def all_text():
    """The README and the manual in one."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
