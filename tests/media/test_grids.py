"""Media with extinction and albedo in grids: integrals along rays, light, derivatives, and scene files."""

from __future__ import annotations

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import media
from pathjax.compile import native_map
from pathjax.core.types import Ray
from pathjax.media import grids
from pathjax.media.gridvolume import GridVolume, boxed, read_vol, write_vol

slow = pytest.mark.slow
CUBE = pj.Transform().scale(2).translate([-0.5, -0.5, -0.5]).matrix  # maps the unit cube to [-1, 1]^3
NAME = "cube_interior.sigma_t"


def volume(data, to_world=CUBE, **more):
    return {"type": "gridvolume", "data": np.asarray(data, float), "to_world": to_world, **more}


def record(data, to_world, nearest=False):
    placed = boxed(np.ones(3), to_world).box  # box of the same unit cube
    to_cells = np.diag([*data.shape[2::-1], 1.0])
    to_cells[:3, 3] = -0.5
    return GridVolume(data, (to_cells @ np.linalg.inv(to_world))[:3], placed, nearest=nearest)


def rays(count, seed=0):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d[:9] = np.repeat([[1, 0, 0], [0, -1, 0], [0, 0, 1]], 3, 0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return jnp.asarray(rng.uniform(-1.5, 1.5, (count, 3)), jnp.float32), jnp.asarray(d, jnp.float32)


RNG = np.random.default_rng(5)
TURNED = pj.Transform().rotate([1, 2, 3], 40).scale([2, 1.5, 1]).translate([-0.6, -0.5, -0.4]).matrix


@pytest.fixture(scope="module", params=["trilinear", "nearest", "one of each"])
def two(request):
    """Grids of one channel and of three."""
    data, filters = (RNG.random((3, 4, 2, 1)) * 3, RNG.random((1, 5, 3, 3))), request.param
    one = record(data[0], TURNED, nearest=filters != "trilinear")
    return grids.build([one, record(data[1], CUBE, nearest=filters == "nearest")], np.float32)


@pytest.mark.parametrize("form", [pytest.param("lanes", marks=slow), "vmap"])
def test_depths_are_integrals_of_what_is_looked_up(two, form):
    """The only difference is the error of the midpoint rule: some 1e-3 of the sum, and half a step for each face at
    which values jump by up to 3.
    """
    o, d = rays(300)
    number = jnp.arange(300, dtype=jnp.int32) % 2
    steps = 400 if two.nearest is None else 2000

    def both(item, two):
        o, d, number = item
        ray = Ray(o, d, jnp.float32(3.0), jnp.int32(-1))
        exact = grids.depth(two, number, ray, ray.t_max)

        def add(k, total):
            p = o + (k + 0.5) * (ray.t_max / steps) * d
            box = two.box[number]
            inside = jnp.all((p >= box[0]) & (p <= box[1]))
            return total + jnp.where(inside, grids.look_up(two, number, p), 0) * (ray.t_max / steps)

        return exact, jax.lax.fori_loop(0, steps, add, jnp.zeros(3))

    exact, summed = jax.jit(native_map, static_argnums=0, static_argnames="form")(both, (o, d, number), two, form=form)
    assert float(exact.max()) > 2
    np.testing.assert_allclose(exact, summed, atol=2e-2)
    assert abs(np.mean(exact - summed)) < 1e-3


@slow
def test_a_distance_is_where_the_depth_is_reached(two):
    o, d = rays(300, seed=1)
    wanted = jnp.asarray(np.random.default_rng(2).exponential(size=300), jnp.float32)

    def found(o, d, wanted):
        ray = Ray(o, d, jnp.float32(jnp.inf), jnp.int32(-1))
        t = grids.reach(two, jnp.int32(0), ray, jnp.int32(1), wanted)
        whole = grids.depth(two, jnp.int32(0), ray, ray.t_max)[1]
        return t, grids.depth(two, jnp.int32(0), ray, t)[1], whole

    t, reached, whole = map(np.asarray, jax.jit(jax.vmap(found))(o, d, wanted))
    ends = np.isinf(t)
    np.testing.assert_array_equal(ends[np.abs(whole - wanted) > 1e-4], (whole < wanted)[np.abs(whole - wanted) > 1e-4])
    assert 0.1 < ends.mean() < 0.9
    np.testing.assert_allclose(reached[~ends], wanted[~ends], rtol=1e-4, atol=1e-5)


@slow
def test_weights_of_a_flight_average_to_1_in_a_grid_of_colours(average_to_1):
    fog = media.Heterogeneous.instance("it", sigma_t=record(RNG.random((3, 3, 3, 3)) * 3, np.eye(4)), albedo=np.ones(3))
    ray = Ray(jnp.array([-0.2, 0.3, 0.4]), jnp.array([0.8, 0.0, 0.6]), jnp.float32(jnp.inf), jnp.int32(-1))
    average_to_1(fog, ray, jnp.array([1.0, 0.2, 3.0]), 100_000, 1e-5)  # rounding over the parts of a flight


# ---- light ----------------------------------------------------------------------------------------------------------


def scene(inside):
    to_world = pj.Transform().scale([1e-3, 1e-3, 1]).translate([0, 0, -3]).matrix
    film = {"type": "hdrfilm", "width": 2, "height": 2, "filter": {"type": "box"}}
    camera = {"type": "orthographic", "to_world": to_world, "film": film}
    cube = {"type": "cube", "id": "cube", "bsdf": {"type": "null"}, "interior": inside}
    rest = {"integrator": {"type": "volpath"}, "sky": {"type": "constant", "id": "sky"}}
    return pj.load_dict({"type": "scene", "camera": camera, "cube": cube, **rest})


@slow
def test_what_absorbs_in_a_grid_is_beers_law_and_so_is_its_derivative():
    """Along z values are 1, 3, 2, and constant in the outer halves of the outer cells; each cell is 2/3 thick."""
    fog = {"type": "heterogeneous", "albedo": 0.0, "scale": 0.7, "sigma_t": volume(np.reshape([1, 3, 2], (3, 1, 1)))}
    made = scene(fog)
    depth = (1 / 2 + (1 + 3) / 2 + (3 + 2) / 2 + 2 / 2) * 2 / 3
    image, J = pj.jacobian(made, ["cube_interior.scale"], spp=1)
    np.testing.assert_allclose(image, np.exp(-0.7 * depth), rtol=1e-5)
    np.testing.assert_allclose(J["cube_interior.scale"], -depth * np.exp(-0.7 * depth), rtol=1e-4)


@slow
def test_cells_that_are_not_interpolated_absorb_by_beers_law_and_so_do_derivatives_in_them():
    """Each cell is 2/3 thick; points sampled along the ray estimate each cell's share of the image's derivative."""
    cells = np.reshape([1.0, 3, 2], (3, 1, 1))
    fog = {"type": "heterogeneous", "albedo": 0.0, "sigma_t": volume(cells, filter_type="nearest")}
    made = scene(fog)
    through = np.exp(-2 * np.mean(cells))
    np.testing.assert_allclose(pj.render(made, spp=1), through, rtol=1e-5)

    def image(values):
        return pj.render(pj.with_parameters(made, {NAME: values}), 1024).mean()

    found = jax.grad(image)(pj.parameters(made)[NAME])
    # A third of 4096 points is expected in each cell; within 4 standard errors.
    np.testing.assert_allclose(found.ravel() / (-2 * through), 1 / 3, atol=4 * np.sqrt(2 / 9 / 4096))


def test_the_nearest_value_is_that_of_the_cell():
    data = RNG.random((3, 4, 2, 1))
    made = record(data, TURNED, nearest=True)
    p = made.box[0] + RNG.random((50, 3)) * (made.box[1] - made.box[0])
    cell = np.clip(np.rint(p @ made.to_grid[:, :3].T + made.to_grid[:, 3]).astype(int), 0, [1, 3, 2])
    built = grids.build([made], np.float32)
    found = jax.jit(jax.vmap(lambda p: grids.look_up(built, 0, p)))(jnp.asarray(p, jnp.float32))
    np.testing.assert_allclose(found, data[cell[:, 2], cell[:, 1], cell[:, 0]], rtol=1e-6)
    entries = jax.jit(jax.vmap(lambda p: grids.entries(built, 0, p)))(jnp.asarray(p, jnp.float32))
    told = sum(share[:, None] * np.asarray(built.values)[place] for place, share in entries)
    np.testing.assert_allclose(told, found, rtol=1e-6)


@slow
def test_values_of_a_grid_are_a_parameter():
    """As above, cells share a flight evenly. A point of it is sampled, but shares add up to 1 in each sample."""
    cells = np.reshape([1, 3, 2], (3, 1, 1))
    made = scene({"type": "heterogeneous", "albedo": 0.0, "scale": 0.7, "sigma_t": volume(cells)})
    values = pj.parameters(made)[NAME]
    np.testing.assert_array_equal(values, cells[..., None])
    other = pj.render(pj.with_parameters(made, {NAME: values[::-1] + 1}), spp=1)
    through = np.exp(-0.7 * 2 * np.mean(cells))
    np.testing.assert_allclose(other, through * np.exp(-0.7 * 2), rtol=1e-5)

    def image(values, spp=256):
        return pj.render(pj.with_parameters(made, {NAME: values}), spp)

    found = jax.grad(lambda x: image(x).mean())(values)
    np.testing.assert_allclose(found.sum(), -0.7 * 2 * through, rtol=1e-4)
    # A third of 1024 points is expected in each cell; within 4 standard errors.
    np.testing.assert_allclose(found.ravel() / found.sum(), 1 / 3, atol=4 * np.sqrt(2 / 9 / 1024))
    pushed = jax.jvp(image, (values,), (jnp.ones_like(values),))[1]
    np.testing.assert_allclose(pushed, -0.7 * 2 * through, rtol=1e-4)


@slow
def test_products_in_grids_are_the_transpose_of_each_other():
    """<v, J u> = <J' v, u> to rounding, for extinctions and albedos of two media, one in the shadow of the other."""

    def ball(name, y, radius, **medium):
        inside = {"type": "heterogeneous", "id": name, **medium}
        return {"type": "sphere", "center": [0, y, 0], "radius": radius, "bsdf": {"type": "null"}, "interior": inside}

    film = {"type": "hdrfilm", "width": 8, "height": 8, "filter": {"type": "box"}}
    camera = pj.Transform().look_at(origin=[0, 1, 3.5], target=[0, 0, 0], up=[0, 1, 0])
    turn = pj.Transform().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)
    scattering = {"sigma_t": volume(RNG.random((3, 2, 4)) + 0.3), "albedo": volume(RNG.random((2, 3, 2, 3)))}
    made = pj.load_dict({
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 5},
        "camera": {"type": "perspective", "fov": 45, "to_world": camera, "film": film},
        "floor": {"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse"}},
        "below": ball("cloud", 0, 0.9, **scattering),
        "above": ball("veil", 1.2, 0.3, sigma_t=volume(RNG.random((2, 2, 3, 3)), TURNED)),
        "lamp": {"type": "point", "position": [0, 3, 0], "intensity": {"type": "rgb", "value": [6, 5, 4]}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.4, 0.6]}},
    })  # fmt: skip
    values = {name: x for name, x in pj.parameters(made).items() if x.ndim == 4}
    assert set(values) == {"cloud.sigma_t", "cloud.albedo", "veil.sigma_t"}
    u = {name: jnp.asarray(RNG.normal(size=x.shape), jnp.float32) for name, x in values.items()}
    v = RNG.normal(size=(8, 8, 3)).astype(np.float32)

    def image(some):
        return pj.render(pj.with_parameters(made, some), spp=16)

    pulled = jax.vjp(image, values)[1](jnp.asarray(v))[0]
    none = {name: jnp.zeros_like(x) for name, x in u.items()}
    for name in values:
        pushed = jax.jvp(image, (values,), ({**none, name: u[name]},))[1] * v
        gap = abs(float((pulled[name] * u[name]).sum() - pushed.sum()))
        assert gap < 1e-5 * float(jnp.abs(pushed).sum()), name


def test_volumes_that_are_no_parameters_are_refused_by_name():
    repeats = volume(np.ones((2, 2, 2)), wrap_mode="repeat")
    for extinction in (repeats, {"type": "constvolume", "value": 2.0}):
        made = scene({"type": "heterogeneous", "albedo": 0.0, "sigma_t": extinction})
        with pytest.raises(pj.InputError, match="is a volume that repeats or has one value, which is no parameter"):
            pj.with_parameters(made, {NAME: 1.0})


@slow
def test_a_grid_is_fitted():
    """The extinction of 2 x 2 columns, seen along them, within 5 standard errors."""
    columns = np.reshape([0.5, 1, 1.5, 0.8], (1, 2, 2))
    to_world = pj.Transform().translate([0, 0, -3]).matrix
    film = {"type": "hdrfilm", "width": 16, "height": 16, "filter": {"type": "box"}}
    fog = {"type": "heterogeneous", "albedo": 0.0, "sigma_t": volume(columns)}
    cube = {"type": "cube", "id": "cube", "bsdf": {"type": "null"}, "interior": fog}
    camera = {"type": "orthographic", "to_world": to_world, "film": film}
    rest = {"integrator": {"type": "volpath"}, "sky": {"type": "constant", "id": "sky"}}
    made = pj.load_dict({"type": "scene", "camera": camera, "cube": cube, **rest})
    target = np.asarray(pj.render(made, 256, seed=5))
    fitted = pj.fit(made, target, [NAME], start={NAME: np.full((1, 2, 2, 1), 1.0)}, spp=64)
    error = np.abs(fitted.values[NAME][..., 0] - columns)
    assert (error < 5 * fitted.standard_errors[NAME][..., 0] + 1e-3).all() and (error < 0.02).all()


@slow
def test_a_constant_extinction_fills_the_unit_cube_of_what_is_heterogeneous():
    """As in Mitsuba. One of four pixels looks through the cube, since the camera's axis lies on its edge."""
    for made in (2.0, {"type": "constvolume", "value": 2.0}):
        image = pj.render(scene({"type": "heterogeneous", "albedo": 0.0, "sigma_t": made}), spp=1)
        np.testing.assert_allclose(np.sort(image[..., 0], None), [np.exp(-2), 1, 1, 1], rtol=1e-5)
    wide = {"type": "constvolume", "value": 2.0, "to_world": CUBE}
    image = pj.render(scene({"type": "heterogeneous", "albedo": 0.0, "sigma_t": wide}), spp=1)
    np.testing.assert_allclose(image, np.exp(-4), rtol=1e-5)


@slow
def test_a_grid_of_one_value_is_the_value():
    """Also for the albedo, and for derivatives in parameters that are not grids."""
    even = {"type": "homogeneous", "albedo": 0.6, "sigma_t": 1.2, "scale": 0.9}
    names = ["cube_interior.scale", "sky.radiance"]
    cells = np.full((2, 3, 2), 1.0)
    wavy = {"type": "heterogeneous", "albedo": volume(0.6 * cells), "sigma_t": volume(1.2 * cells), "scale": 0.9}
    (image, J), (other, other_J) = (pj.jacobian(scene(each), names, spp=64) for each in (even, wavy))
    np.testing.assert_allclose(image, other, rtol=2e-3)
    for name in names:
        np.testing.assert_allclose(J[name], other_J[name], rtol=5e-3, atol=1e-4)


def test_a_grid_that_repeats_is_laid_side_by_side():
    """At points of its rotated box it interpolates the values at integer coordinates, modulo the size."""
    data = RNG.random((3, 4, 2, 1))
    made = record(data, TURNED)
    tiled = grids.build([made.repeated(made.box)], np.float32)
    p = made.box[0] + RNG.random((50, 3)) * (made.box[1] - made.box[0])
    x = p @ made.to_grid[:, :3].T + made.to_grid[:, 3]
    low = np.floor(x).astype(int)
    expected = np.zeros((50, 1))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, x - low, 1 - (x - low)), 1, keepdims=True)
        i, j, k = ((low + corner) % data.shape[2::-1]).T
        expected += share * data[k, j, i]
    found = jax.jit(jax.vmap(lambda p: grids.look_up(tiled, 0, p)))(jnp.asarray(p, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=1e-5)


MI = """
import json, sys
import mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
made = mi.load_file(sys.argv[1])
images = np.stack([np.array(mi.render(made, spp=64, seed=k)) for k in range(16)])
print(json.dumps(images.tolist()))
"""


BLEND = """<phase type="blendphase"><float name="weight" value="0.3"/>
  <phase type="hg"><float name="g" value="0.7"/></phase>
  <phase type="hg"><float name="g" value="-0.4"/></phase></phase>"""


@slow
@pytest.mark.parametrize(
    ("wrap", "values", "phase"),
    [
        ("clamp", "trilinear", '<phase type="rayleigh"/>'),
        ("repeat", "trilinear", BLEND),
        ("repeat", "nearest", '<phase type="hg"/>'),
    ],
)
def test_clouds_agree_with_mitsuba(tmp_path, wrap, values, phase):
    """Means over 16 seeds and blocks of 4 x 4 pixels: none of 192 is off by 5 standard errors (t-test, 1 in 1000)."""
    pytest.importorskip("mitsuba")
    write_vol(tmp_path / "sigma.vol", RNG.random((4, 3, 5, 1)) * 3)
    write_vol(tmp_path / "albedo.vol", RNG.random((3, 4, 2, 3)))
    place = '<transform name="to_world"><scale value="2"/><translate x="-1" y="-1" z="-1"/></transform>'
    smaller = place.replace("<scale", '<scale value="0.4"/><rotate z="1" angle="20"/><scale')
    volumes = "".join(
        f'<volume name="{name}" type="gridvolume"><string name="filename" value="{file}.vol"/>{where}'
        f'<string name="wrap_mode" value="{wrap}"/><string name="filter_type" value="{values}"/></volume>'
        for name, file, where in (("sigma_t", "sigma", place), ("albedo", "albedo", smaller))
    )
    (tmp_path / "clouds.xml").write_text(f"""<scene version="3.0.0"><integrator type="volpath"/>
      <sensor type="perspective"><float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, -6, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/><rfilter type="box"/>
      </film></sensor><emitter type="constant"/>
      <emitter type="point"><point name="position" value="2, -3, 3"/><float name="intensity" value="9"/></emitter>
      <shape type="cube"><bsdf type="null"/><medium name="interior" type="heterogeneous">{volumes}
        <float name="scale" value="1.5"/>{phase}</medium></shape></scene>""")
    command = [sys.executable, "-c", MI, tmp_path / "clouds.xml"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    theirs = np.array(json.loads(run.stdout))
    made = pj.load_scene(tmp_path / "clouds.xml")
    ours = np.stack([np.asarray(pj.render(made, spp=64, seed=k), float) for k in range(16)])
    a, b = (images.reshape(16, 8, 4, 8, 4, 3).mean((2, 4)) for images in (ours, theirs))
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 16 + (1e-3 * b.mean(0)) ** 2)
    assert (np.abs(a.mean(0) - b.mean(0)) < 5 * error).all()


# ---- files ----------------------------------------------------------------------------------------------------------


def test_files_hold_values_and_a_box(tmp_path):
    data = RNG.random((2, 3, 4, 3)).astype(np.float32)
    write_vol(tmp_path / "a.vol", data)
    read, box = read_vol(tmp_path / "a.vol")
    np.testing.assert_array_equal(read, data)
    np.testing.assert_array_equal(box, [[0, 0, 0], [1, 1, 1]])


def test_a_saved_scene_has_its_grids_in_files(tmp_path):
    data = RNG.random((2, 3, 4)).astype(np.float32)
    made = scene({"type": "heterogeneous", "albedo": 0.0, "sigma_t": volume(data)})
    pj.save_scene(made, tmp_path / "saved.xml")
    again = pj.load_scene(tmp_path / "saved.xml")
    for x, y in zip(jax.tree.leaves(made.media), jax.tree.leaves(again.media), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_saved_scene_has_the_values_of_its_grids(tmp_path):
    """Also where the grid's box is that of the file, which new values do not move."""
    write_vol(tmp_path / "a.vol", RNG.random((2, 3, 4, 1)), np.array([[-1.0, 0, 0], [1, 2, 1]]))
    file = {"type": "gridvolume", "filename": str(tmp_path / "a.vol"), "use_grid_bbox": True}
    made = scene({"type": "heterogeneous", "albedo": volume(RNG.random((2, 1, 2, 3))), "sigma_t": file})
    values = {NAME: RNG.random((2, 3, 4, 1)), "cube_interior.albedo": RNG.random((2, 1, 2, 3))}
    made = pj.with_parameters(made, values)
    pj.save_scene(made, tmp_path / "saved.xml")
    again = pj.load_scene(tmp_path / "saved.xml")
    for x, y in zip(jax.tree.leaves(made.media), jax.tree.leaves(again.media), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"VOX", "not a volume of Mitsuba's format, version 3"),
        (b"VOL\2" + bytes(44), "not a volume of Mitsuba's format, version 3"),
        (b"VOL\3" + np.array([2, 1, 1, 1, 1], "<i4").tobytes() + bytes(24), "has encoding 2"),
        (b"VOL\3" + np.array([1, 1, 1, 1, 4], "<i4").tobytes() + bytes(24), "and 4 channels; use float32, and 1 or 3"),
        (b"VOL\3" + np.array([1, 9, 9, 9, 1], "<i4").tobytes() + bytes(24), "cut off: 9 x 9 x 9 cells"),
        (b"VOL\3" + np.array([1, 1, 1, 1, 1], "<i4").tobytes() + bytes(28), "its box is empty"),
        (None, "no file"),
    ],
)
def test_files_that_are_no_volumes_are_refused(tmp_path, content, says):
    if content is not None:
        (tmp_path / "a.vol").write_bytes(content)
    with pytest.raises(pj.InputError, match=says):
        scene({"type": "heterogeneous", "sigma_t": {"type": "gridvolume", "filename": str(tmp_path / "a.vol")}})


@pytest.mark.parametrize(
    ("inside", "says"),
    [
        ({"sigma_t": volume(-np.ones((1, 1, 1)))}, "its values must not be negative"),
        ({"sigma_t": volume(np.full((1, 1, 2), np.nan))}, "its values must not be negative"),
        ({"albedo": volume(np.full((1, 1, 2), 1.5))}, "must lie between 0 and 1, and are 1.5 to 1.5"),
        ({"sigma_t": volume(np.ones((2, 2)))}, "must have the shape"),
        ({"sigma_t": volume(np.ones((1, 1, 1)), wrap_mode="black")}, 'cannot be "black"'),
        ({"type": "homogeneous", "albedo": volume(np.ones((1, 1, 1)), wrap_mode="repeat")}, "repeats without end"),
        ({"sigma_t": volume(np.ones((1, 1, 1)), filter_type="cubic")}, 'cannot be "cubic"'),
    ],
)
def test_grids_that_are_not_modelled_are_refused(inside, says):
    with pytest.raises(pj.InputError, match=f"scene.cube.interior.*{says}"):
        scene({"type": "heterogeneous", **inside})


def test_the_extinction_of_what_is_homogeneous_is_no_grid():
    with pytest.raises(pj.InputError, match="gridvolume.*is not supported yet; use one of constvolume"):
        scene({"type": "homogeneous", "sigma_t": volume(np.ones((1, 1, 1)))})
