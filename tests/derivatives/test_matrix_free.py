"""J v and J^T v without J: against each other, entry by entry, and against the Jacobian."""

import contextlib
import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import pathjax as pj
from pathjax.compile import mapping
from pathjax.derivatives import backward, differentiated, forward, jacobian, matrix_free, record, totals
from pathjax.derivatives.kept import MOST_RUNS, Kept, few
from pathjax.errors import InputError
from pathjax.images import write_exr
from pathjax.integrators.options import Options
from pathjax.scene import parameters as named
from pathjax.sensors.film import pixel_count

NO_LIMIT = 1 << 30
RES, SPP = 8, 4
# Rounding error of float32 sums of some thousand scalars, relative to the sum of their magnitudes.
ROUNDING = 3e-6


def diffuse(name, inside):
    return f'<bsdf type="diffuse" id="{name}">{inside}</bsdf>'


def rgb(name, value):
    return f'<rgb name="{name}" value="{value}"/>'


def texture(file, filter_type="bilinear"):
    return (
        f'<texture type="bitmap" name="reflectance"><string name="filename" value="{file}"/>'
        f'<boolean name="raw" value="true"/><string name="filter_type" value="{filter_type}"/></texture>'
    )


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    """(h, w) -> file of an image of random colours."""
    folder = tmp_path_factory.mktemp("pictures")

    def make(h, w):
        numbers = np.random.default_rng(h * w).uniform(0.1, 0.9, (3, h, w)).astype(np.float32)
        write_exr(folder / f"{h}x{w}.exr", dict(zip("RGB", numbers, strict=True)), {})
        return folder / f"{h}x{w}.exr"

    return make


@pytest.fixture(scope="module")
def room(make_scene, picture):
    """Everything that a path may meet: bitmaps of both filters, squares, a constant, metal, glass, a lamp, the sky."""

    def make(**how):
        squares = (
            '<texture type="checkerboard" id="squares" name="reflectance"><transform name="to_uv"><scale value="2"/>'
            f"</transform>{rgb('color0', '0.2, 0.5, 0.7')}{rgb('color1', '0.9, 0.3, 0.1')}</texture>"
        )
        metal = f'<bsdf type="conductor" id="metal">{rgb("eta", "0.2, 0.9, 1.1")}{rgb("k", "3.9, 2.4, 2.1")}</bsdf>'
        lamp = f'<emitter type="area" id="lamp">{rgb("radiance", "3, 2, 1")}</emitter>'

        def shape(kind, transform, inside):
            return f'<shape type="{kind}"><transform name="to_world">{transform}</transform>{inside}</shape>'

        def ball(x, y, z, inside):
            return shape("sphere", f'<scale value="0.6"/><translate x="{x}" y="{y}" z="{z}"/>', inside)

        floor, side = diffuse("floor", texture(picture(2, 3))), diffuse("side", texture(picture(2, 1), "nearest"))
        black = diffuse("black", rgb("reflectance", 0))
        return make_scene(
            shape("rectangle", '<rotate x="1" angle="-90"/><scale value="3"/>', floor)
            + shape("rectangle", '<scale value="3"/><translate z="-2"/>', diffuse("wall", squares))
            + shape("rectangle", '<rotate y="1" angle="90"/><scale value="3"/><translate x="-2"/>', side)
            + shape("rectangle", '<rotate x="1" angle="90"/><translate y="3"/>', black + lamp)
            + ball(-1, 0.6, 0, metal)
            + ball(1, 0.6, -1, diffuse("ball", rgb("reflectance", "0, 0.5, 1")))
            + ball(0.3, 0.6, 1, '<bsdf type="dielectric"/>')
            + f'<emitter type="constant" id="sky">{rgb("radiance", "0.3, 0.4, 0.5")}</emitter>',
            res=RES,
            origin="0, 1.5, 5",
            target="-0.4, 1, 0",
            fov=60,
            **how,
        )

    return make


def parts(scene, spp=SPP, seed=3, strategy="mis", **how):
    """Return the parameters that the sweep handles, and functions that return J v and J^T v for them."""
    pixels = jnp.arange(pixel_count(scene.film), dtype=jnp.int32)
    wanted = {n: p for n, p in scene.about.parameters.items() if matrix_free.is_swept(scene, p)}
    work = pixels, 0, spp, seed, Options(strategy)
    bare = named.nameless(scene)
    return (
        wanted,
        lambda changes: np.asarray(matrix_free.push(bare, wanted, changes, *work, **how), float),
        lambda adjoint: matrix_free.pull(bare, wanted, adjoint, *work, **how),
    )


def assert_transposed(scene, **how):
    """Assert that J^T v agrees with tangents, each of which moves one entry of a parameter in all channels."""
    wanted, push, pull = parts(scene, **how)
    v = np.random.default_rng(0).normal(size=(pixel_count(scene.film), 3)).astype(scene.camera.origin.dtype)
    pulled = pull(jnp.asarray(v))
    assert set(pulled) == set(wanted)
    for name, p in wanted.items():
        for entry in np.ndindex(p.shape[:-1]):
            terms = push({name: jnp.zeros(p.shape, v.dtype).at[entry].set(1)}) * v
            gap = np.abs(pulled[name][entry] - terms.sum(0))
            assert (gap <= ROUNDING * np.abs(terms).sum(0)).all(), (name, entry, gap)
    return pulled


def limited(scene, depth, rr_depth):
    return replace(scene, max_depth=jnp.int32(depth), rr_depth=jnp.int32(rr_depth))


@pytest.mark.slow
@pytest.mark.parametrize("depth, rr_depth", [(3, NO_LIMIT), (20, NO_LIMIT), (NO_LIMIT, 5)])
def test_a_sweep_is_the_transpose_of_tangents(room, depth, rr_depth):
    scene = limited(room(), depth, rr_depth)
    for reflectance in ([0, 0.5, 1], [1, 1, 0]):
        pulled = assert_transposed(pj.with_parameters(scene, {"ball.reflectance": reflectance}))
        assert all(np.abs(pulled[name]).max() > 0 for name in pulled if name != "black.reflectance")


@pytest.mark.slow
@pytest.mark.parametrize("how", [{"strategy": "light"}, {"strategy": "bsdf"}, {"hide": "true"}, {"dtype": jnp.float64}])
def test_strategies_hidden_lights_and_float64(room, x64, how):
    strategy = how.pop("strategy", "mis")
    with x64() if "dtype" in how else contextlib.nullcontext():
        assert_transposed(limited(room(**how), 6, 3), strategy=strategy)


@pytest.mark.slow
def test_changes_of_texels_alone_are_those_beside_other_changes(room, monkeypatch):
    """Alone and in far memory they lie in the rows of the texels; among others, in the list of all changes."""
    monkeypatch.setattr(forward, "NEAR", 0)
    scene = limited(room(), 4, 2)
    wanted, _, _ = parts(scene)
    of_texels = {name: p for name, p in wanted.items() if p.is_texture}
    assert len({p.path for p in of_texels.values()}) == 1 < len({p.path for p in wanted.values()})
    random = np.random.default_rng(5)
    changes = {name: jnp.asarray(random.normal(size=p.shape), jnp.float32) for name, p in of_texels.items()}
    work = jnp.arange(RES * RES, dtype=jnp.int32), 0, SPP, 3, Options()
    alone, among = (matrix_free.push(named.nameless(scene), which, changes, *work) for which in (of_texels, wanted))
    assert np.abs(among).max() > 0
    np.testing.assert_allclose(alone, among, rtol=1e-5, atol=1e-5 * np.abs(among).max())


@pytest.mark.slow
def test_the_jacobian_is_the_same(room):
    """The public `jacobian`, contracted with v over the pixels, is J^T v of the sweep."""
    scene, names = limited(room(), 4, 2), ["ball.reflectance", "metal.k", "lamp.radiance"]
    wanted, push, pull = parts(scene)
    v = jnp.asarray(np.random.default_rng(1).normal(size=(RES * RES, 3)), jnp.float32)
    _, J = pj.jacobian(scene, names, SPP, 3)
    pulled = pull(v)
    for name in names:
        terms = np.asarray(J[name]).reshape(-1, 3, 3) * np.asarray(v)[..., None]
        gap = np.abs(pulled[name] - terms.sum((0, 1)))
        assert (gap <= ROUNDING * np.abs(terms).sum((0, 1))).all(), name


@pytest.fixture(scope="module")
def numbers(make_scene, tmp_path_factory):
    """A scene of rough, blended and masked bsdfs, a grey texture in place of a colour, and a point light."""
    file = tmp_path_factory.mktemp("numbers") / "grey.png"
    Image.fromarray(np.random.default_rng(0).integers(60, 200, (2, 3), np.uint8)).save(file)
    grey = f'<string name="filename" value="{file}"/><boolean name="raw" value="true"/>'

    def plastic(name, metallic):
        inside = f'<float name="roughness" value="0.4"/><float name="metallic" value="{metallic}"/>'
        inside += f'<float name="sheen" value="0.5"/>{rgb("base_color", "0.7, 0.4, 0.2")}'
        return f'<bsdf type="principled" id="{name}">{inside}</bsdf>'

    both = f'<float name="weight" value="0.4"/>{plastic("one", 0.2)}{plastic("two", 0.6)}'
    blend = f'<bsdf type="blendbsdf" id="blend">{both}</bsdf>'
    metal = '<bsdf type="roughconductor" id="metal"><float name="alpha" value="0.3"/>'
    metal += f'<texture type="bitmap" name="specular_reflectance">{grey}</texture></bsdf>'
    leaf = f'<bsdf type="mask" id="leaf"><float name="opacity" value="0.6"/>{diffuse("green", "")}</bsdf>'

    def shape(kind, x, inside):
        return f'<shape type="{kind}"><transform name="to_world"><translate x="{x}"/></transform>{inside}</shape>'

    lamp = '<emitter type="point" id="lamp"><point name="position" x="0" y="2" z="3"/></emitter>'
    shapes = shape("sphere", -2, blend) + shape("sphere", 0, metal) + shape("rectangle", 2, leaf) + lamp
    return make_scene(shapes + f'<emitter type="constant" id="sky">{rgb("radiance", 1)}</emitter>', res=RES, depth=4)


@pytest.mark.slow
def test_a_jacobian_in_many_numbers_is_that_by_tangents(numbers, monkeypatch):
    """It also contracts to J^T v, which a sweep sums up in one list of all entries."""
    known = numbers.about.parameters
    names = [name for name in known if not known[name].moves_paths]
    constants, texels = ([name for name in names if known[name].is_texture == t] for t in (False, True))
    assert len(constants) > 12 and known[texels[0]].shape == (2, 3, 3)
    image, J = pj.jacobian(numbers, names, SPP, 3)
    v = jnp.asarray(np.random.default_rng(1).normal(size=image.shape), jnp.float32)
    values = {name: jnp.asarray(pj.parameters(numbers)[name]) for name in names}
    (pulled,) = jax.vjp(lambda values: pj.render(pj.with_parameters(numbers, values), SPP, 3), values)[1](v)
    monkeypatch.setattr(jacobian, "takes_sweep", lambda *_, **__: False)
    expected = pj.jacobian(numbers, constants, SPP, 3)[1]
    for name in names:
        terms = np.asarray(J[name], float)
        assert terms.shape == (*image.shape, *known[name].shape) and np.abs(terms).max() > 0, name
        size = np.tensordot(np.abs(v), np.abs(terms), 3)
        assert (np.abs(np.tensordot(v, terms, 3) - pulled[name]) <= ROUNDING * size).all(), name
        if name in constants:
            np.testing.assert_allclose(terms, expected[name], rtol=1e-5, atol=1e-5 * np.abs(terms).max())


def test_the_program_of_a_jacobian_has_a_part_for_each_number_of_a_kind(numbers):
    """It has no part per bsdf, so the cost of compiling does not grow with the number of bsdfs."""
    fields = "base_color", "roughness", "metallic", "sheen"

    def equations(*bsdfs):
        names = [f"{bsdf}.{field}" for bsdf in bsdfs for field in fields]
        program = jax.make_jaxpr(lambda: jax.tree.leaves(pj.jacobian(numbers, names, SPP, 3)))()
        return len(str(program).splitlines())

    one, both = equations("one"), equations("one", "two")
    assert abs(both - one) < 0.05 * one, (one, both)


def patches(count, res):
    """Return a wall of squares, each with its own material, and a lamp in front of it; and the resolution."""
    wall = "".join(
        f'<shape type="rectangle"><transform name="to_world"><scale value="0.1"/>'
        f'<translate x="{0.2 * (i % 3) - 0.2}" y="{0.2 * (i // 3) - 0.3}"/></transform>'
        f"{diffuse(f'p{i}', rgb('reflectance', f'{i / count}, 0.5, 1'))}</shape>"
        for i in range(count)
    )
    lamp = f'<emitter type="area" id="lamp">{rgb("radiance", "3, 2, 1")}</emitter>'
    before = '<rotate x="1" angle="90"/><scale value="0.3"/><translate y="0.5" z="0.4"/>'
    return wall + f'<shape type="rectangle"><transform name="to_world">{before}</transform>{lamp}</shape>', res


@pytest.mark.slow
def test_a_jacobian_in_many_colours_is_that_by_tangents(make_scene, monkeypatch):
    """A recorded sweep computes it, bit for bit alike on any number of devices and, call by call, under vmap."""
    inside, res = patches(jacobian.MOST_TANGENTS + 3, 23)  # more pixels than two groups of lanes hold
    scene = limited(make_scene(inside, res=res, origin="0, 0, 2", fov=30), 6, 2)
    names = list(pj.parameters(scene))
    swept = pj.jacobian(scene, names, SPP, 3)
    pair = jax.vmap(lambda seed: pj.jacobian(scene, names, SPP, seed))(jnp.array([5, 3]))
    for one, of_two in zip(jax.tree.leaves(swept), jax.tree.leaves(pair), strict=True):
        np.testing.assert_array_equal(one, of_two[1])
    np.testing.assert_array_equal(swept[1][names[1]], pair[1][names[1]][1])
    alone = jacobian.pixel_jacobians(
        named.nameless(scene),
        scene.about.parameters,
        jnp.arange(res * res, dtype=jnp.int32),
        *(0, SPP, 3, Options()),
        devices=1,
    )
    np.testing.assert_array_equal(swept[0].reshape(-1, 3), alone[0])
    np.testing.assert_array_equal(swept[1][names[0]].reshape(-1, 3, 3), alone[1][names[0]])
    some = pj.jacobian(scene, names[: jacobian.MOST_TANGENTS : -1], SPP, 3)[1]
    assert set(some) == set(names[: jacobian.MOST_TANGENTS : -1])
    np.testing.assert_array_equal(some[names[-1]], swept[1][names[-1]])
    monkeypatch.setattr(jacobian, "MOST_TANGENTS", len(names))
    by_tangents = pj.jacobian(scene, names, SPP, 3)
    assert set(swept[1]) == set(by_tangents[1])
    images = [(swept[0], by_tangents[0]), *((swept[1][name], by_tangents[1][name]) for name in names)]
    for one, other in images:
        # Rounding of float32 sums of some tens of scalars of one sign.
        np.testing.assert_allclose(one, other, rtol=3e-6, atol=3e-6 * np.abs(other).max())


def test_an_image_pulled_back_to_a_few_colours(make_scene):
    """There are too many for tangents, and so few that each lane sums by itself; within a user's own jit."""
    inside, res = patches(jacobian.MOST_TANGENTS, 8)
    scene = limited(make_scene(inside, res=res, origin="0, 0, 2", fov=30), 3, 2)
    values = {name: jnp.asarray(value) for name, value in pj.parameters(scene).items()}
    assert jacobian.MOST_TANGENTS < len(values) <= totals.FEW
    v = jnp.asarray(np.random.default_rng(1).normal(size=(res, res, 3)), jnp.float32)

    @jax.jit
    def pulled(values):
        return jax.vjp(lambda x: pj.render(pj.with_parameters(scene, x), SPP, 3), values)[1](v)[0]

    J = pj.jacobian(scene, list(values), SPP, 3)[1]
    for name, found in pulled(values).items():
        terms = J[name] * v[..., None]
        np.testing.assert_allclose(found, terms.sum((0, 1, 2)), atol=ROUNDING * np.abs(terms).sum((0, 1, 2)).max())


@pytest.mark.parametrize("near", [0, 1 << 30])
def test_lanes_add_to_a_list_that_is_far_as_to_one_that_is_near(monkeypatch, near):
    """Several lanes add to the same places and some add nothing; the list may hold values that are not finite."""
    monkeypatch.setattr(totals, "NEAR", near)
    random = np.random.default_rng(4)
    places = random.integers(0, 50, (4, 64)).astype(np.int32)
    shares, change = (random.random((n, 64)).astype(np.float32) for n in (4, 3))
    change[:, ::3] = 0
    total = np.zeros((60, totals.WIDTH), np.float32)
    total[55, :3] = np.nan, np.inf, -np.inf
    expected = total.copy()
    for place, share in zip(places, shares, strict=True):
        np.add.at(expected[:, :3], place, (share * change).T)
    slot = record.Slot(tuple(jnp.asarray(places)), tuple(jnp.asarray(shares)), None, None)
    found = jax.jit(lambda *args: totals.add(*args))(jnp.asarray(total), slot, list(jnp.asarray(change)))
    np.testing.assert_allclose(found, expected, rtol=1e-5)  # sums in another order


@pytest.mark.slow
@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="needs two devices")
def test_sums_are_bitwise_the_same_on_any_number_of_devices(room, monkeypatch):
    monkeypatch.setattr(mapping, "ITEMS_OF_A_PART", 16)  # four parts of an image
    scene, v = limited(room(), 6, 3), jnp.ones((RES * RES, 3))
    backward.pullback.clear_cache()  # its kernels have parts of another size
    one, many = (parts(scene, devices=devices)[2](v) for devices in (1, None))
    for name in one:
        np.testing.assert_array_equal(one[name], many[name])


@pytest.fixture(scope="module")
def screen(make_scene, picture):
    """A bitmap that fills the view under radiance 1, so that each sample is a weighted mean of its texels."""
    inside = diffuse("screen", texture(picture(4, 4)))
    return make_scene(
        f'<shape type="rectangle">{inside}</shape><emitter type="constant"/>', res=RES, fov=28.0724869, depth=2
    )


NAME = "screen.reflectance"


def image_of(scene):
    return lambda texels: pj.render(pj.with_parameters(scene, {NAME: texels}), SPP, 3)


def test_a_bitmap_is_a_parameter(screen):
    texels = pj.parameters(screen)[NAME]
    assert texels.shape == (4, 4, 3)
    black = pj.with_parameters(screen, {NAME: 0})
    assert not pj.parameters(black)[NAME].any() and not np.asarray(pj.render(black, 1)).any()
    changed = texels.at[1, 2, 0].set(0.25)
    np.testing.assert_array_equal(pj.parameters(pj.with_parameters(screen, {NAME: changed}))[NAME], changed)
    for value, message in ((np.zeros((4, 3, 3)), r"\(4, 4, 3\), and cannot be set to 4 x 3 x 3"), (2, "outside its")):
        with pytest.raises(pj.InputError, match=message):
            pj.with_parameters(screen, {NAME: value})


def test_transformations_of_a_linear_image(screen):
    """I = J texels holds for J v, J^T v and JAX's transformations of them, also within jit."""
    texels, image = pj.parameters(screen)[NAME], image_of(screen)
    v = jnp.asarray(np.random.default_rng(2).normal(size=(RES, RES, 3)), jnp.float32)
    value, linear = jax.linearize(image, texels)
    np.testing.assert_allclose(linear(texels), value, rtol=1e-5)
    np.testing.assert_array_equal(jax.jvp(image, (texels,), (texels,))[1], linear(texels))
    pulled = jax.jit(jax.grad(lambda x: (image(x) * v).sum()))(texels)
    sizes = np.abs(value * v).sum((0, 1))
    assert (np.abs((pulled * texels).sum((0, 1)) - (value * v).sum((0, 1))) <= ROUNDING * sizes).all()
    batch = jax.vmap(linear)(jnp.stack([texels, 2 * texels]))
    np.testing.assert_allclose(batch, [value, 2 * value], rtol=1e-5)


def test_jacobians_in_textures(make_scene, picture):
    """Of two textures in one array, only the texels of the requested one are kept, beside a colour."""
    turned = '<scale value="{}"/><rotate y="1" angle="{}"/><translate x="{}" z="{}"/>'
    inside = "".join(
        f'<shape type="rectangle"><transform name="to_world">{turned.format(*place)}</transform>'
        f"{diffuse(name, reflectance)}</shape>"
        for place, name, reflectance in (
            ((1, 20, -1, 0), "left", texture(picture(2, 3))),
            ((1, -20, 1, 0), "right", texture(picture(5, 4))),
            ((0.5, 0, 0, 1), "plate", rgb("reflectance", 0.5)),
        )
    )
    inside += f'<emitter type="constant" id="sky">{rgb("radiance", 1)}</emitter>'
    scene, names = make_scene(inside, res=RES, depth=3), ["right.reflectance", "plate.reflectance"]
    image, J = pj.jacobian(scene, names, SPP, 3)
    wanted = {name: scene.about.parameters[name] for name in names}
    bare, pixels = named.nameless(scene), jnp.arange(RES * RES, dtype=jnp.int32)
    v = jnp.asarray(np.random.default_rng(1).normal(size=(RES * RES, 3)), jnp.float32)
    pulled = matrix_free.pull(bare, wanted, v, pixels, 0, SPP, 3, Options())
    for name, found in pulled.items():
        terms = np.asarray(J[name]).reshape(RES * RES, 3, *found.shape)
        sizes = np.abs(terms).sum((0, 1)) + np.finfo(np.float32).tiny
        assert (np.abs(np.tensordot(v, terms, 2) - found) <= ROUNDING * sizes).all(), name
        assert (np.abs(np.asarray(found)) > 0).any()
    assert len(J.derivatives.rows.all()) == 5 * 4 + 1 + 1  # the last row collects all that is not requested

    normal = pj.normal_equations(scene, names, image, spp=SPP, seed=3)
    assert normal.matrix.shape == (63, 63) and normal.components[0] == "right.reflectance[0, 0].r"
    halves = normal.residuals.reshape(2, -1) + np.asarray(image).ravel()
    assert np.isfinite(halves).all() and np.linalg.eigvalsh(normal.matrix).max() > 0


def alpha(file):
    bitmap = f'<texture type="bitmap" name="alpha"><string name="filename" value="{file}"/></texture>'
    return f'<bsdf type="roughconductor" id="rough">{bitmap}</bsdf>'


@pytest.mark.slow
def test_textures_that_are_not_asked_for_take_no_part(make_scene, picture):
    """For a texture of reflectances, textures of roughnesses or of a checkerboard's colours are not recorded.

    A Jacobian treats roughnesses as scalars, though they are the luminance of colours.
    """
    board = f'<texture type="checkerboard" name="reflectance">{rgb("color0", "0.2, 0.5, 0.7")}</texture>'
    bsdfs = diffuse("wall", texture(picture(2, 3))), diffuse("board", board), alpha(picture(3, 3))
    inside = "".join(
        f'<shape type="rectangle"><transform name="to_world"><translate x="{2 * k - 2}"/></transform>{bsdf}</shape>'
        for k, bsdf in enumerate(bsdfs)
    )
    scene = make_scene(inside + f'<emitter type="constant">{rgb("radiance", 1)}</emitter>', res=RES, depth=3)
    known = scene.about.parameters

    def slots(*names):
        wanted = [known[name] for name in names]
        paths = tuple(dict.fromkeys(p.path for p in wanted))
        return differentiated.slots(scene, paths, differentiated.places_of_textures(wanted))

    assert (slots("wall.reflectance").of_bsdfs, slots("wall.reflectance").colors) == (1, 1)
    assert (slots("rough.alpha").of_bsdfs, slots("rough.alpha").colors) == (1, 0)
    assert slots("wall.reflectance", "rough.alpha").of_bsdfs == 2
    board = next(name for name in known if name.endswith("color0"))
    assert slots(board).of_bsdfs == 2  # a checkerboard's colour may stand in any field
    everything = [name for name in known if matrix_free.is_swept(scene, known[name])]
    pulled = {}
    for names in (everything, *([name] for name in everything)):
        wanted, pixels = {name: known[name] for name in names}, jnp.arange(RES * RES, dtype=jnp.int32)
        v = jnp.ones((RES * RES, 3))
        found = matrix_free.pull(named.nameless(scene), wanted, v, pixels, 0, SPP, 3, Options())
        for name, x in found.items():
            first = pulled.setdefault(name, x)
            np.testing.assert_allclose(x, first, rtol=1e-5, atol=1e-6 * np.abs(first).max())
    assert not jacobian.has_rows(scene, [known[board]])  # it may stand for a scalar
    image, J = pj.jacobian(scene, ["wall.reflectance", "rough.alpha"], SPP, 3)
    for name in J:
        terms = np.asarray(J[name], float)
        assert terms.shape == (*image.shape, *known[name].shape)
        np.testing.assert_allclose(terms.sum((0, 1, 2)), pulled[name], rtol=1e-4, atol=1e-5 * np.abs(terms).max())


@pytest.mark.parametrize("count", [1, MOST_RUNS, MOST_RUNS + 3])
def test_entries_of_few_runs_are_kept(count):
    wanted = [range(10 * k * k, 10 * k * k + 1 + k) for k in range(count)]
    runs = few(wanted)
    assert len(runs) == min(count, MOST_RUNS) and all(a.stop < b.start for a, b in itertools.pairwise(runs))
    held = Kept((), runs, False)
    places = [held.places(run) for run in wanted]
    assert sorted({p for each in places for p in each}) == sorted(p for each in places for p in each)
    for run, mine in zip(wanted, places, strict=True):
        assert [int(held.place(entry)) for entry in run] == list(mine)
    assert int(held.place(runs[-1].stop)) == held.count - 1 == sum(map(len, runs))
    assert few([range(3, 4), range(0, 3), range(3, 6)][1:]) == (range(0, 6),)


def test_what_takes_a_derivative_of_each_number_refuses_textures_that_it_cannot_take(screen, make_scene, picture):
    image = f'<texture type="bitmap" id="image"><string name="filename" value="{picture(2, 3)}"/></texture>'
    places = '<ref id="image" name="specular_reflectance"/><ref id="image" name="alpha"/>'
    metal = f'<bsdf type="roughconductor" id="metal">{places}</bsdf>'
    scene = make_scene(f'{image}<shape type="sphere">{metal}</shape><emitter type="constant"/>', res=RES)
    (name,) = (name for name, each in scene.about.parameters.items() if each.is_texture)
    with pytest.raises(pj.InputError, match=f"{name} is a texture, .* stands for colours and for numbers both"):
        pj.jacobian(scene, [name], 1)
    with pytest.raises(pj.InputError, match="second derivatives are not"):
        jax.hessian(lambda x: pj.render(pj.with_parameters(screen, {NAME: x}), 1).sum())(pj.parameters(screen)[NAME])


@pytest.mark.slow
@pytest.mark.parametrize(("ring", "lost"), [(1, True), (2, False)])
def test_a_path_longer_than_the_ring_is_told(screen, monkeypatch, ring, lost):
    """Derivatives are NaN rather than incomplete, where max_depth is traced and so known only to the compiled kernel.

    Paths have two vertices, and every trip is swept.
    """
    texels = pj.parameters(screen)[NAME]
    monkeypatch.setattr(backward, "RING", ring)
    monkeypatch.setattr(backward, "WINDOW", 1)
    backward.pullback.clear_cache()
    try:
        of = jax.jit(jax.grad(lambda x, scene: image_of(scene)(x).sum()))
        found = np.isnan(of(texels, limited(screen, 5, NO_LIMIT)))
    finally:
        backward.pullback.clear_cache()
    assert found.all() if lost else not found.any()


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(2, 2, 3), (3,)])
def test_paths_of_any_length_are_recorded_whole(make_scene, picture, shape):
    """In a closed sphere that emits 1, every sample is I = (1 - rho^d) / (1 - rho).

    Also for a colour, among more parameters than get a tangent each.
    """
    depth, rho = 3000, 0.999
    wall = diffuse("wall", texture(picture(2, 2)) if len(shape) == 3 else rgb("reflectance", "0.5"))
    lamp = f'<boolean name="flip_normals" value="true"/><emitter type="area">{rgb("radiance", "1")}</emitter>'
    there = diffuse("unseen", rgb("reflectance", "1"))
    unseen = f'<shape type="sphere"><point name="center" value="9"/>{there}</shape>'
    scene = make_scene(f'<shape type="sphere">{lamp}{wall}</shape>{unseen}', res=2, origin="0, 0, 0.1", fov=60)
    scene = limited(scene, depth, NO_LIMIT)
    values = pj.parameters(scene) if len(shape) == 1 else {}
    values = values | {"wall.reflectance": jnp.full(shape, rho, jnp.float32)}
    found = jax.grad(lambda x: pj.render(pj.with_parameters(scene, x), 1, 0, "bsdf").sum())(values)["wall.reflectance"]
    assert len(values) in (1, jacobian.MOST_TANGENTS + 1)
    expected = (1 - rho**depth - depth * rho ** (depth - 1) * (1 - rho)) / (1 - rho) ** 2
    # Sums of thousands of float32 scalars of one sign.
    np.testing.assert_allclose(found.reshape(-1, 3).sum(0), 4 * expected, rtol=1e-3)


def test_paths_too_long_to_be_recorded_are_refused(screen):
    scene = limited(screen, 10**6, NO_LIMIT)
    with pytest.raises(InputError, match="set a smaller max_depth"):
        jax.eval_shape(jax.grad(lambda x: image_of(scene)(x).sum()), pj.parameters(scene)[NAME])
