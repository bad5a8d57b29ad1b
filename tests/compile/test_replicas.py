"""Arrays on all devices: the same memory, freed with the array, in every kernel of all devices."""

import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import pathjax as pj
from pathjax.compile import on_all_devices
from pathjax.compile.replicas import on_one_device
from pathjax.derivatives import jacobian
from pathjax.rendering import aovs, bounces, query, render

pytestmark = pytest.mark.skipif(
    len(jax.devices()) < 2 or jax.default_backend() != "cpu", reason="needs two devices that share their memory"
)
LARGE = np.arange(1 << 17, dtype=np.float32)


def addresses(x):
    return {shard.data.unsafe_buffer_pointer() for shard in x.addressable_shards}


def test_arrays_are_on_all_devices_and_large_ones_without_a_copy():
    flags, small = jax.device_put(np.tile(LARGE > 5, 4)), jnp.zeros(3)
    given = {"large": jax.device_put(LARGE), "flags": flags, "small": small, "again": small, "none": None}
    found = on_all_devices(given)
    for name in ("large", "flags", "small"):
        assert found[name].is_fully_replicated and found[name].devices() == set(jax.devices())
        np.testing.assert_array_equal(found[name], given[name])
    assert addresses(found["large"]) == addresses(given["large"])
    assert found["again"] is found["small"] and found["none"] is None
    assert all(on_all_devices(given)[name] is x for name, x in found.items()), "each is made once"


@pytest.mark.parametrize("axis", [0, 1])
def test_what_is_dealt_to_devices_is_on_one_without_a_copy(axis):
    count = len(jax.devices())
    x = LARGE[: 24 * count].reshape(3, 8, count).swapaxes(2, axis).copy()
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("device",))
    dealt = [None] * axis + ["device"]
    given = jax.device_put(x, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*dealt)))
    pieces = on_one_device(given, axis)
    assert len(pieces) == count and all(piece.devices() == {jax.devices()[0]} for piece in pieces)
    np.testing.assert_array_equal(np.concatenate(pieces, axis), x)
    assert {piece.unsafe_buffer_pointer() for piece in pieces} == addresses(given)
    (alone,) = on_one_device(given, 1 - axis)
    assert alone is given
    assert on_one_device(x, axis)[0] is x
    np.testing.assert_array_equal(jax.jit(lambda x: on_one_device(x, axis)[0] + 1)(given), x + 1)


def test_what_was_placed_or_is_traced_stays_and_so_does_all_for_one_device():
    placed, free = jax.device_put(LARGE, jax.devices()[1]), jax.device_put(LARGE)
    assert on_all_devices(placed) is placed
    assert on_all_devices(free, 1) is free
    np.testing.assert_array_equal(jax.jit(lambda x: on_all_devices(x) + 1)(free), LARGE + 1)


def test_arrays_that_a_users_jit_closes_over_have_replicas_without_tracers():
    x = jax.device_put(LARGE.copy())
    np.testing.assert_array_equal(jax.jit(lambda y: on_all_devices(x) + y)(1), LARGE + 1)
    np.testing.assert_array_equal(on_all_devices(x), LARGE)


def test_memory_is_freed_with_the_array():
    x = jax.device_put(LARGE.copy())
    replica = weakref.ref(on_all_devices(x))
    gc.collect()
    assert replica() is not None
    del x
    gc.collect()
    assert replica() is None


class Reached(Exception):
    pass


@pytest.mark.parametrize(
    ("module", "kernel", "call"),
    [
        (render, "pixel_means", lambda scene: pj.render(scene, 1)),
        (jacobian, "_jacobians", lambda scene: pj.jacobian(scene, ["paint.reflectance"], 1)),
        (bounces, "_kernel", lambda scene: pj.render_bounces(scene, 2, 1)),
        (aovs, "_render_aovs", lambda scene: pj.render_aovs(scene, ["depth"], 1)),
        (query, "_closest_hit", lambda scene: pj.closest_hit(scene, np.zeros((1, 3)), np.ones((1, 3)))),
        (query, "_any_hit", lambda scene: pj.any_hit(scene, np.zeros((1, 3)), np.ones((1, 3)))),
    ],
)
def test_every_kernel_of_all_devices_finds_the_scene_there(module, kernel, call, monkeypatch):
    paint = {"type": "diffuse", "id": "paint"}
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "light": {"type": "constant"},
        "ball": {"type": "mesh", "mesh": trimesh.creation.icosphere(5), "bsdf": paint},
    }
    scene = pj.load_dict(description)
    seen = []

    def spy(*args, **_):
        seen.extend(x for x in jax.tree.leaves(args) if getattr(x, "nbytes", 0) >= 1 << 18)
        raise Reached

    monkeypatch.setattr(module, kernel, spy)
    with pytest.raises(Reached):
        call(scene)
    assert seen and all(x.devices() == set(jax.devices()) for x in seen)
