"""No kernel reads or writes outside an array.

Kernels clamp indices, so an index outside reads a wrong entry but never foreign memory. Here each kernel runs item by
item, with real branches, and JAX's `checkify` checks every index of every array.
"""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.experimental import checkify

import pathjax as pj
from pathjax import emitters, transport
from pathjax.compile import mapping, native_map, one_by_one, primitives
from pathjax.compile.jax_compat import jaxpr_as_fun
from pathjax.core import math
from pathjax.sensors import film
from pathjax.shapes import triangle
from pathjax.shapes.accel import traverse as bvh

# Sampler values at the ends of the range, at the ends of steps, and between.
ENDS = np.float32([0, 2**-24, 0.25, 0.5, 0.75, 1 - 2**-12, 1 - 2**-24])


class SignedStarts:
    """`lax`, but slices start at signed indices: to an unsigned -1 `checkify` would add 1 and take the 0 for valid."""

    def __getattr__(self, name):
        return getattr(lax, name)

    def dynamic_slice(self, array, starts, sizes, **how):
        return lax.dynamic_slice(array, [start.astype(jnp.int32) for start in starts], sizes, **how)

    def dynamic_update_slice(self, array, update, starts, **how):
        return lax.dynamic_update_slice(array, update, [start.astype(jnp.int32) for start in starts], **how)


class Inline:
    """`one_by_one` without its primitive, which `checkify` cannot look into."""

    def bind(self, *inputs, program, search):
        return jaxpr_as_fun(program)(*inputs)


@pytest.fixture(scope="module")
def outside_of():
    """(function without arguments that calls kernels) -> messages about indices outside arrays, one per kernel."""
    met = []

    def checked_map(f, xs, shared, form, devices):
        def run(xs, *shared):
            return lax.map(lambda x: f(x, *shared), xs)

        error, ys = checkify.checkify(run, errors=checkify.index_checks)(xs, *shared)
        jax.debug.callback(lambda error: met.append(error.get()), error)
        return ys

    def messages(call):
        met.clear()
        jax.block_until_ready(call())
        jax.effects_barrier()
        assert met, "no kernel has run"
        return [message for message in met if message]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapping, "_map", checked_map)
        patch.setattr(primitives, "one_by_one_p", Inline())
        for module in (math, triangle, bvh):
            patch.setattr(module, "lax", SignedStarts())
        jax.clear_caches()
        yield messages
    jax.clear_caches()


def some_slow(names, quick):
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


# ---- the check itself -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [lambda f: f, one_by_one], ids=["plainly", "one by one"])
@pytest.mark.parametrize("index, found", [(0, False), (3, False), (-1, True), (4, True), (1 << 30, True)])
def test_check_finds_what_lies_outside(outside_of, how, index, found):
    """Inside control flow, as most array reads in kernels are."""

    def read(i, table):
        def add(k, total):
            return lax.cond(k == 1, how(lambda: total + math.at(table, i)), lambda: total)

        return lax.fori_loop(0, 2, add, jnp.zeros(2))

    table = jnp.arange(8.0).reshape(4, 2)
    assert bool(outside_of(lambda: native_map(read, jnp.int32([0, index]), table))) == found


# ---- kernels --------------------------------------------------------------------------------------------------------

SCENES = (
    "cornell_box",
    "furnace",
    "glass_and_mirror",
    "glass_ball",
    "mesh",
    "nine_spheres",
    "triangle_box",
    "conductors",
    "glass_in_glass",
    "normals",
    "shapes_and_filters",
    "textures",
)


@pytest.mark.parametrize("name", some_slow(SCENES, ("furnace",)))
def test_paths_stay_inside_of_arrays(outside_of, shipped, name):
    assert not outside_of(lambda: pj.render(shipped(name, res=6), 4))


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["light", "bsdf"])
def test_paths_of_other_strategies_stay_inside_of_arrays(outside_of, shipped, strategy):
    assert not outside_of(lambda: pj.render(shipped("cornell_box", res=6), 4, strategy=strategy))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["furnace", "glass_and_mirror"])
def test_derivatives_stay_inside_of_arrays(outside_of, shipped, name):
    scene = shipped(name, res=4)
    assert not outside_of(lambda: pj.jacobian(scene, list(pj.parameters(scene)), 2))


@pytest.mark.slow
def test_aovs_and_bounces_stay_inside_of_arrays(outside_of, shipped):
    scene = shipped("textures", res=4)
    assert not outside_of(lambda: pj.render_aovs(scene, ["depth", "normal", "albedo"]))
    assert not outside_of(lambda: pj.render_bounces(shipped("furnace", res=4), depth=3, spp=2))


@pytest.mark.parametrize("name", some_slow(("furnace", "cornell_box"), ("furnace",)))
def test_patches_stay_inside_of_arrays(outside_of, shipped, name):
    """Patches that rays hit and that the camera sees. Sums over rows rely on the order of the rows."""
    scene, made = shipped(name, res=4), []
    assert not outside_of(lambda: made.append(transport.operator(scene, 24, method="rays", rays=16)))
    (op,) = made
    row, column = np.asarray(op.factors.row), np.asarray(op.factors.column)
    assert (np.diff(row) >= 0).all()
    assert min(row.min(), column.min()) >= 0 and max(row.max(), column.max()) < op.patches.count
    assert not outside_of(lambda: transport.image(scene, op.radiosity(op.Le), spp=4))


@pytest.mark.slow
def test_paths_that_end_in_patches_stay_inside_of_arrays(outside_of, shipped):
    scene = shipped("cornell_box", res=4)
    op = transport.operator(scene, 100)
    assert not outside_of(lambda: pj.render(scene, 4, control=op.control(op.solve().L)))


# ---- edges ----------------------------------------------------------------------------------------------------------

ONE = '<shape type="{}"><bsdf type="diffuse"/></shape>'
SKY = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'


@pytest.mark.parametrize("body", ["", SKY, ONE.format("sphere") + SKY, ONE.format("rectangle")])
def test_scenes_of_few_shapes_stay_inside_of_arrays(outside_of, make_scene, body):
    """Scenes without shapes, and with one that most rays miss."""
    assert not outside_of(lambda: pj.render(make_scene(body, res=4, fov=120), 2))


@pytest.mark.parametrize("name", some_slow(SCENES, ("shapes_and_filters", "triangle_box")))
def test_rays_of_any_numbers_stay_inside_of_arrays(outside_of, shipped, name):
    numbers = [0, -1, 1e-38, 1e38, np.inf, -np.inf, np.nan]
    o = np.random.default_rng(1).choice(numbers, (64, 3))
    d = np.random.default_rng(2).choice(numbers, (64, 3))
    assert not outside_of(lambda: pj.closest_hit(shipped(name, res=4), o, d))


LAMPS = (
    '<shape type="obj"><string name="filename" value="meshes/octahedron.obj"/><emitter type="area"/></shape>'
    '<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="0"/></emitter></shape>'
)


def test_lights_are_chosen_inside_of_arrays(outside_of, make_scene):
    """A light and a triangle of a mesh are chosen by random numbers at the ends of their ranges."""
    scene = replace(make_scene(LAMPS + SKY), about=None)
    chosen = jax.jit(lambda lights: emitters.choice(lights, "light"))(scene.emitters)
    numbers = jnp.asarray(np.stack(np.meshgrid(ENDS, ENDS, ENDS), -1).reshape(-1, 3))

    def draw(u, scene, chosen):
        return emitters.sample(scene.emitters, scene.geometry, chosen, jnp.zeros(3), u[:2], u[2])

    assert not outside_of(lambda: native_map(draw, numbers, scene, chosen))


def test_textures_are_read_inside_of_arrays_wherever_uv_lies(outside_of, shipped):
    textures = shipped("textures", res=4).materials.textures
    numbers = np.float32([0, 2**-24, 0.5, 1 - 2**-24, 1, -(2**-24), -1, 1e9, 1e38, np.inf, -np.inf, np.nan])
    rows = [(kind, row) for kind, t in enumerate(textures.tables) for row in range(len(t.column("to_uv").values))]
    number, u, v = (x.ravel() for x in np.meshgrid(np.arange(len(rows)), numbers, numbers))
    items = jnp.asarray(np.array(rows)[number], jnp.int32), jnp.stack([u, v], -1)

    def look_up(item, textures):
        return textures.look_up(item[0], SimpleNamespace(uv=item[1]))

    assert not outside_of(lambda: native_map(look_up, items, textures))


@pytest.mark.parametrize("filter", ["box", "tent", "gaussian"])
def test_filters_are_sampled_inside_of_arrays(outside_of, make_scene, filter):
    table = make_scene("", film=f'<rfilter type="{filter}"/>').film
    numbers = jnp.asarray(np.stack(np.meshgrid(ENDS, ENDS), -1).reshape(-1, 2))

    def sample(u, table):
        return film.sample_position(table, jnp.int32(3), u)

    assert not outside_of(lambda: native_map(sample, numbers, table))
