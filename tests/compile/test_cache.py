"""Programs on disk: which are found, which cannot be, and how many are kept."""

import os
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.compile import cache, compiled
from pathjax.integrators.options import DEFAULTS, Options
from pathjax.rendering.progressive import passes
from pathjax.scene.parameters import nameless

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="programs of CPUs are kept alone")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "_programs", tmp_path)
    monkeypatch.setattr(cache, "_known", {})
    return tmp_path


@partial(jax.jit, static_argnames="scale")
def scaled(x, *, scale):
    return jnp.sin(x["of"]) * scale


def test_a_program_is_found_again_and_gives_the_same(folder, monkeypatch):
    x = {"of": np.linspace(0, 1, 7, dtype=np.float32)}
    first = np.asarray(compiled(scaled, x, scale=3)(x))
    assert len(list(folder.glob("*.program"))) == 1
    monkeypatch.setattr(cache, "_known", {})
    monkeypatch.setattr(cache, "_made", None)
    np.testing.assert_array_equal(compiled(scaled, x, scale=3)(x), first)


def test_what_a_program_depends_on_is_in_its_key(shipped):
    def key(scene, options=DEFAULTS):
        return cache._key(passes._means_of_replicates, (nameless(scene), np.uint32(0)), {"options": options})

    scene = shipped("furnace", res=8)
    assert key(scene) == key(pj.with_parameters(scene, pj.parameters(scene)))
    with jax.enable_x64(True):
        wide = key(scene)
    others = [key(shipped("furnace", res=9)), key(shipped("cornell_box", res=8)), key(scene, Options("light")), wide]
    assert len({key(scene), *others}) == 5
    hidden = replace(scene, hide_emitters=True)
    assert key(hidden) != key(scene)


def test_what_is_not_of_the_package_has_no_key(folder):
    @dataclass(frozen=True)
    class Mine:
        scale: int = 3

    for unknown in (Mine, Mine(), len, (1, [Mine])):
        with pytest.raises(cache._Unknown):
            cache._key(scaled, ({"of": np.zeros(2)},), {"scale": unknown})


def test_programs_used_longest_ago_go_first(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "_CACHE_BYTES", 25)
    for k in range(4):
        file = tmp_path / f"{k}.program"
        file.write_bytes(bytes(10))
        os.utime(file, (0, [4, 1, 3, 2][k]))
    cache._remove_oldest(tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["0.program", "2.program"]
