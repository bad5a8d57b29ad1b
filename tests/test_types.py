"""Public types, which `mypy` checks in this file, are the types returned at run time."""

from __future__ import annotations

import inspect
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np
import pytest

import pathjax as pj

if TYPE_CHECKING:
    from typing import assert_type
else:

    def assert_type(value, kind):
        assert isinstance(value, kind)


def test_the_package_is_marked_as_typed():
    assert files("pathjax").joinpath("py.typed").is_file()


@pytest.mark.parametrize("name", [name for name in pj.__all__ if inspect.isroutine(getattr(pj, name))])
def test_public_functions_are_annotated_throughout(name):
    signature = inspect.signature(getattr(pj, name))
    assert signature.return_annotation is not signature.empty
    assert not [p.name for p in signature.parameters.values() if p.annotation is p.empty]


@pytest.mark.slow
def test_public_functions_return_what_they_say(root: Path) -> None:
    scene = pj.load_scene(root / "scenes" / "furnace.xml", res=4)
    assert_type(scene, pj.Scene)
    image = pj.render(scene, 4, seed=1)
    assert_type(image, jax.Array)
    assert_type(pj.parameters(scene)["wall.reflectance"], jax.Array)
    assert_type(pj.with_parameters(scene, {"wall.reflectance": [0.2, 0.5, 0.7]}), pj.Scene)
    _, derivatives = pj.jacobian(scene, ["glow.radiance"], 4)
    assert_type(derivatives, pj.Jacobian)
    assert_type(derivatives["glow.radiance"], jax.Array)
    assert_type(pj.closest_hit(scene, np.zeros((2, 3)), np.ones((2, 3))).t, jax.Array)
    assert_type(pj.render_bounces(scene, 2, 4).terms, jax.Array)
    assert_type(pj.render_aovs(scene, ["depth"], 1)["depth"], np.ndarray)
    assert_type(pj.render_until(scene, spp=4).image, np.ndarray)
    assert_type(pj.check_gradient(scene, "glow.radiance", 4, seeds=3).passed, bool)
    fit = pj.fit(scene, image, ["wall.reflectance"], spp=4)
    assert_type(fit, pj.Fit)
    assert_type(fit.scene, pj.Scene)
