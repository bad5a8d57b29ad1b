"""Normal equations against the Jacobians that they sum up, for views, weights, blocks, chunks and devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.compile import native_map
from pathjax.inverse import normal, problem
from pathjax.system import memory

BODY = """
<bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.6, 0.5, 0.2"/></bsdf>
<bsdf type="roughconductor" id="metal"><float name="alpha" value="0.3"/></bsdf>
<bsdf type="dielectric" id="glass"/>
<shape type="rectangle"><transform name="to_world"><scale value="3"/><rotate x="1" angle="-90"/>
  <translate y="-1"/></transform><ref id="floor"/></shape>
<shape type="sphere"><point name="center" x="-0.9" y="0" z="0"/><ref id="metal"/></shape>
<shape type="sphere"><point name="center" x="0.9" y="0" z="0"/><ref id="glass"/></shape>
<emitter type="constant" id="sky"><rgb name="radiance" value="1, 0.9, 0.8"/></emitter>
"""
# A scalar that moves paths, a colour, a scalar, a colour.
NAMES = ["glass.int_ior", "floor.reflectance", "metal.alpha", "sky.radiance"]
RES, SPP, COUNT = 9, 4, 8
# Rounding error of float32 sums of some hundred scalars, relative to the largest sum.
ROUNDING = 3e-5
WEIGHTS = np.random.default_rng(0).uniform(size=(RES, RES, 3))


@pytest.fixture(scope="module")
def scene(make_scene):
    return make_scene(BODY, res=RES, depth=3)


@pytest.fixture(scope="module")
def target():
    return np.random.default_rng(4).uniform(size=(RES, RES, 3))


def made_up(scene, wanted, pixels, first, spp, seed, options, devices=None):
    """Return noise from -1 to 1 instead of calling `pixel_jacobians`, whose kernel takes long to compile."""

    def of_pixel(work):
        pixel, seed = work
        which = pixel * 3 + jnp.arange(3) + (seed % 4099).astype(jnp.int32) * 7
        return [jnp.sin((which + 1000 * number) ** 2 * 0.37) for number in range(1 + len(wanted))]

    image, *slopes = native_map(of_pixel, (pixels, jnp.broadcast_to(seed, pixels.shape)), devices=devices)
    J = zip(wanted.items(), slopes, strict=True)
    return image, {name: s[..., None] * jnp.eye(3) if parameter.shape else s for (name, parameter), s in J}


@pytest.fixture
def no_kernel(monkeypatch):
    """(function) -> None: replaces `pixel_jacobians` by it."""

    def put(instead):
        monkeypatch.setattr(normal, "pixel_jacobians", instead)
        normal._compiled.clear_cache()

    yield put
    normal._compiled.clear_cache()


@pytest.fixture
def without_kernel(no_kernel):
    no_kernel(made_up)


def dense_of(views, target, image_and_jacobian):
    """Return residuals (2, H * W, 3) and Jacobians (2, H * W, 3, P) of the two renders of seed 3."""
    residuals, jacobians = [], []
    for half in (0, 1):
        (seed,) = views.seeds(jnp.uint32(3), jnp.uint32(0), half)
        image, J = image_and_jacobian(seed)
        residuals.append(np.reshape(image, (RES * RES, 3)) - target.reshape(-1, 3).astype(float))
        jacobians.append(np.concatenate([np.reshape(J[name], (RES * RES, 3, -1)) for name in NAMES], -1))
    return np.array(residuals), np.array(jacobians, float)


@pytest.fixture(scope="module")
def dense(scene, target):
    views = problem.build(scene, target, NAMES, {}).groups[0]
    wanted = {name: scene.about.parameters[name] for name in NAMES}
    return dense_of(views, target, lambda seed: made_up(scene, wanted, jnp.arange(RES * RES), 0, SPP, seed, None))


def agree(found, wanted):
    assert np.shape(found) == np.shape(wanted)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=ROUNDING * np.abs(wanted).max())


def by_pixel(dense, weights):
    """Return each pixel's scores (N, P) and matrices (N, P, P)."""
    (ra, rb), (Ja, Jb) = dense
    scores = (np.einsum("pci,pc->pi", Ja, weights * rb) + np.einsum("pci,pc->pi", Jb, weights * ra)) / 2
    matrices = np.einsum("pci,pc,pcj->pij", Ja, weights, Jb)
    return scores, (matrices + matrices.swapaxes(1, 2)) / 2


def test_they_are_those_of_the_jacobians(scene, target, dense, without_kernel):
    check(pj.normal_equations(scene, NAMES, target, WEIGHTS, SPP, seed=3), dense)


@pytest.mark.slow
def test_they_are_those_of_renders(scene, target):
    views = problem.build(scene, target, NAMES, {}).groups[0]
    dense = dense_of(views, target, lambda seed: pj.jacobian(scene, NAMES, SPP, seed))
    check(pj.normal_equations(scene, NAMES, target, WEIGHTS, SPP, seed=3), dense)


def check(found, dense):
    scores, matrices = by_pixel(dense, WEIGHTS.reshape(-1, 3))
    agree(found.matrix, matrices.sum(0))
    agree(found.matrices.sum(0), matrices.sum(0))
    agree(found.gradient, scores.sum(0))
    agree(found.loss, (WEIGHTS.reshape(-1, 3) * dense[0].prod(0)).sum() / 2)
    spread = scores - scores.mean(0)
    agree(found.scatter, spread.T @ spread)
    agree(found.residuals, dense[0])
    assert found.components[:3] == ("glass.int_ior", "floor.reflectance.r", "floor.reflectance.g")


def arguments(views, extra):
    ones, numbers = jnp.ones(COUNT), (jnp.uint32(x) for x in (SPP, 3, 0))
    values, weights = jnp.asarray(views.start, jnp.float32), jnp.ones((RES * RES, 3))
    return views.groups, values, ones, weights, *numbers, jnp.asarray(extra, jnp.float32)


EXTRA = np.random.default_rng(1).normal(size=(RES * RES, 3, 2))


@pytest.mark.parametrize("least_parts", [1, 64])
def test_blocks_and_chunks_are_summed_up_alike_on_any_number_of_devices(
    scene, target, dense, without_kernel, monkeypatch, least_parts
):
    """Blocks of 2 x 2 pixels, some of them beyond the image, in two chunks; sums are split into parts or not."""
    views = problem.build(scene, target, NAMES, {})
    monkeypatch.setattr(normal, "CHUNK_BYTES", 2 * 4 * 3 * 4 * 50)
    monkeypatch.setattr(normal, "ITEMS_OF_A_PART", 20)
    monkeypatch.setattr(normal, "LEAST_PARTS", least_parts)
    assert normal._parts(RES * RES, 1000) == (4 if least_parts == 1 else 1)
    normal._compiled.clear_cache()
    assert normal._chunks(normal._blocks(RES, RES, 2), 25, 2 * 4 * 3 * 4).shape == (2, 1, 25, 4)
    found, on_one = (
        normal._compiled(*arguments(views, EXTRA), vector=views.vector, side=2, devices=n) for n in (None, 1)
    )
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(on_one), strict=True):
        np.testing.assert_array_equal(a, b)
    scores, matrices = by_pixel(dense, np.ones((RES * RES, 3)))
    blocks = np.pad(scores.reshape(RES, RES, COUNT), [(0, 1), (0, 1), (0, 0)]).reshape(5, 2, 5, 2, COUNT).sum((1, 3))
    spread = blocks.reshape(-1, COUNT) - scores.sum(0) / 25
    square = float(views.exposure) ** 2
    agree(found.scatter / square**2, spread.T @ spread)
    agree(found.matrix / square, matrices.sum(0))
    agree(found.residuals, dense[0] * views.exposure)
    agree(found.pulled, np.einsum("pci,pck->cik", dense[1].mean(0), EXTRA) * views.exposure)


@pytest.mark.parametrize("height, width, side", [(1, 1, 1), (5, 3, 1), (7, 5, 3), (150, 90, 1), (150, 90, 5)])
def test_every_pixel_is_in_one_block(height, width, side):
    blocks = normal._blocks(height, width, side)
    assert len(blocks) <= normal.MOST_BLOCKS and (blocks >= 0).any(1).all()
    chunks = normal._chunks(blocks, min(len(blocks), 32), normal.CHUNK_BYTES // 3000)
    np.testing.assert_array_equal(np.sort(chunks[chunks >= 0]), np.arange(height * width))
    found = chunks.reshape(-1, chunks.shape[-1])
    assert (found >= 0).any(1).sum() == len(blocks) and len(chunks) == -(-blocks.size // 3000)


@pytest.mark.slow
def test_views_add_up(scene, target, write_scene, without_kernel):
    """The first view twice, and a view of another size."""
    other = pj.load_scene(write_scene(BODY, res=4, depth=3))
    names = NAMES[1:]
    seen = pj.normal_equations([scene, scene], names, [target] * 2, [WEIGHTS, 0 * WEIGHTS], SPP)
    alone = pj.normal_equations([scene, other], names, [target, np.ones((4, 4, 3))], [WEIGHTS, np.zeros(3)], SPP)
    agree(seen.gradient, alone.gradient)
    agree(seen.matrix, alone.matrix)
    assert seen.residuals.shape == (2, 2 * RES * RES, 3) and alone.residuals.shape == (2, RES * RES + 16, 3)


@pytest.mark.parametrize(
    "weights, words",
    [
        (0.0, "no pixel has a weight"),
        (np.ones((4, 4, 3)), "have the shape"),
        (-1.0, "not negative"),
        (np.nan, "finite"),
    ],
)
def test_bad_weights_are_refused(scene, target, weights, words):
    with pytest.raises(pj.InputError, match=words):
        pj.normal_equations(scene, NAMES, target, weights)


def test_what_is_measured_nowhere_or_weighs_nothing_where_it_is_measured_is_refused(scene, target):
    half = np.arange(RES)[:, None, None] < 4
    with pytest.raises(pj.InputError, match="no pixel has a weight"):
        pj.normal_equations(scene, NAMES, pj.Target(target, measured=half), np.where(half, 0.0, 1.0))


def test_more_than_fits_into_memory_is_refused_before_it_is_begun(scene, target, monkeypatch):
    monkeypatch.setattr(memory, "limit", lambda: 1 << 20)
    for call in (pj.normal_equations, lambda *args: pj.fit(args[0], args[2], args[1])):
        with pytest.raises(pj.InputError, match=r"8 numbers take .* GiB .*fewer parameters; fit takes textures"):
            call(scene, NAMES, target)
    monkeypatch.setattr(memory, "limit", lambda: 8 * 3 * 4 * RES * RES - 1)
    with pytest.raises(pj.InputError, match="8 numbers take .*normal_equations keeps none of them, and neither do jax"):
        pj.jacobian(scene, NAMES)


def test_what_no_image_changes_with_is_named(scene, target, no_kernel):
    """Parameters of zero derivative everywhere."""

    def unchanged(scene, wanted, pixels, *work, **how):
        image, J = made_up(scene, wanted, pixels, *work, **how)
        return image, jax.tree.map(jnp.zeros_like, J)

    no_kernel(unchanged)
    fit = pj.fit(scene, target, NAMES[1:3], spp=4)
    assert [list(direction) for direction in fit.undetermined] == [[name] for name in fit.components]
    assert all(np.isinf(error).all() for error in fit.standard_errors.values())
    np.testing.assert_allclose(fit.values[NAMES[1]], pj.parameters(scene)[NAMES[1]], rtol=1e-5)  # its start


def test_a_roughness_that_counts_as_a_larger_one_is_refused(scene, target):
    with pytest.raises(pj.InputError, match=r"metal.alpha = 0 has no derivative.*larger"):
        pj.fit(scene, target, ["metal.alpha"], start={"metal.alpha": 0.0})
