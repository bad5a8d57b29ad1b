"""Fixtures for mesh files: write a file, load it, and measure its surface."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pathjax.errors import InputError
from pathjax.io import mesh
from pathjax.shapes import Mesh

IDENTITY = np.eye(4)


@dataclass
class Loaded:
    mesh: Mesh
    notes: list[str]

    @property
    def corners(self) -> np.ndarray:
        """(F, 3, 3)"""
        return self.mesh.vertices[self.mesh.faces]

    @property
    def area_vectors(self) -> np.ndarray:
        """(F, 3) normals whose lengths are the areas; the winding gives the sign."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a) / 2

    @property
    def area(self) -> float:
        return np.linalg.norm(self.area_vectors, axis=1).sum()

    @property
    def volume(self) -> float:
        """Volume inside a closed surface; positive if the surface is wound outwards."""
        return np.linalg.det(self.corners).sum() / 6

    @property
    def uv_areas(self) -> np.ndarray:
        """(F,) signed areas."""
        (a, b, c) = np.moveaxis(self.mesh.uv[self.mesh.faces], 1, 0)
        (x, y), (z, w) = (b - a).T, (c - a).T
        return (x * w - y * z) / 2


@pytest.fixture
def write(tmp_path):
    def write(kind: str, content: str | bytes) -> Path:
        path = tmp_path / f"mesh.{kind}"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.fixture
def load(write):
    def load(kind: str, content: str | bytes, to_world: np.ndarray = IDENTITY, **options) -> Loaded:
        return Loaded(*mesh.load(write(kind, content), kind, to_world, **options))

    return load


@pytest.fixture
def refused(write):
    """(kind, content) -> the error message, which must name the file."""

    def refused(kind: str, content: str | bytes) -> str:
        with pytest.raises(InputError) as caught:
            mesh.load(write(kind, content), kind, IDENTITY)
        assert f"mesh.{kind}" in str(caught.value)
        return str(caught.value)

    return refused
