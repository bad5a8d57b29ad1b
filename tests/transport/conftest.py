"""The Cornell box without its boxes."""

from dataclasses import replace

import jax.numpy as jnp
import pytest

from pathjax.io.mitsuba import loader as mitsuba_xml
from pathjax.scene import build
from pathjax.shapes import Cube


@pytest.fixture(scope="session")
def empty_cornell(root):
    """(dtype, **parameters) -> Scene."""

    def load(dtype=jnp.float32, **parameters):
        full = mitsuba_xml.load(root / "scenes" / "cornell_box.xml", **parameters)
        walls = tuple(shape for shape in full.shapes if not isinstance(shape.geometry, Cube))
        return build(replace(full, shapes=walls), dtype)

    return load
