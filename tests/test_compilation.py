"""What is compiled, and how often: one native kernel per render or query, without code for kinds the scene lacks."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import source_info_util

import pathjax as pj
from pathjax.compile import native
from pathjax.compile.lanes import lanes
from pathjax.compile.lanes.interpreter import Interpreter
from pathjax.compile.lanes.scheduling import from_queue
from pathjax.derivatives import backward, ior_step, jacobian, tangents, totals
from pathjax.derivatives.kept import kept
from pathjax.integrators import pixel
from pathjax.integrators.options import DEFAULTS, Options
from pathjax.rendering import aovs, bounces, query
from pathjax.rendering.progressive import replicates
from pathjax.rendering.render import pixel_means
from pathjax.scene import parameters as named
from pathjax.sensors.film import pixel_count
from pathjax.transport import control, factors, patches, rays, view

ROOT = Path(__file__).resolve().parents[1]
NAMES = sorted(path.stem for path in (*ROOT.glob("scenes/*.xml"), *ROOT.glob("tests/scenes/*.xml")))

# Scenes made for tests whose kernels take longest to compile.
LARGE = (
    *("more_shapes", "nested", "normals", "plastics", "principled"),
    *("rough_glass", "rough_metals", "shapes_and_filters", "textures", "turned"),
)
# Scenes whose kinds all occur in other scenes.
REPEATED = ("conductors", "glass_in_glass", "nine_spheres")
# The same holds for these, but their images are tested all the same.
WITHIN_OTHERS = ("cornell_box", "glass_ball")


def but(*slow):
    """Return all scenes as parameters, the given ones marked slow."""
    return [pytest.param(name, marks=pytest.mark.slow if name in slow else ()) for name in NAMES]


pytestmark = pytest.mark.skipif(not native(), reason="native loops are off")


def lowered(scene, strategy="mis", devices=None, pixels=256, form=None):
    pixels = jnp.arange(pixels, dtype=jnp.int32)
    numbers = pixel.numbers(pixels, 0, 4, 1)
    static = {"options": Options(strategy), "devices": devices, "form": form}
    return pixel_means.lower(replace(scene, about=None), pixels, *numbers, **static)


# ---- native kernels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", but(*LARGE, *REPEATED))
def test_every_scene_renders_in_one_native_kernel_what_is_finite_and_not_negative(native_kernels, kernel_of, name):
    assert native_kernels(kernel_of(name).compiled) == 1
    image = kernel_of(name).image(spp=64)
    assert np.isfinite(image).all()
    assert image.min() >= 0 and image.max() > 0


@pytest.mark.parametrize("name, lines, loops", [("cornell_box", 4400, 12), ("mesh", 8600, 42)])
def test_programs_are_small(shipped, name, lines, loops):
    """Compile time grows with the number of lines and loops, so both stay near what they were when this was written."""
    program = lowered(shipped(name)).as_text()
    assert program.count("\n") < 1.12 * lines
    assert program.count("stablehlo.while") < 1.3 * loops  # a loop for each value computed once would double the number


@pytest.mark.parametrize("name", ["cornell_box", "glass_and_mirror", "mesh"])
def test_columns_of_lanes_are_seldom_copied(kernel_of, name):
    """XLA copies columns that it believes to be overwritten while they are read: once two per computed column."""
    text = kernel_of(name).compiled.as_text()
    copied, computed = (len(re.findall(rf"= \w+\[128\]\S* {what}\(", text)) for what in ("copy", "fusion"))
    assert computed > 50
    assert copied < computed / 2


@pytest.mark.parametrize("strategy, devices", [("mis", 1), ("light", 1), ("bsdf", None)])
def test_every_strategy_and_number_of_devices_is_one_native_kernel(native_kernels, shipped, strategy, devices):
    assert native_kernels(lowered(shipped("furnace", res=16), strategy, devices)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["light", "bsdf"])
@pytest.mark.parametrize("name", NAMES)
def test_every_scene_and_strategy_is_one_native_kernel(native_kernels, shipped, name, strategy):
    assert native_kernels(lowered(shipped(name, res=16), strategy)) == 1


@pytest.mark.parametrize("name", ["cornell_box", pytest.param("mesh", marks=pytest.mark.slow)])
def test_float64_renders_in_one_native_kernel(native_kernels, kernel_of, x64, name):
    with x64():
        assert native_kernels(kernel_of(name, jnp.float64).compiled) == 1


@pytest.mark.parametrize("name, devices", [("glass_and_mirror", 1), ("mesh", None)])  # each scene, each count once
def test_closest_hit_is_one_native_kernel(native_kernels, shipped, name, devices):
    rays = jnp.ones((1000, 3)), jnp.ones((1000, 3))
    lowered = query._closest_hit.lower(shipped(name, res=16).geometry, *rays, devices=devices)
    assert native_kernels(lowered) == 1


@pytest.mark.parametrize("name", but(*LARGE, *REPEATED, *WITHIN_OTHERS))
def test_output_variables_are_one_native_kernel(native_kernels, shipped, name):
    pixels = jnp.arange(256, dtype=jnp.int32)
    scene = replace(shipped(name, res=16), about=None)
    assert native_kernels(aovs._render_aovs.lower(scene, pixels, *pixel.numbers(pixels, 0, 4, 1))) == 1


@pytest.mark.slow
def test_render_in_the_users_jit_is_one_native_kernel(native_kernels, shipped):
    scene = shipped("cornell_box", res=16)
    render = jax.jit(lambda r: pj.render(pj.with_parameters(scene, {"white.reflectance": r}), 4))
    assert native_kernels(render.lower(jnp.float32(0.5))) == 1


def kernels_of_derivatives():
    """Return cases for derivative kernels; the quick ones cover each kind once, the slow ones all scenes."""
    cases = []
    for name in NAMES:
        has_glass = "dielectric" in next(ROOT.glob(f"**/scenes/{name}.xml")).read_text()
        for which in ("colours", "glass", "both") if has_glass else ("colours",):
            quick = (name, which) in (("furnace", "colours"), ("glass_ball", "both"))
            cases.append(pytest.param(name, which, marks=() if quick else pytest.mark.slow))
    return cases


@pytest.mark.parametrize("name, which", kernels_of_derivatives())
def test_image_and_derivatives_are_one_native_kernel_and_finite(native_kernels, jacobian_kernel_of, name, which):
    kernel = jacobian_kernel_of(name, which)
    assert native_kernels(kernel.compiled) == 1
    parts = kernel(spp=16)
    assert all(np.isfinite(part).all() for part in parts)
    _, colors, glass, _ = parts
    # Every parameter changes the image, except what is not in view.
    assert colors.size + glass.size > 0 and max(np.abs(x).max(initial=0) for x in (colors, glass)) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("few", "near"), [(totals.FEW, totals.NEAR), (0, totals.NEAR), (0, 0)])
def test_a_sweep_is_native(native_kernels, monkeypatch, shipped, few, near):
    """One kernel each: the paths of a part, its last sweep, and the sums after a path too long for the ring. Cases: few
    entries, lists that stay in near caches, and larger lists.
    """
    monkeypatch.setattr(totals, "FEW", few)
    monkeypatch.setattr(totals, "NEAR", near)
    backward.pullback.clear_cache()
    scene = shipped("cornell_box", res=16)
    pixels = jnp.arange(pixel_count(scene.film), dtype=jnp.int32)
    options = Options(derivative=True, by_vertex=True)
    work = jnp.ones((len(pixels), 3)), pixels, *pixel.numbers(pixels, 0, 4, 1)
    how = dict(kept=kept(scene, scene.about.parameters.values()), options=options, ring=backward.RING)
    assert native_kernels(backward.pullback.lower(named.nameless(scene), *work, **how)) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_no_derivative_of_a_million_paths_is_nan(jacobian_kernel_of, name):
    which = "both" if any(case.values == (name, "both") for case in kernels_of_derivatives()) else "colours"
    kernel = jacobian_kernel_of(name, which)
    parts = kernel(spp=10**6 // pixel_count(kernel.scene.film), seed=2)
    assert all(np.isfinite(part).all() for part in parts)


# ---- nothing that lanes leave to vmap -------------------------------------------------------------------------------


@pytest.fixture
def left_to_vmap(monkeypatch):
    """Primitives that traced lanes leave to vmap, at the cost of registers, as "primitive at file:line"."""
    found, within = set(), []
    apply, by_vmap = Interpreter.apply, Interpreter.by_vmap

    def applied(self, eqn, *rest):
        within.append(source_info_util.summarize(eqn.source_info))
        try:
            return apply(self, eqn, *rest)
        finally:
            within.pop()

    def recorded(self, eqn, inputs):
        place = next(filter(None, reversed(within)), "unknown")  # JAX's own functions have only their caller's
        found.add(f"{eqn.primitive.name} at {place}")
        return by_vmap(self, eqn, inputs)

    monkeypatch.setattr(Interpreter, "apply", applied)
    monkeypatch.setattr(Interpreter, "by_vmap", recorded)
    return found


def trace(kernel, *arguments, **static):
    """Trace a jitted function anew, without JAX's caches."""
    jax.make_jaxpr(partial(kernel.__wrapped__, **static))(*arguments)


def test_what_lanes_leave_to_vmap_is_told_with_its_place(left_to_vmap):
    def f(x):
        return jnp.sort(x), jnp.repeat(x, 2, total_repeat_length=14)

    # A size that no other test has: for a function that JAX has traced before it reports the place of that trace.
    jax.make_jaxpr(lanes(f, 4))(jnp.ones((8, 7)))
    assert {entry.partition(" at ")[0] for entry in left_to_vmap} == {"sort", "gather"}
    assert all(f"/{Path(__file__).name}:" in entry for entry in left_to_vmap)


@pytest.mark.parametrize("name", but(*LARGE, *REPEATED, *WITHIN_OTHERS))
def test_no_primitive_of_an_image_is_left_to_vmap(shipped, left_to_vmap, name):
    """The primitives to which JAX unpacks arrays differ between versions; one without a rule would slow all kernels."""
    scene = replace(shipped(name, res=16), about=None)
    pixels = jnp.arange(256, dtype=jnp.int32)
    work = pixels, *pixel.numbers(pixels, 0, 4, 1)
    for options in (DEFAULTS, Options("light", split_depth=2, sampler="subpixel")):
        trace(pixel_means, scene, *work, options=options)
    trace(aovs._render_aovs, scene, *work)
    trace(query._closest_hit, scene.geometry, jnp.ones((1000, 3)), jnp.ones((1000, 3)))
    assert not left_to_vmap


def test_no_primitive_of_light_on_patches_is_left_to_vmap(shipped, left_to_vmap):
    scene = replace(shipped("cornell_box", res=16), about=None)
    pixels = jnp.arange(256, dtype=jnp.int32)
    work = pixels, *pixel.numbers(pixels, 0, 4, 1)
    cells, one, seed = patches.cut_scene(shipped("cornell_box", res=16), 50), jnp.uint32(1), jnp.uint32(2)
    light = view.radiosity(cells, jnp.ones((cells.count, 3)))
    trace(pixel_means, scene, *work, control.Control(light, jnp.float32(2)), options=Options(controlled=True))
    trace(view._seen, scene, cells, pixels, one, seed)
    trace(rays._cast, scene.geometry, cells, pixels, pixels, seed)
    trace(factors._visibility, scene.geometry, cells, pixels % 50, pixels % 49, jnp.int32(8), seed)
    assert not left_to_vmap


QUICK_DERIVATIVES = ("furnace", "glass_ball")


@pytest.mark.parametrize("name", but(*set(NAMES).difference(QUICK_DERIVATIVES)))
def test_no_primitive_of_a_derivative_is_left_to_vmap(shipped, left_to_vmap, name):
    """The same holds for the terms of the series, which are differentiated too, and for the step of an IOR."""
    scene = shipped(name, res=16)
    parameters = scene.about.parameters.values()
    colors = tangents.places(p for p in parameters if not p.moves_paths)
    glass = sorted({p.index[0] for p in parameters if p.moves_paths})
    scene, pixels = replace(scene, about=None), jnp.arange(256, dtype=jnp.int32)
    work = pixels, *pixel.numbers(pixels, 0, 4, 1)
    wanted = jacobian.Wanted(colors, tuple(glass))
    trace(jacobian._jacobians, scene, *work, jnp.full(len(glass), 0.02), wanted=wanted, options=DEFAULTS)
    series = pixels, jnp.uint32(0), jnp.ones((replicates.COUNT, 256), jnp.uint32), replicates.seeds(1)
    trace(bounces._kernel, scene, *series, depth=3, options=Options(by_vertex=True, derivative=True), colors=colors)
    if glass:
        trace(ior_step.motions, scene, jnp.asarray(glass, jnp.int32))
        attached = tangents.places(p for p in parameters if p.moves_paths)
        choosing = jacobian.choosing_by_present_iors(scene, glass)
        wanted = jacobian.Wanted(attached, ())
        trace(jacobian._jacobians, choosing, *work, jnp.zeros(0), wanted=wanted, options=DEFAULTS)
    assert not left_to_vmap


def test_every_kernel_over_samples_has_a_persistent_loop(shipped, monkeypatch):
    """Without one, lanes would wait for the longest path of their pixel: right, but slow."""
    found = []

    def counted(*arguments):
        found.append(1)
        return from_queue(*arguments)

    monkeypatch.setattr("pathjax.compile.lanes.from_queue", counted)
    scene = shipped("glass_ball", res=16)
    colors = tangents.places(p for p in scene.about.parameters.values() if not p.moves_paths)
    scene, pixels = replace(scene, about=None), jnp.arange(256, dtype=jnp.int32)
    work = pixels, *pixel.numbers(pixels, 0, 4, 1)
    trace(pixel_means, scene, *work, options=DEFAULTS)
    for glass in ((), (0,)):
        wanted = jacobian.Wanted(colors, glass)
        trace(jacobian._jacobians, scene, *work, jnp.full(len(glass), 0.02), wanted=wanted, options=DEFAULTS)
    series = pixels, jnp.uint32(0), jnp.ones((replicates.COUNT, 256), jnp.uint32), replicates.seeds(1)
    trace(bounces._kernel, scene, *series, depth=3, options=Options(by_vertex=True, derivative=True), colors=colors)
    assert len(found) == 4


# ---- nothing that the scene lacks -----------------------------------------------------------------------------------

# Source files named in the debug information of a lowered program.
ALWAYS = {"render.py", "path.py", "perspective.py", "film.py", "sampler.py"}
OPTIONAL = {
    "dielectric.py": {"glass_and_mirror", "glass_in_glass"},
    "conductor.py": {"glass_and_mirror"},
    "fresnel.py": {"glass_and_mirror", "glass_in_glass"},
    "checkerboard.py": {"glass_and_mirror"},
    "sphere.py": {"glass_and_mirror", "glass_in_glass"},
    "triangle.py": {"mesh"},
    "traverse.py": {"mesh"},
    "cube.py": {"cornell_box", "glass_and_mirror", "glass_in_glass"},
    "planar.py": {"cornell_box", "glass_and_mirror", "glass_in_glass", "mesh"},
    "constant.py": {"glass_and_mirror", "glass_in_glass", "mesh"},
    "area.py": {"cornell_box", "glass_and_mirror", "glass_in_glass", "mesh"},
}


@pytest.mark.parametrize("name", sorted(set.union(*OPTIONAL.values())))
def test_program_holds_code_of_the_kinds_present_and_of_no_others(shipped, name):
    # The loop form keeps file names; the program of one pixel, from which lanes are made, is the same.
    text = lowered(shipped(name, res=16), form="loop").as_text(debug_info=True)
    holds = {file for file in ALWAYS | set(OPTIONAL) if f"/{file}" in text}
    assert holds == ALWAYS | {file for file, names in OPTIONAL.items() if name in names}


def test_background_is_sampled_by_strategy_light_alone(shipped):
    scene = shipped("glass_and_mirror", res=16)
    texts = {each: lowered(scene, each, form="loop").as_text(debug_info=True) for each in ("mis", "light")}
    assert {each: "Constant.sample" in text for each, text in texts.items()} == {"mis": False, "light": True}


# ---- no recompilation -----------------------------------------------------------------------------------------------


def test_a_first_render_compiles_its_kernel_and_nothing_else(make_scene, compilations):
    scene = make_scene('<emitter type="constant"/>', res=17)  # a resolution that no other test has
    before = compilations.count
    pj.render(scene, 2)
    assert compilations.count == before + 1


def changes(scene):
    camera = scene.camera
    yield "seed", scene, {"seed": 5}
    yield "spp", scene, {"spp": 3}
    yield "colour", pj.with_parameters(scene, {"clay.reflectance": [0.1, 0.2, 0.3]}), {}
    yield "IOR", pj.with_parameters(scene, {"glass.int_ior": 1.7}), {}
    yield "light", pj.with_parameters(scene, {"lamp.radiance": 3.0}), {}
    yield "camera position", replace(scene, camera=replace(camera, origin=camera.origin + 0.5)), {}
    yield "max_depth", replace(scene, max_depth=jnp.int32(3)), {}
    yield "rr_depth", replace(scene, rr_depth=jnp.int32(2)), {}


def test_parameters_are_set_by_one_program(make_scene, compilations):
    # No other test has this number of bsdfs.
    balls = (BALLS.format(f"ball{i}", i, f"clay{i}", "0.5, 0.1, 0.1", f"sky{i}") for i in range(7))
    scene = make_scene("".join(ball.partition("<emitter")[0] for ball in balls))
    before = compilations.count
    scene = pj.with_parameters(scene, {"clay2.reflectance": 0.3, "clay4.reflectance": [0.1, 0.2, 0.3]})
    assert compilations.count <= before + 1
    np.testing.assert_array_equal(pj.parameters(scene)["clay4.reflectance"], np.float32([0.1, 0.2, 0.3]))


def test_other_values_never_compile_again(shipped, compilations):
    scene = shipped("glass_and_mirror", res=16)
    base = np.asarray(pj.render(scene, 2))
    list(changes(scene))  # this compiles the small operations of the changes themselves
    for what, changed, how in changes(scene):
        before = compilations.count
        image = pj.render(changed, **({"spp": 2} | how))
        assert compilations.count == before, what
        assert not np.array_equal(image, base), what


def test_a_sweep_over_32_iors_compiles_once(shipped, compilations):
    """Neither the kernel nor the program that chooses its step is compiled again."""
    scene = shipped("glass_ball", res=64)  # the scene of the README, which shares its kernel
    sweep = [pj.with_parameters(scene, {"glass.int_ior": 1.1 + 0.03 * i}) for i in range(32)]
    pj.jacobian(sweep[0], ["glass.int_ior"], 1)
    before = compilations.count
    slopes = [np.asarray(pj.jacobian(scene, ["glass.int_ior"], 1)[1]["glass.int_ior"]) for scene in sweep]
    assert compilations.count == before
    assert len({slope.tobytes() for slope in slopes}) == 32


BALLS = """
<shape type="sphere" id="{0}"><point name="center" x="{1}" y="0" z="0"/>
  <bsdf type="diffuse" id="{2}"><rgb name="reflectance" value="{3}"/></bsdf></shape>
<emitter type="constant" id="{4}"/>
"""


def test_scenes_of_one_structure_share_a_kernel_whatever_their_names(make_scene, compilations):
    first = make_scene(BALLS.format("ball", 0, "red", "0.5, 0.1, 0.1", "sky"))
    second = make_scene(BALLS.format("globe", 0.5, "blue", "0.1, 0.1, 0.5", "light"), fov=30, origin="1, 2, 4")
    pj.render(first, 2)
    before = compilations.count
    pj.render(second, 2)
    assert compilations.count == before


def test_renders_until_an_error_share_a_kernel(shipped, compilations):
    """Other targets, seeds and sample counts."""
    scene = shipped("cornell_box", res=16)
    pj.render_until(scene, 0.2)
    before = compilations.count
    for how in ({"target_error": 0.1}, {"spp": 3}, {"target_error": 0.2, "seed": 4}, {"time_limit": 0.1}):
        pj.render_until(scene, **how)
    assert compilations.count == before


def test_queries_do_not_compile_again(shipped, compilations):
    scene, other = shipped("cornell_box", res=16), shipped("cornell_box", res=64)
    rays = np.ones((10, 3), np.float32), np.ones((10, 3), np.float32)
    pj.closest_hit(scene, *rays)
    before = compilations.count
    pj.closest_hit(other, *rays)
    assert compilations.count == before
