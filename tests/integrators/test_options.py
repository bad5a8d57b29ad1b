"""Options of the path tracer are checked once, when they are given."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.integrators.options import DEFAULTS, Options, check_counts, strategies


@pytest.mark.parametrize("spp", [0, -1, 2**31, 1.5, 64.0, True, "64", None])
def test_spp_out_of_range_is_refused(spp):
    with pytest.raises(pj.InputError, match=r"^spp = .*it must be an integer in \[1, 2\^31\)"):
        check_counts(spp, 0)


@pytest.mark.parametrize("seed", [-1, 2**31, 0.5])
def test_seeds_out_of_range_are_refused(seed):
    with pytest.raises(pj.InputError, match=r"^seed = .*it must be an integer in \[0, 2\^31\)"):
        check_counts(1, seed)


def test_counts_in_range_pass_and_so_does_what_is_traced_or_of_pixels():
    check_counts(1, 0)
    check_counts(np.int64(2**31 - 1), np.uint32(7))
    check_counts(np.array([0, 5]), 1)
    jax.jit(lambda spp, seed: DEFAULTS.check_counts(spp, seed))(0, jnp.int32(-1))


def test_unknown_choices_are_refused_when_they_are_made():
    with pytest.raises(pj.InputError, match="strategy 'mix' is unknown; use one of mis, light, bsdf"):
        Options("mix")


def test_strategies_of_a_scene_find_all_of_its_light(shipped):
    assert strategies(shipped("cornell_box", res=4)) == ("mis", "light", "bsdf")
    assert strategies(shipped("lights", res=4)) == ("mis", "light")


def test_options_of_the_same_choices_are_one_key():
    """So compiled kernels are reused."""
    assert Options() == DEFAULTS and hash(Options()) == hash(DEFAULTS)
    assert Options(split_depth=2) != DEFAULTS
