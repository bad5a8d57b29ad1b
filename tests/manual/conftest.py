"""Fixtures for the tests of the pages: the README and the manual."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MANUAL = (ROOT / "pathjax" / "manual").glob("*.md")
# The page of `bench` comes last: `bench` drops the kernels that pages share.
PAGES = [ROOT / "README.md", *sorted(MANUAL, key=lambda page: (page.stem == "bench", page))]


@pytest.fixture(params=PAGES, ids=lambda path: path.stem)
def page(request):
    """Each page in turn."""
    return request.param


@pytest.fixture(scope="session")
def all_text():
    """The README and the manual as one text."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
